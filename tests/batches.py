"""What holds for the batches of every engine's step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def assert_same(a: Any, b: Any) -> None:
    """Two pytrees have the same bits."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def assert_batches_agree(step: Callable[..., Any], state: Any, ctrl: Any) -> None:
    """Six worlds step alike in one batch, in nested ones, with one control for all of them, and alone."""
    flat = jax.jit(jax.vmap(step))(state, ctrl)
    nested = jax.jit(jax.vmap(jax.vmap(step)))(*jax.tree.map(lambda x: x.reshape(2, 3, -1), (state, ctrl)))
    assert_same(flat, jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), nested))
    shared = jax.jit(jax.vmap(step, in_axes=(0, None)))(state, ctrl[0])
    assert_same(shared, jax.jit(jax.vmap(step))(state, jnp.tile(ctrl[0], (6, 1))))
    assert_same(step(*jax.tree.map(lambda x: x[0], (state, ctrl))), jax.tree.map(lambda x: x[0], flat))
