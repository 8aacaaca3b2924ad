"""The Lagrangian multiplier: the excess of a cost over its limit, the multiplier's step (Eq. 11, 16, 17), and PID."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def cost_excess(episode_cost: jax.Array, limit: jax.Array | float, horizon: int) -> jax.Array:
    """How far the cost is beyond its limit, as cost per step: S = (J - d) / L; positive is too dangerous (Eq. 11).

    Args:
      episode_cost: J [...], undiscounted cost per episode; limit: d in the same unit; horizon: L, in steps.
    """
    return (episode_cost - limit) / horizon


def held_limit(limit: jax.Array | float | tuple[float, ...], margin: jax.Array | float) -> jax.Array:
    """What the learner holds an episode's cost to, [K]: the limit d, less the margin, a share of it."""
    return jnp.asarray(limit) * (1 - margin)


def in_limits(excess: jax.Array, limit: jax.Array | float, horizon: int) -> jax.Array:
    """An excess [...] in cost per step as a share of the limit, within [-1, 1]: (J - d) / d, cut at 1.

    An equal share gives an equal step at every limit. The cut bounds the step of a cost far beyond its limit. Where a
    margin is kept, the excess over `held_limit` can be a share of the limit or of what it is held to.
    """
    return jnp.clip(excess * horizon / jnp.maximum(limit, 1e-6), -1.0, 1.0)


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
    excess: jax.Array,
    lambda_lr: jax.Array | float,
    lambda_max: jax.Array | float,
) -> jax.Array:
    """One projected gradient step of the multiplier: lambda <- clip(lambda + alpha x, 0, lambda_max) (Eq. 17).

    Args:
      multiplier: [...], lambda; excess: [...], measured and expected, x = S + I in cost per step, or `in_limits`.
    """
    return jnp.clip(multiplier + lambda_lr * excess, 0.0, lambda_max)


def relative_update(
    multiplier: jax.Array,
    excess: jax.Array,
    lambda_lr: jax.Array | float,
    lambda_min: jax.Array | float,
    lambda_max: jax.Array | float,
) -> jax.Array:
    """One step in proportion to the multiplier: lambda <- clip(lambda exp(alpha x), lambda_min, lambda_max).

    An exponentiated gradient (Kivinen and Warmuth, 1997). A multiplier doubles in the same time whatever its size, so
    one rate serves limits whose multipliers differ by a factor of ten. Without the lower bound a long time without
    costs would take as long to undo, and in the end 0 would never move again.

    Args:
      multiplier: [...], lambda > 0; excess: [...], x, `in_limits`.
    """
    return jnp.clip(multiplier * jnp.exp(lambda_lr * excess), lambda_min, lambda_max)


def lowered_limit(
    lowered: jax.Array, cost_excess: jax.Array, limit_lr: jax.Array | float, most: jax.Array
) -> jax.Array:
    """What a trust region's limit is lowered by: d <- d - eta (J - d) per update, never above d itself.

    A linear model of the cost promises more than a step keeps; what is missing adds up here until it is kept. Where
    the sum is above `most`, it moves down towards it instead (anti-windup by back-calculation): without that, costs
    far beyond the limit would add up to more than can act, and delay the reward once the limit is kept.

    Args:
      lowered: [...] so far, and cost_excess: S [...], in cost per step; most: `limit_windup` times the most that a
        step promises to take off the cost, in the same unit.
    """
    return jnp.maximum(lowered + limit_lr * jnp.minimum(cost_excess, most - lowered), 0.0)


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
      integral: I [...]; cost_excess, previous_excess: S [...] of this update and of the last, in the same unit.
    """
    change = jnp.maximum(cost_excess - previous_excess, 0.0)
    return jnp.clip(integral + lambda_kp * cost_excess + lambda_kd * change, 0.0, lambda_max)
