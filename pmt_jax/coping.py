"""Coping response: what the policy does about reward and danger."""

from __future__ import annotations

from typing import Literal

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


def regret_weight(
    new: jax.Array,
    old: jax.Array,
    mask: jax.Array,
    *,
    choose: Literal["top", "threshold", "none"],
    omega: jax.Array | float,
    regret_max: jax.Array | float,
    bound: jax.Array | float,
) -> jax.Array:
    """The logarithm of the weight that regret puts on the probability ratio: log prod (1 - r) / (1 - r_old) (Eq. 15).

    Below 0 where regret has risen since the action was taken; exactly 0 where there is none, or it has not changed.

    Args:
      new, old: [..., A] regret now and when the action was taken; mask: [..., A] 1 for real action entries.
      choose: which entries count, by the regret now and for both alike: the `top` ceil(omega A) of them (ties all
        count), those at or above the `threshold` omega, or all.
      regret_max: regret is cut here, so that a single entry moves the ratio at most tenfold at 0.9.
      bound: the weight stays within [1 - bound, 1 + bound], so that it alone never leaves the clip interval, which
        would kill the row's gradient; inf for none.

    Returns:
      [...]; a constant of the policy's weights.
    """
    new, old = jnp.minimum(new, regret_max) * mask, jnp.minimum(old, regret_max) * mask
    if choose == "top":
        above = jnp.sum((new[..., None, :] > new[..., :, None]) * mask[..., None, :], axis=-1)
        chosen = above < jnp.ceil(omega * mask.sum(-1, keepdims=True))
    else:
        chosen = (new >= omega) | (choose == "none")
    log_weight = jnp.sum(chosen * (jnp.log1p(-new) - jnp.log1p(-old)), axis=-1)
    return jnp.clip(log_weight, jnp.log(jnp.maximum(1 - bound, 0.0)), jnp.log1p(bound))


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
