"""What adapters of NumPy libraries share: arrays that are the client's own, their spaces, and keys of seeds."""

from __future__ import annotations

import dataclasses
import numbers
from typing import Any

import jax
import numpy as np
from gymnasium.spaces import Box, Space

from ..base import Env, State
from ..errors import TaskError


def owned(tree: Any) -> Any:
    """`tree` as NumPy arrays that the client may write to: JAX hands out views of its own memory.

    Of a State, what it carries, which may hold keys, is left out.
    """
    if isinstance(tree, State):
        tree = dataclasses.replace(tree, carry=None)
    return jax.tree.map(np.array, jax.device_get(tree))


def boxes(env: Env, batch: tuple[int, ...] = ()) -> dict[str, Box]:
    """Spaces of `batch` observations, global states and actions, of the dtypes that `env` has (32 or 64 bits)."""
    state = jax.eval_shape(env.reset, jax.random.key(0))
    dtypes = {name: np.dtype(getattr(state, name).dtype) for name in ("obs", "global_state")}
    for name, dtype in dtypes.items():
        if not np.issubdtype(dtype, np.floating):
            raise TaskError(f"{env.spec.name}: {name} must be of floating numbers for this adapter, not {dtype}")
    spec = env.spec
    return {
        "obs": Box(-np.inf, np.inf, (*batch, spec.num_agents, spec.obs_dim), dtypes["obs"].type),
        "global_state": Box(-np.inf, np.inf, (*batch, spec.state_dim), dtypes["global_state"].type),
        "action": Box(-1.0, 1.0, (*batch, *spec.action_mask.shape), dtypes["obs"].type),
    }


def action(given: Any, space: Space, what: str) -> np.ndarray:
    """`given` as an array of `space`, whose bounds are the task's own business.

    Raises:
      TaskError: it has another shape, which NumPy might stretch, or holds no numbers.
    """
    try:
        array = np.asarray(given, space.dtype)
    except (TypeError, ValueError):
        raise TaskError(f"{what} must be numbers of shape {space.shape}, not {given!r}") from None
    if array.shape != space.shape:
        raise TaskError(f"{what} must have shape {space.shape}, not {array.shape}")
    return array


def key(rng: np.random.Generator) -> jax.Array:
    """The key of the next episodes."""
    return jax.random.key(int(rng.integers(2**31)))


def count(what: str, value: Any) -> int:
    """`value`, a whole number of at least 1.

    Raises:
      TaskError: it is none.
    """
    if not isinstance(value, numbers.Integral) or value < 1:
        raise TaskError(f"{what} must be a whole number of at least 1, not {value!r}")
    return int(value)
