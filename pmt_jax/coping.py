"""Coping response: what the policy does about reward and danger."""

from __future__ import annotations

import jax
import jax.numpy as jnp


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
    """PPO's pessimistic objective, to be maximised: M min(rho A, clip(rho, 1 - eps, 1 + eps) A) per row.

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
