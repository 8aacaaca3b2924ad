"""Losses: the clipped surrogate on the hybrid advantage (Eq. 10) and the clipped Huber loss of values (Eq. 12)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax


def hybrid_advantage(advantage: jax.Array, cost_advantage: jax.Array, multiplier: jax.Array) -> jax.Array:
    """Reward advantage less the weighted cost advantages: A - sum_k lambda_k A_c,k.

    Args:
      advantage: [..., N]; cost_advantage: [..., N, K]; multiplier: [N, K].

    Returns:
      [..., N].
    """
    return advantage - jnp.sum(multiplier * cost_advantage, axis=-1)


def clipped_surrogate(
    log_ratio: jax.Array, log_weight: jax.Array, advantage: jax.Array, factor: jax.Array, clip: jax.Array | float
) -> jax.Array:
    """PPO's pessimistic objective per row, to be maximised: M min(rho A, clip(rho, 1 - eps, 1 + eps) A) (Eq. 10).

    Args:
      log_ratio: [...] log pi(a|o) - log pi_old(a|o), summed over action entries.
      log_weight: [...] bias on the ratio (0 for all methods without regret): rho = exp(log_ratio + log_weight).
      advantage: [...] the hybrid advantage; factor: [...] M, the ratios of the agents updated before this one.
      clip: eps.

    Returns:
      [...]; its mean over rows is the objective.
    """
    ratio = jnp.exp(log_ratio + log_weight)
    return factor * jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage)


def huber(error: jax.Array, delta: float = 10.0) -> jax.Array:
    """Quadratic e^2/2 up to `delta` on both sides, linear delta (|e| - delta/2) beyond."""
    return optax.losses.huber_loss(error, delta=delta)


def value_loss(value: jax.Array, old_value: jax.Array, target: jax.Array, clip: jax.Array | float) -> jax.Array:
    """The worse of the Huber losses of the prediction and of its clipped move (Eq. 12).

    Args:
      value, old_value, target: [...] in normalised units; clip: how far a value may profit from moving.

    Returns:
      [...]; its mean is the loss.
    """
    clipped = old_value + jnp.clip(value - old_value, -clip, clip)
    return jnp.maximum(huber(target - value), huber(target - clipped))
