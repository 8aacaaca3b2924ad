"""Advantages: how much better than expected a step was, for reward, cost and fear alike."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def gae(
    signal: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    done: jax.Array,
    gamma: jax.Array | float,
    gae_lambda: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Generalised advantage estimation (Schulman et al., 2016), of cost (Eq. 8) and fear (Eq. 9) as of reward.

    delta_t = signal_t + gamma * (1 - terminated_t) * next_value_t - value_t
    A_t     = delta_t + gamma * gae_lambda * (1 - done_t) * A_{t+1}

    A time limit (done but not terminated) ends the trace yet bootstraps from `next_value`, the value of the state
    *before* any reset; a termination does neither.

    Args:
      signal, value, next_value: [T, B, ...] in the signal's own unit.
      terminated, done: [T, B] bool.
      gamma, gae_lambda: scalars in [0, 1].

    Returns:
      advantage [T, B, ...] and the critic's target `advantage + value` [T, B, ...].
    """
    over_signal = (...,) + (None,) * (signal.ndim - done.ndim)
    delta = signal + gamma * ~terminated[over_signal] * next_value - value

    def backward(later: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta_t, keep = step
        advantage = delta_t + gamma * gae_lambda * keep * later
        return advantage, advantage

    _, advantage = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, ~done[over_signal]), reverse=True)
    return advantage, advantage + value


def standardise(advantage: jax.Array, floor: jax.Array | float = 0.0) -> tuple[jax.Array, jax.Array]:
    """Centres `advantage` [T, B, ...] over time and environments, and scales it to unit standard deviation.

    Args:
      floor: the standard deviation divided by is at least this, so that a batch nearly without cost does not become
        noise of unit size.

    Returns:
      centred (in the signal's unit) and scaled, both [T, B, ...].
    """
    centred = advantage - advantage.mean((0, 1))
    return centred, centred / jnp.maximum(advantage.std((0, 1)) + 1e-5, floor)
