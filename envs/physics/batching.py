"""Batches of any depth as one: for steps that take arrays with a single leading axis."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


def flattened(batched: Any) -> Any:
    """A function of arrays with a leading [B] for which `vmap`, however nested, only makes B larger."""

    @jax.custom_batching.custom_vmap
    def call(*args: Any) -> Any:
        return batched(*args)

    @call.def_vmap
    def rule(axis_size: int, in_batched: Any, *args: Any) -> tuple[Any, Any]:
        def spread(leaf: jax.Array, is_batched: bool) -> jax.Array:
            leaf = leaf if is_batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])

        size = jax.tree.leaves(args)[0].shape[1 if jax.tree.leaves(in_batched)[0] else 0]
        out = flattened(batched)(*jax.tree.map(spread, args, tuple(in_batched)))
        out = jax.tree.map(lambda leaf: leaf.reshape(axis_size, size, *leaf.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return call
