"""The constraint, from the costs of a batch to what the policies pay for them.

    costs -> in units of the limit -> estimate of an episode's cost -> excess (Eq. 11) -> price in the policies' loss
          (Eq. 10) -> the policies change -> the multiplier's step (Eq. 16, 17)

A trust region has no multiplier. It keeps the limit itself, and lowers it while costs stay beyond it.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from ..limits import columns
from .setup import Setup, limit_less_margin
from .types import Batch, Constraint, Hyper, Metrics, PolicySamples

LAMBDA_MIN = 0.01  # share of lambda_init below which no multiplier falls


def init(setup: Setup, hyper: Hyper) -> Constraint:
    """The constraint before the first update: the estimate is the target, so that there is no excess yet."""
    heads = (setup.vector.spec.num_agents, setup.vector.spec.num_costs)
    return Constraint(
        estimate=jnp.full(heads, goal(setup, hyper)),
        multiplier=jnp.full(heads, hyper.lambda_init * (setup.method.constraint in ("lagrangian", "pid"))),
        lowered=jnp.zeros(heads),
    )


# ---------------------------------------------------------------------------------------------------------------------
# The unit of costs, the estimate, and the excess


def target(hyper: Hyper) -> jax.Array:
    """What the learner holds an episode's cost to, [] or [K]: the limit d, less the margin, a share of it."""
    return limit_less_margin(hyper, hyper.cost_margin)


def in_unit(setup: Setup, hyper: Hyper, cost: jax.Array) -> jax.Array:
    """Costs of steps [..., K], or fear of them, in units of the limit: c L / d; their mean over an episode is J / d.

    The learner sees costs in this unit alone, so no other setting depends on the limit, on the horizon L or on how
    often costs are noticed. A limit of 0 is no unit; costs are then counted as if one were allowed. The letter has no
    unit.
    """
    if setup.method.letter:
        return cost
    limit = target(hyper)
    return cost * (setup.vector.horizon / jnp.where(limit > 0, limit, 1.0))


def goal(setup: Setup, hyper: Hyper) -> jax.Array:
    """What a step's cost is held to in its unit, [] or [K]: 1, or 0 for a limit of 0; with the letter d / L."""
    limit = target(hyper)
    return limit / setup.vector.horizon if setup.method.letter else (limit > 0).astype(jnp.float32)


def estimate_cost(setup: Setup, hyper: Hyper, batch: Batch, previous: jax.Array, cost_value: jax.Array) -> jax.Array:
    """The mean cost of a step, in its unit, that the constraint is held against [N, K].

    It is a moving average in which a batch has the weight of its share of an episode's time. It needs no episode that
    ends, and no batch that sees all parts of one. Where few batches have costs, an excess that is cut would be lower on
    average without it. With the letter it is (1 - gamma) times the mean value, as in the excess of the paper.

    Args:
      previous: [N, K], the estimate before; cost_value: [T, B, N, K] of the batch's states.
    """
    if setup.method.letter:
        return (1 - hyper.gamma) * cost_value.mean((0, 1))
    rate = in_unit(setup, hyper, batch.cost.mean((0, 1)))  # costs of 0 and 1 add up exactly, whatever the order
    return previous + min(1.0, batch.cost.shape[0] / setup.vector.horizon) * (rate - previous)


def cost_excess(setup: Setup, hyper: Hyper, estimate: jax.Array) -> jax.Array:
    """How far a cost [..., K] in its unit is beyond the limit: S = (J - d) / d (Eq. 11).

    The paper's is a cost per step, (J - d) / L. As a share of the limit an equal excess is as serious at every limit.
    """
    return estimate - goal(setup, hyper)


def cut(excess: jax.Array) -> jax.Array:
    """An excess [...] within [-1, 1]: costs far beyond the limit raise a multiplier as fast as no costs lower it."""
    return jnp.clip(excess, -1.0, 1.0)


# ---------------------------------------------------------------------------------------------------------------------
# The multiplier: what a cost counts in the policies' loss, and its step


def price(setup: Setup, hyper: Hyper, multiplier: jax.Array, excess: jax.Array, estimate: jax.Array) -> jax.Array:
    """What the policies weigh costs with [N, K]: the multiplier, which PID takes as its integral, and two gains more.

    Args:
      multiplier: [N, K]; excess: [N, K] of this update; estimate: [N, K] of the update before.
    """
    if setup.method.constraint == "switching":
        return switching(excess)
    if setup.method.constraint not in ("lagrangian", "pid"):
        return multiplier
    return pid(
        multiplier,
        cut(excess),
        cut(cost_excess(setup, hyper, estimate)),
        hyper.lambda_kp,
        hyper.lambda_kd,
        hyper.lambda_max,
    )


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
      integral: I [...]; excess, previous_excess: S [...] of this update and of the last, in units of the limit.
    """
    change = jnp.maximum(excess - previous_excess, 0.0)
    return jnp.clip(integral + lambda_kp * excess + lambda_kd * change, 0.0, lambda_max)


def switching(excess: jax.Array) -> jax.Array:
    """CRPO's choice of what an agent improves [N, K]: 1 at its cost furthest beyond the limit, else 0 (reward).

    Algorithm 1 of Xu et al. (2021): while an estimate is beyond its limit an update lowers that cost alone, and
    otherwise it raises the reward alone. The paper's tolerance is a `cost_margin` below 0 there; here it is at least 0.

    Args:
      excess: [N, K], S of this update, in units of the limit.
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

    I <- (I + K_I S)_+, with K_I = `gain`, then lambda = (I + K_P S + K_D (S - S_previous)_+)_+ is the price of
    this update (Stooke et al., 2020, Algorithm 2), both of them at most `lambda_max`.
    """
    if setup.method.constraint != "pid":
        return constraint
    updated = dual_update(constraint.multiplier, cut(excess), gain(setup, hyper), hyper.lambda_max)
    return dataclasses.replace(constraint, multiplier=updated)


def respond(
    setup: Setup,
    hyper: Hyper,
    constraint: Constraint,
    samples: PolicySamples,
    excess: jax.Array,
    log_ratio: jax.Array,
    reach: jax.Array,
) -> Constraint:
    """One agent's constraint [K] after its policy has changed.

    The letter's multiplier adds I of `surrogate_cost` to its excess. Other methods leave it out: where an update lowers
    the cost I is below 0 however high the cost still is, so it would settle above the limit.

    Args:
      samples: the agent's, [R, ...]; excess: [K]; log_ratio: [R], by how much the policy changed.
      reach: [], the most that a step of the trust region promised to take off the cost, in units of the limit.
    """
    if setup.method.constraint == "trust_region":
        lowered = lower_limit(constraint.lowered, excess, hyper.limit_lr, reach)
        return dataclasses.replace(constraint, lowered=lowered)
    if setup.method.constraint != "lagrangian":
        return constraint
    if setup.method.letter:
        surrogate = surrogate_cost(log_ratio, samples.log_weight, samples.cost_advantage)
        step = excess + setup.config.rollout_length * surrogate  # the paper's I is a sum over steps
        updated = dual_update(constraint.multiplier, step, hyper.lambda_lr, hyper.lambda_max)
    else:
        lowest = LAMBDA_MIN * hyper.lambda_init
        updated = relative_update(constraint.multiplier, cut(excess), gain(setup, hyper), lowest, hyper.lambda_max)
    return dataclasses.replace(constraint, multiplier=updated)


def surrogate_cost(log_ratio: jax.Array, log_weight: jax.Array, cost_advantage: jax.Array) -> jax.Array:
    """The change in cost that a policy's update is expected to bring: I = mean(rho A_c) (Eq. 16).

    Args:
      log_ratio, log_weight: [...], after the update; cost_advantage: [..., K].

    Returns:
      [K], in the unit of `cost_advantage`.
    """
    ratio = jnp.exp(log_ratio + log_weight)
    return jnp.mean(ratio[..., None] * cost_advantage, axis=tuple(range(ratio.ndim)))


def gain(setup: Setup, hyper: Hyper) -> jax.Array:
    """By how much an excess of 1 changes the multiplier in an update; `lambda_lr` is for a whole run of them."""
    return jnp.asarray(hyper.lambda_lr / setup.config.num_updates)


def dual_update(
    multiplier: jax.Array,
    excess: jax.Array,
    lambda_lr: jax.Array | float,
    lambda_max: jax.Array | float,
) -> jax.Array:
    """One projected gradient step of the multiplier: lambda <- clip(lambda + alpha x, 0, lambda_max) (Eq. 17).

    Args:
      multiplier: [...], lambda; excess: [...], measured and expected, x = S + I.
    """
    return jnp.clip(multiplier + lambda_lr * excess, 0.0, lambda_max)


def relative_update(
    multiplier: jax.Array,
    excess: jax.Array,
    lambda_lr: jax.Array | float,
    lambda_min: jax.Array | float,
    lambda_max: jax.Array | float,
) -> jax.Array:
    """One step in proportion to the multiplier: lambda <- clip(lambda (1 + alpha x), lambda_min, lambda_max).

    Multiplicative weights (Arora et al., 2012). A multiplier doubles in the same time whatever its size, so
    one rate serves limits whose multipliers differ by a factor of ten. Without the lower bound a long time without
    costs would take as long to undo, and in the end 0 would never move again.

    Args:
      multiplier: [...], lambda > 0; excess: [...], x = S in units of the limit, `cut`.
    """
    return jnp.clip(multiplier * (1 + lambda_lr * excess), lambda_min, lambda_max)


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
      lowered: [...] so far, and excess: S [...], in units of the limit; most: the most that a step promises to take
        off the cost, in the same unit.
    """
    return jnp.maximum(lowered + limit_lr * jnp.minimum(excess, most - lowered), 0.0)
