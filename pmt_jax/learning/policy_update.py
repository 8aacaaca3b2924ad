"""Policy updates: agent after agent or all at once, by clipped epochs or by a trust-region step."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from . import sharding
from .maths import distributions, lagrangian, trust_region
from .maths.advantages import standardise
from .maths.losses import clipped_surrogate, hybrid_advantage
from .optimise import fit, shuffled
from .setup import Setup, held_limit
from .types import Batch, Hyper, Metrics, Params, PolicyRows, Tag, TrainState

LOWEST = 0.01  # share of lambda_init below which no multiplier falls that changes in proportion to itself


def update_policies(
    setup: Setup,
    hyper: Hyper,
    actor: TrainState,
    multiplier: jax.Array,
    rows: PolicyRows,
    cost_excess: jax.Array,
    tagged: dict[Tag, jax.Array],
) -> tuple[TrainState, jax.Array, Metrics]:
    """Updates every agent's policy and its multipliers; then the noise of actions falls (`std_half_life`).

    Args:
      rows: leaves [N, R, ...]; cost_excess: [N, K] in cost per step.

    Returns:
      actors, multipliers [N, K] and metrics, means over agents (`kl_per_agent` [N] in the agents' own order).
    """
    update = {"sequential": _sequential, "simultaneous": _simultaneous}[setup.method.order]
    actor, multiplier, metrics = update(setup, hyper, actor, multiplier, rows, cost_excess, tagged)
    kl = metrics.pop("kl_per_agent")
    std_left = jnp.exp2(-setup.config.batch_size / hyper.std_half_life)
    actor = dataclasses.replace(actor, params=setup.nets.scale_std(actor.params, std_left))
    return actor, multiplier, {**{k: x.mean(0) for k, x in metrics.items()}, "kl_per_agent": kl}


def policy_rows(
    setup: Setup,
    hyper: Hyper,
    multiplier: jax.Array,
    batch: Batch,
    advantage: jax.Array,
    cost_advantage: jax.Array,
    log_weight: jax.Array,
) -> PolicyRows:
    """The batch as every agent's policy sees it, leaves [N, R, ...].

    Args:
      multiplier: [N, K]; advantage: [T, B]; cost_advantage: [T, B, N, K]; log_weight: [T, B, N].
    """
    _, advantage = standardise(advantage)
    centred, scaled = standardise(cost_advantage, hyper.cost_std_floor)
    scaled_cost = scaled if setup.config.cost_advantage == "std" else centred
    if setup.config.regret_response == "advantage":
        scaled_cost, log_weight = scaled_cost * jnp.exp(-log_weight)[..., None], jnp.zeros_like(log_weight)
    price = multiplier * (setup.method.constraint == "lagrangian")
    hybrid = hybrid_advantage(advantage[..., None], scaled_cost, price)
    if setup.config.regret_response == "one_sided":
        log_weight = log_weight * jnp.sign(hybrid)
    rows = PolicyRows(
        obs=batch.obs,
        action=batch.action,
        mask=jnp.broadcast_to(jnp.asarray(setup.vector.spec.action_mask), batch.action.shape),
        log_prob=batch.log_prob,
        mean=batch.mean,
        std=batch.std,
        advantage=hybrid,
        cost_advantage=centred,
        log_weight=log_weight,
        factor=jnp.ones_like(batch.log_prob),
    )
    return jax.tree.map(lambda x: jnp.moveaxis(x.reshape(-1, *x.shape[2:]), 1, 0), rows)


def _sequential(
    setup: Setup,
    hyper: Hyper,
    actor: TrainState,
    multiplier: jax.Array,
    rows: PolicyRows,
    cost_excess: jax.Array,
    tagged: dict[Tag, jax.Array],
) -> tuple[TrainState, jax.Array, Metrics]:
    """Updates agents in random order, each corrected by the ratios of those before it (HAPPO)."""

    def one_agent(
        carry: tuple[TrainState, jax.Array, jax.Array], i: jax.Array
    ) -> tuple[tuple[TrainState, jax.Array, jax.Array], Metrics]:
        actor, multiplier, factor = carry
        mine = dataclasses.replace(_select_agent(rows, i), factor=factor)
        key = jax.random.fold_in(tagged[Tag.ACTOR], i)
        excess = cost_excess[i] + multiplier[i]  # beyond a lowered limit; only a trust region uses it
        net, metrics = update_policy(setup, hyper, _select_agent(actor, i), mine, excess, key)
        log_ratio, metrics["kl_per_agent"] = _policy_change(setup, net.params, mine)
        updated = _update_multiplier(setup, hyper, multiplier[i], mine, cost_excess[i], log_ratio, metrics)
        actor = jax.tree.map(lambda all_, one: all_.at[i].set(one), actor, net)
        # The factor corrects the distribution of the executed joint action: no regret weight in it.
        return (actor, multiplier.at[i].set(updated), factor * jnp.exp(log_ratio)), metrics

    order = jax.random.permutation(tagged[Tag.ORDER], setup.nets.num_agents)
    start = (actor, multiplier, jnp.ones_like(rows.factor[0]))
    (actor, multiplier, _), metrics = jax.lax.scan(one_agent, start, order)
    metrics["kl_per_agent"] = metrics["kl_per_agent"][jnp.argsort(order)]
    return actor, multiplier, metrics


def _simultaneous(
    setup: Setup,
    hyper: Hyper,
    actor: TrainState,
    multiplier: jax.Array,
    rows: PolicyRows,
    cost_excess: jax.Array,
    tagged: dict[Tag, jax.Array],
) -> tuple[TrainState, jax.Array, Metrics]:
    """Updates all agents from the same policies; a shared actor is fitted to the rows of all agents."""
    actors = setup.nets.num_actors
    keys = jax.vmap(jax.random.fold_in, (None, 0))(tagged[Tag.ACTOR], jnp.arange(actors))
    per_actor = jax.tree.map(lambda x: x.reshape(actors, -1, *x.shape[2:]), rows)
    cost_excesses = (cost_excess + multiplier).reshape(actors, -1, cost_excess.shape[-1]).mean(1)
    one = jax.vmap(lambda *each: update_policy(setup, hyper, *each))
    actor, metrics = one(actor, per_actor, cost_excesses, keys)

    def of_all(x: jax.Array) -> jax.Array:
        return jnp.broadcast_to(x, (setup.nets.num_agents, *x.shape[1:]))

    params = jax.tree.map(of_all, actor.params)
    log_ratio, metrics["kl_per_agent"] = jax.vmap(lambda *each: _policy_change(setup, *each))(params, rows)
    updated = jax.vmap(lambda *each: _update_multiplier(setup, hyper, *each))(
        multiplier, rows, cost_excess, log_ratio, jax.tree.map(of_all, metrics)
    )
    return actor, updated, metrics


def _select_agent(tree: Any, i: jax.Array) -> Any:
    """Agent i's part of a pytree with leading [N]."""
    return jax.tree.map(lambda x: x[i], tree)


def _policy_change(setup: Setup, params: Params, rows: PolicyRows) -> tuple[jax.Array, jax.Array]:
    """How far a policy is from the one that acted: log-ratios [R], and the mean KL(old || new) in nats."""
    rows = sharding.shard(rows)
    mean, std = setup.nets.policy(params, rows.obs)
    kl = distributions.kl(rows.mean, rows.std, mean, std, rows.mask).mean()
    return distributions.log_prob(rows.action, mean, std, rows.mask) - rows.log_prob, kl


def _update_multiplier(
    setup: Setup,
    hyper: Hyper,
    multiplier: jax.Array,
    rows: PolicyRows,
    cost_excess: jax.Array,
    log_ratio: jax.Array,
    metrics: Metrics,
) -> jax.Array:
    """One agent's multipliers [K], or what its limits are lowered by, given how its policy has changed."""
    if setup.method.constraint == "none":
        return multiplier
    if setup.method.constraint == "trust_region":
        return lagrangian.lowered_limit(multiplier, cost_excess, hyper.limit_lr, hyper.limit_windup * metrics["reach"])
    surrogate = lagrangian.surrogate_cost(log_ratio, rows.log_weight, rows.cost_advantage)
    surrogate = hyper.surrogate_weight * surrogate
    excess = in_lambda_unit(setup, hyper, cost_excess + surrogate)
    if setup.config.lambda_unit == "relative":
        lowest = LOWEST * hyper.lambda_init
        return lagrangian.relative_update(multiplier, excess, hyper.lambda_lr, lowest, hyper.lambda_max)
    return lagrangian.dual_update(multiplier, excess, hyper.lambda_lr, hyper.lambda_max)


def in_lambda_unit(setup: Setup, hyper: Hyper, excess: jax.Array) -> jax.Array:
    """An excess [..., K] in cost per step, in the unit that the multiplier's gains are for."""
    if setup.config.lambda_unit == "step":
        return excess
    # In proportion to itself, a multiplier falls as fast without costs as it rises with too many.
    margin = hyper.cost_margin if setup.config.lambda_unit == "relative" else 0.0
    return lagrangian.in_limits(excess, held_limit(hyper, margin), setup.vector.horizon)


def update_policy(
    setup: Setup, hyper: Hyper, net: TrainState, rows: PolicyRows, cost_excess: jax.Array, key: jax.Array
) -> tuple[TrainState, Metrics]:
    """One policy's step on its rows [R, ...], given how far its costs [K] are beyond their limits."""
    if setup.method.constraint == "trust_region":
        return _trust_region_steps(setup, hyper, net, rows, cost_excess, key)
    return _clipped_epochs(setup, hyper, net, rows, key)


def _clipped_epochs(
    setup: Setup, hyper: Hyper, net: TrainState, rows: PolicyRows, key: jax.Array
) -> tuple[TrainState, Metrics]:
    """Epochs of clipped policy gradient (PPO)."""

    def loss(params: Params, rows: PolicyRows) -> tuple[jax.Array, Metrics]:
        mean, std = setup.nets.policy(params, rows.obs)
        log_ratio = distributions.log_prob(rows.action, mean, std, rows.mask) - rows.log_prob
        gain = clipped_surrogate(log_ratio, rows.log_weight, rows.advantage, rows.factor, hyper.clip)
        entropy = distributions.entropy(std, rows.mask).mean()
        outside = jnp.abs(jnp.exp(log_ratio + rows.log_weight) - 1) > hyper.clip
        metrics = {"entropy": entropy, "clipped": outside.mean(), "std": (std * rows.mask).sum() / rows.mask.sum()}
        return -gain.mean() - hyper.entropy_coef * entropy, metrics

    passes = {"epochs": setup.config.epochs, "minibatches": setup.config.minibatches}
    new, metrics = fit(net, loss, rows, key, learning_rate=hyper.actor_lr, max_grad_norm=hyper.max_grad_norm, **passes)
    params, metrics["share_of_step"] = _limit_kl(setup, hyper.kl_max, net.params, new.params, rows)
    return TrainState(params, new.opt_state), metrics


def _limit_kl(
    setup: Setup, kl_max: jax.Array | float, old: Params, new: Params, rows: PolicyRows
) -> tuple[Params, jax.Array]:
    """Weights on the way from `old` to `new` where KL(old || new) is about `kl_max`, and that share of the way; `new`
    itself, bit for bit, and 1 where it is no further. To second order the divergence is the way's square.
    """
    _, kl = _policy_change(setup, new, rows)
    share = jnp.sqrt(jnp.minimum(1.0, kl_max / jnp.maximum(kl, 1e-12)))
    return jax.tree.map(lambda x, y: jnp.where(share < 1, x + share * (y - x), y), old, new), share


def _trust_region_steps(
    setup: Setup, hyper: Hyper, net: TrainState, rows: PolicyRows, cost_excess: jax.Array, key: jax.Array
) -> tuple[TrainState, Metrics]:
    """`trust_steps` constrained steps (MACPO), each on its part of the shuffled rows; one step takes the whole batch.

    The optimiser's state is not touched. With several costs each step constrains the one most beyond its limit.
    """
    start, unravel = ravel_pytree(net.params)
    spread = rows.cost_advantage.std(0) + 1e-5
    worst = jnp.argmax(cost_excess / spread)
    rows = dataclasses.replace(rows, cost_advantage=rows.cost_advantage[:, worst])
    steps = setup.config.trust_steps
    if steps > 1:
        shuffle = shuffled(key, rows.log_prob.shape[0])
        rows = jax.tree.map(lambda x: x[shuffle], rows)
    parts = jax.tree.map(lambda x: x.reshape(steps, -1, *x.shape[1:]), rows)

    def one_step(flat: jax.Array, part: PolicyRows) -> tuple[jax.Array, Metrics]:
        return _trust_region_step(setup, hyper, flat, unravel, part, cost_excess[worst])

    flat, metrics = jax.lax.scan(one_step, start, parts)
    return TrainState(unravel(flat), net.opt_state), jax.tree.map(lambda x: x.mean(0), metrics)


def _trust_region_step(
    setup: Setup, hyper: Hyper, start: jax.Array, unravel: Any, rows: PolicyRows, cost_excess: jax.Array
) -> tuple[jax.Array, Metrics]:
    """One constrained step from the flat weights `start` [P]: direction, line search.

    This is CPO's update (Achiam et al., 2017, section 6), as MACPO takes it for one agent.
    """
    rows = sharding.shard(rows)

    def policy(flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        return setup.nets.policy(unravel(flat), rows.obs)

    mean0, std0 = jax.lax.stop_gradient(policy(start))

    def objectives(flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Loss and cost surrogates."""
        mean, std = policy(flat)
        log_ratio = distributions.log_prob(rows.action, mean, std, rows.mask) - rows.log_prob
        ratio = jnp.exp(log_ratio + rows.log_weight)  # weighted by regret as in Eq. 15
        return -jnp.mean(rows.factor * ratio * rows.advantage), jnp.mean(rows.factor * ratio * rows.cost_advantage)

    def divergence(flat: jax.Array) -> jax.Array:
        return distributions.kl(mean0, std0, *policy(flat), rows.mask).mean()

    (loss0, cost0), pull = jax.vjp(objectives, start)
    one, zero = jnp.ones_like(loss0), jnp.zeros_like(loss0)
    (g,), (b,) = pull((one, zero)), pull((zero, one))
    _, fisher = jax.linearize(jax.grad(divergence), start)
    # What the steps before this one are expected to have changed counts towards the limit.
    c = cost_excess + cost0 - jnp.mean(rows.factor * jnp.exp(rows.log_weight) * rows.cost_advantage)
    uncoupled, _ = ravel_pytree(setup.nets.is_std(unravel(start)))
    direction = trust_region.constrained_direction(
        g, b, c, lambda v: fisher(v) + hyper.damping * v, hyper.kl_limit, uncoupled
    )

    def accept(flat: jax.Array) -> jax.Array:
        loss, cost = objectives(flat)
        kl = divergence(flat)
        better = (loss < loss0) | (direction.case <= 1)
        safe = cost - cost0 <= jnp.maximum(-c, 0.0)
        finite = jnp.isfinite(loss) & jnp.isfinite(cost) & jnp.isfinite(kl)
        return (kl <= hyper.kl_slack * hyper.kl_limit) & better & safe & finite

    flat, tried = trust_region.backtrack(accept, start, direction.step, hyper.first_step, hyper.step_decay)
    loss, _ = objectives(flat)
    _, std = policy(flat)
    return flat, {
        "loss": loss,
        "entropy": distributions.entropy(std, rows.mask).mean(),
        "std": (std * rows.mask).sum() / rows.mask.sum(),
        "case": direction.case.astype(loss.dtype),
        "reach": direction.reach,
        "line_search_steps": tried.astype(loss.dtype),
    }
