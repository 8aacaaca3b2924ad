"""The price of danger: how far the cost is from its limit, and the multiplier that answers."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def violation(episode_cost: jax.Array, cost_limit: jax.Array | float, horizon: int) -> jax.Array:
    """How far the cost is beyond its limit, as cost per step: S = (J - d) / L. Positive means too dangerous.

    Args:
      episode_cost: J [...], undiscounted cost per episode; cost_limit: d in the same unit; horizon: L, in steps.
    """
    return (episode_cost - cost_limit) / horizon


def dual_update(
    multiplier: jax.Array,
    violation: jax.Array,
    surrogate: jax.Array,
    lambda_lr: jax.Array | float,
    lambda_max: jax.Array | float,
) -> jax.Array:
    """One projected gradient step of the multiplier: lambda <- clip(lambda + alpha (S + I), 0, lambda_max).

    Args:
      multiplier: [...], lambda; violation: S [...] in cost per step; surrogate: I [...], the mean over rows of
        ratio times centred cost advantage after the policy's update: the change in cost it is expected to bring.
    """
    return jnp.clip(multiplier + lambda_lr * (violation + surrogate), 0.0, lambda_max)
