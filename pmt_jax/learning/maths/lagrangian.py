"""The Lagrangian multiplier: the excess of a cost over its limit, the multiplier's step (Eq. 11, 16, 17), and PID."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def cost_excess(episode_cost: jax.Array, cost_limit: jax.Array | float, horizon: int) -> jax.Array:
    """How far the cost is beyond its limit, as cost per step: S = (J - d) / L; positive is too dangerous (Eq. 11).

    Args:
      episode_cost: J [...], undiscounted cost per episode; cost_limit: d in the same unit; horizon: L, in steps.
    """
    return (episode_cost - cost_limit) / horizon


def surrogate_cost(log_ratio: jax.Array, log_weight: jax.Array, cost_advantage: jax.Array) -> jax.Array:
    """The change in cost per step that a policy's update is expected to bring: I = mean(rho A_c) (Eq. 16).

    Args:
      log_ratio, log_weight: [R], after the update; cost_advantage: [R, K], centred.

    Returns:
      [K].
    """
    return jnp.mean(jnp.exp(log_ratio + log_weight)[:, None] * cost_advantage, axis=0)


def dual_update(
    multiplier: jax.Array,
    cost_excess: jax.Array,
    surrogate: jax.Array,
    lambda_lr: jax.Array | float,
    lambda_max: jax.Array | float,
) -> jax.Array:
    """One projected gradient step of the multiplier: lambda <- clip(lambda + alpha (S + I), 0, lambda_max) (Eq. 17).

    Args:
      multiplier: [...], lambda; violation: S [...] and surrogate: I [...], both in cost per step.
    """
    return jnp.clip(multiplier + lambda_lr * (cost_excess + surrogate), 0.0, lambda_max)


def pid(
    integral: jax.Array,
    cost_excess: jax.Array,
    previous_excess: jax.Array,
    lambda_kp: jax.Array | float,
    lambda_kd: jax.Array | float,
    lambda_max: jax.Array | float,
) -> jax.Array:
    """The multiplier of PID control: lambda = clip(I + kp S + kd max(S - S_prev, 0), 0, lambda_max).

    I moves by `dual_update`, whose projection is the anti-windup: it never leaves the multiplier's own interval, so it
    answers at once when the excess changes sign. A cost that falls adds nothing (Stooke et al., 2020, Algorithm 2).

    Args:
      integral: I [...]; cost_excess, previous_excess: S [...] of this update and of the last, in cost per step.
    """
    change = jnp.maximum(cost_excess - previous_excess, 0.0)
    return jnp.clip(integral + lambda_kp * cost_excess + lambda_kd * change, 0.0, lambda_max)
