"""A method of one's own: `pmt train lane --method docs/examples/my_method.py:dread`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pmt_jax import Method


def worst_to_come(batch: Any) -> jax.Array:
    """The largest discounted cost to come: [T, B, N, K], from batch.cost of the same shape."""

    def backward(later: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        cost, done = step
        largest = jnp.maximum(cost, 0.5 * later * ~done[:, None, None])  # an episode's end stops the trace
        return largest, largest

    _, largest = jax.lax.scan(backward, jnp.zeros_like(batch.cost[0]), (batch.cost, batch.done), reverse=True)
    return largest


dread = Method(order="sequential", constraint="lagrangian", cost_signal=worst_to_come)
