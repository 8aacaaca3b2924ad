"""A gated recurrent unit (Cho et al., 2014), in the form of flax's `GRUCell` and cuDNN.

What the inputs add to the gates is made for all steps at once, outside. Only the product with the hidden state, which
cannot be, is left to the steps.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def cell(gates: jax.Array, hidden: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """One step: h' = (1 - z) n + z h.

    r, z = sigmoid(g_r + h W_r), sigmoid(g_z + h W_z) and n = tanh(g_n + r (h W_n + b)).

    Args:
      gates: g_r, g_z, g_n [..., 3H], linear in the input; hidden: h [..., H].
      kernel: W_r, W_z, W_n [H, 3H]; bias: b [H].

    Returns:
      [..., H].
    """
    return _gated(gates, hidden, jnp.split(kernel, 3, -1), bias)


def _gated(gates: jax.Array, hidden: jax.Array, kernels: list[jax.Array], bias: jax.Array) -> jax.Array:
    # A product for each gate: XLA splits one of all three over a CPU's threads, and it then takes twice as long.
    outer, inner = jnp.split(gates, 3, -1), [hidden @ kernel for kernel in kernels]
    reset, update = jax.nn.sigmoid(outer[0] + inner[0]), jax.nn.sigmoid(outer[1] + inner[1])
    new = jnp.tanh(outer[2] + reset * (inner[2] + bias))
    return (1 - update) * new + update * hidden


def unroll(gates: jax.Array, hidden: jax.Array, done: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """All steps of B sequences, each episode in them from a hidden state of 0.

    Args:
      gates: [B, T, ..., 3H] and kernel, bias: see `cell`; hidden: [B, ..., H] before the first step.
      done: [B, T] bool, an episode ends with this step.

    Returns:
      [B, T, ..., H], the hidden state after each step, before any reset.
    """
    kernels = jnp.split(kernel, 3, -1)

    def step(hidden: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        gates, done = now
        after = _gated(gates, hidden, kernels, bias)
        return reset(after, done), after

    _, states = jax.lax.scan(step, hidden, (gates.swapaxes(0, 1), done.swapaxes(0, 1)))
    return states.swapaxes(0, 1)


def reset(hidden: jax.Array, done: jax.Array) -> jax.Array:
    """Hidden states [..., H], 0 where an episode has ended; `done` [...] has their leading axes."""
    return jnp.where(done.reshape(done.shape + (1,) * (hidden.ndim - done.ndim)), 0.0, hidden)
