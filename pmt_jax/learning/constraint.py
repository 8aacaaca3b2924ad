"""The constraint, from the costs of a batch to what the policies pay for them.

    costs -> estimate of an episode's cost -> excess over the limit (Eq. 11) -> price in the policies' loss (Eq. 10)
          -> the policies change -> the multiplier's step (Eq. 16, 17)

A trust region has no multiplier. It keeps the limit itself, and lowers it while costs stay beyond it.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from ..limits import columns
from .rollout import finished_mean
from .schedules import Schedule
from .setup import Setup, limit_less_margin
from .types import Batch, Constraint, Hyper, Metrics, PolicySamples

LAMBDA_MIN = 0.01  # share of lambda_init below which no multiplier falls that changes in proportion to itself


def init(setup: Setup, hyper: Hyper) -> Constraint:
    """The constraint before the first update: the estimate is the target, so that there is no excess yet."""
    heads = (setup.vector.spec.num_agents, setup.vector.spec.num_costs)
    return Constraint(
        estimate=jnp.full(heads, target(hyper)),
        multiplier=jnp.full(heads, hyper.lambda_init * (setup.method.constraint in ("lagrangian", "pid"))),
        lowered=jnp.zeros(heads),
    )


def target(hyper: Hyper) -> jax.Array:
    """What the learner holds an episode's cost to, [K]: the limit d, less the margin, a share of it."""
    return limit_less_margin(hyper, hyper.cost_margin)


# ---------------------------------------------------------------------------------------------------------------------
# Estimate and excess


def estimate_cost(
    how: str, horizon: int, batch: Batch, previous: jax.Array, cost_value: jax.Array, gamma: jax.Array | float
) -> jax.Array:
    """The undiscounted cost per episode [N, K] that the constraint is held against.

    `episode`: mean over the episodes that ended in this batch, `previous` if none did. `rate`: mean cost per step
    times the horizon; no lag, for batches much shorter than an episode. `average`: the rate's moving average, in which
    a batch has the weight of its share of an episode's time. It is for an excess that is cut (`relative_excess`):
    where few batches have costs, cut rates are lower on average than the rate is. `critic`: (1 - gamma) times the
    mean cost value, times the horizon.

    Args:
      how: `cost_estimate`; horizon: in steps; previous: [N, K], the estimate before.
      cost_value: [T, B, N, K] of the batch's states, discounted by gamma.
    """
    rate = horizon * batch.cost.mean((0, 1))
    match how:
        case "critic":
            return (1 - gamma) * horizon * cost_value.mean((0, 1))
        case "rate":
            return rate
        case "average":
            return previous + min(1.0, batch.cost.shape[0] / horizon) * (rate - previous)
        case _:
            return jnp.where(batch.finished.any(), finished_mean(batch, batch.episode_cost), previous)


def cost_excess(episode_cost: jax.Array, limit: jax.Array | float, horizon: int) -> jax.Array:
    """How far the cost is beyond its limit, as cost per step: S = (J - d) / L; positive is too dangerous (Eq. 11).

    Args:
      episode_cost: J [...], undiscounted cost per episode; limit: d in the same unit; horizon: L, in steps.
    """
    return (episode_cost - limit) / horizon


def relative_excess(excess: jax.Array, limit: jax.Array | float, horizon: int) -> jax.Array:
    """An excess [...] in cost per step as a share of the limit, within [-1, 1]: (J - d) / d, cut at 1.

    An equal share gives an equal step at every limit. The cut bounds the step of a cost far beyond its limit. Where a
    margin is kept, the excess over `target` can be a share of the limit or of the target.
    """
    return jnp.clip(excess * horizon / jnp.maximum(limit, 1e-6), -1.0, 1.0)


def excess_in_lambda_unit(setup: Setup, hyper: Hyper, excess: jax.Array) -> jax.Array:
    """An excess [..., K] in cost per step, in the unit that the multiplier's gains are for (`lambda_unit`)."""
    if setup.config.lambda_unit == "step":
        return excess
    # In proportion to itself, a multiplier falls as fast without costs as it rises with too many.
    limit = target(hyper) if setup.config.lambda_unit == "relative" else limit_less_margin(hyper, 0.0)
    return relative_excess(excess, limit, setup.vector.horizon)


# ---------------------------------------------------------------------------------------------------------------------
# The multiplier: what a cost counts in the policies' loss, and its step


def price(setup: Setup, hyper: Hyper, multiplier: jax.Array, excess: jax.Array, estimate: jax.Array) -> jax.Array:
    """What the policies weigh costs with [N, K]: the multiplier, which PID takes as its integral, and two gains more.

    Args:
      multiplier: [N, K]; excess: [N, K] of this update, in cost per step; estimate: [N, K] of the update before.
    """
    if setup.method.constraint == "switching":
        return switching(excess)
    if setup.method.constraint not in ("lagrangian", "pid"):
        return multiplier
    previous = cost_excess(estimate, target(hyper), setup.vector.horizon)
    now, before = (excess_in_lambda_unit(setup, hyper, x) for x in (excess, previous))
    return pid(multiplier, now, before, hyper.lambda_kp, hyper.lambda_kd, hyper.lambda_max)


def pid(
    integral: jax.Array,
    excess: jax.Array,
    previous_excess: jax.Array,
    lambda_kp: jax.Array | float,
    lambda_kd: jax.Array | float,
    lambda_max: jax.Array | float,
) -> jax.Array:
    """The multiplier of PID control: lambda = clip(I + kp S + kd max(S - S_prev, 0), 0, lambda_max).

    I moves by `dual_update`, whose projection is the anti-windup: it never leaves the multiplier's own interval, so it
    answers at once when the excess changes sign. A cost that falls adds nothing (Stooke et al., 2020, Algorithm 2).

    Args:
      integral: I [...]; excess, previous_excess: S [...] of this update and of the last, in the same unit.
    """
    change = jnp.maximum(excess - previous_excess, 0.0)
    return jnp.clip(integral + lambda_kp * excess + lambda_kd * change, 0.0, lambda_max)


def switching(excess: jax.Array) -> jax.Array:
    """CRPO's choice of what an agent improves [N, K]: 1 at its cost furthest beyond the limit, else 0 (reward).

    Algorithm 1 of Xu et al. (2021): while an estimate is beyond its limit an update lowers that cost alone, and
    otherwise it raises the reward alone. The paper's tolerance is a `cost_margin` below 0 there; here it is at least 0.

    Args:
      excess: [N, K], S of this update, in any unit that costs share.
    """
    worst = jax.nn.one_hot(excess.argmax(-1), excess.shape[-1])
    return worst * (excess > 0)


def weights(setup: Setup, price: jax.Array) -> tuple[jax.Array | float, jax.Array]:
    """What the reward [N] and each cost [N, K] count in the policies' loss, of what the costs' `price` [N, K] is.

    `pid`: 1 / (1 + lambda) and lambda / (1 + lambda), so that the step keeps its size however high the multiplier is
    (Stooke et al., 2020, Algorithm 1). `switching`: 1 for the one that is improved. Else 1 and the price.
    """
    paid = price.sum(-1)
    if setup.method.constraint == "pid":
        return 1 / (1 + paid), price / (1 + paid)[:, None]
    return (1 - paid if setup.method.constraint == "switching" else 1.0), price


def integrate(setup: Setup, hyper: Hyper, constraint: Constraint, excess: jax.Array) -> Constraint:
    """The constraint before the policies change: `pid` adds this update's excess [N, K] to its integral first.

    I <- (I + K_I S)_+, with K_I = `lambda_lr`, then lambda = (I + K_P S + K_D (S - S_previous)_+)_+ is the price of
    this update (Stooke et al., 2020, Algorithm 2), both of them at most `lambda_max`.
    """
    if setup.method.constraint != "pid":
        return constraint
    step = excess_in_lambda_unit(setup, hyper, excess)
    updated = dual_update(constraint.multiplier, step, hyper.lambda_lr, hyper.lambda_max)
    return dataclasses.replace(constraint, multiplier=updated)


def respond(
    setup: Setup,
    hyper: Hyper,
    now: Schedule,
    constraint: Constraint,
    samples: PolicySamples,
    excess: jax.Array,
    log_ratio: jax.Array,
    reach: jax.Array,
) -> Constraint:
    """One agent's constraint [K] after its policy has changed.

    Args:
      samples: the agent's, [R, ...]; excess: [K] in cost per step; log_ratio: [R], by how much the policy changed.
      reach: [] cost per step, the most that a step of the trust region promised to take off the cost.
    """
    if setup.method.constraint == "trust_region":
        lowered = lower_limit(constraint.lowered, excess, hyper.limit_lr, now.limit_windup * reach)
        return dataclasses.replace(constraint, lowered=lowered)
    if setup.method.constraint != "lagrangian":
        return constraint
    surrogate = surrogate_cost(log_ratio, samples.log_weight, samples.cost_advantage)
    step = excess_in_lambda_unit(setup, hyper, excess + hyper.surrogate_weight * surrogate)
    if setup.config.lambda_unit == "relative":
        lowest = LAMBDA_MIN * hyper.lambda_init
        updated = relative_update(constraint.multiplier, step, hyper.lambda_lr, lowest, hyper.lambda_max)
    else:
        updated = dual_update(constraint.multiplier, step, hyper.lambda_lr, hyper.lambda_max)
    return dataclasses.replace(constraint, multiplier=updated)


def surrogate_cost(log_ratio: jax.Array, log_weight: jax.Array, cost_advantage: jax.Array) -> jax.Array:
    """The change in cost per step that a policy's update is expected to bring: I = mean(rho A_c) (Eq. 16).

    Args:
      log_ratio, log_weight: [...], after the update; cost_advantage: [..., K], centred.

    Returns:
      [K].
    """
    ratio = jnp.exp(log_ratio + log_weight)
    return jnp.mean(ratio[..., None] * cost_advantage, axis=tuple(range(ratio.ndim)))


def dual_update(
    multiplier: jax.Array,
    excess: jax.Array,
    lambda_lr: jax.Array | float,
    lambda_max: jax.Array | float,
) -> jax.Array:
    """One projected gradient step of the multiplier: lambda <- clip(lambda + alpha x, 0, lambda_max) (Eq. 17).

    Args:
      multiplier: [...], lambda; excess: [...], measured and expected, x = S + I in cost per step, or `relative_excess`.
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
      multiplier: [...], lambda > 0; excess: [...], x, `relative_excess`.
    """
    return jnp.clip(multiplier * jnp.exp(lambda_lr * excess), lambda_min, lambda_max)


def metrics(setup: Setup, constraint: Constraint, price: jax.Array, excess: jax.Array) -> Metrics:
    """What an update reports: means over agents and costs, of excesses the largest; then each, see `limits.columns`."""
    shown = {"lambda": price.mean(), "cost_excess": excess.max()}
    shown |= columns("lambda", price, setup.shares_cost) | columns("cost_excess", excess, setup.shares_cost)
    if setup.method.constraint == "trust_region":
        shown["limit_lowered"] = constraint.lowered.mean()
        shown |= columns("limit_lowered", constraint.lowered, setup.shares_cost)
    return shown


# ---------------------------------------------------------------------------------------------------------------------
# The limit of a trust region


def lower_limit(lowered: jax.Array, excess: jax.Array, limit_lr: jax.Array | float, most: jax.Array) -> jax.Array:
    """What a trust region's limit is lowered by: d <- d - eta (J - d) per update, never above d itself.

    A linear model of the cost promises more than a step keeps; what is missing adds up here until it is kept. Where
    the sum is above `most`, it moves down towards it instead (anti-windup by back-calculation): without that, costs
    far beyond the limit would add up to more than can act, and delay the reward once the limit is kept.

    Args:
      lowered: [...] so far, and excess: S [...], in cost per step; most: `limit_windup` times the most that a
        step promises to take off the cost, in the same unit.
    """
    return jnp.maximum(lowered + limit_lr * jnp.minimum(excess, most - lowered), 0.0)
