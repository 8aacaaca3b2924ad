"""Policy updates: agent after agent or all at once, by clipped epochs or by a trust-region step."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from . import sharding
from .constraint import respond, weights
from .maths import distributions
from .maths.advantages import standardise
from .maths.losses import clipped_penalty, clipped_surrogate, first_order_surrogate, hybrid_advantage
from .optimise import Loss, fit
from .rollout import flatten_steps
from .schedules import Schedule
from .setup import Setup
from .trust_region import trust_region_step
from .types import Batch, Constraint, Hyper, Metrics, Params, PolicySamples, Sequences, Tag, TrainState

COST_STD_FLOOR = 2.0  # in units of the limit, so that a batch nearly without cost does not become noise of unit size


class Team(NamedTuple):
    """What an update of policies takes: actors, constraints [N, K], samples [N, R, ...], excess [N, K]."""

    actor: TrainState
    constraint: Constraint
    samples: PolicySamples
    excess: jax.Array


def update_policies(
    setup: Setup, hyper: Hyper, now: Schedule, team: Team, tagged: dict[Tag, jax.Array]
) -> tuple[TrainState, Constraint, Metrics]:
    """Updates every agent's policy and its constraint.

    Returns:
      actors, constraints [N, K] and metrics, means over agents (`kl_per_agent` [N] in the agents' own order).
    """
    update = {"sequential": _sequential, "simultaneous": _simultaneous}[setup.method.order]
    actor, constraint, metrics = update(setup, hyper, now, team, tagged)
    kl = metrics.pop("kl_per_agent")
    return actor, constraint, {**{k: x.mean(0) for k, x in metrics.items()}, "kl_per_agent": kl}


def policy_samples(
    setup: Setup,
    price: jax.Array,
    batch: Batch,
    advantage: jax.Array,
    cost_advantage: jax.Array,
    log_weight: jax.Array,
    hidden: jax.Array | None = None,
) -> PolicySamples:
    """The batch as every agent's policy sees it, leaves [N, R, ...]; of a recurrent one [N, B, T, ...].

    Args:
      price: [N, K], what a cost counts; advantage: [T, B], or [T, B, N] of critics of observations; cost_advantage:
        [T, B, N, K]; log_weight: [T, B, N], or with one that moves in the epochs [T, B, N, epochs + 1]; hidden:
        [B, N, H] of recurrent actors before the batch, else None.
    """
    letter = setup.method.letter
    centred = scaled = cost_advantage
    if not letter:
        _, advantage = standardise(advantage)
        centred, scaled = standardise(cost_advantage, COST_STD_FLOOR)
    reward_weight, cost_weight = weights(setup, price)
    each = advantage.reshape(*advantage.shape[:2], -1)
    hybrid = hybrid_advantage(each * reward_weight, scaled, cost_weight)
    moves = log_weight.ndim > batch.log_prob.ndim
    each_agent = PolicySamples(
        obs=batch.obs,
        action=batch.action,
        mask=jnp.broadcast_to(jnp.asarray(setup.vector.spec.action_mask), batch.action.shape),
        log_prob=batch.log_prob,
        mean=batch.mean,
        std=batch.std,
        advantage=jnp.broadcast_to(each, hybrid.shape) if letter else hybrid,
        cost_advantage=centred,
        log_weight=log_weight[..., -1] if moves else log_weight,
        factor=jnp.ones_like(batch.log_prob),
        paid=jnp.sum(cost_weight * scaled, axis=-1) if letter else None,
        moving_log_weight=log_weight[..., :-1] if moves else None,
    )
    if hidden is None:
        return jax.tree.map(lambda x: jnp.moveaxis(flatten_steps(x), 1, 0), each_agent)
    samples = jax.tree.map(lambda x: x.transpose(2, 1, 0, *range(3, x.ndim)), each_agent)
    done = jnp.broadcast_to(batch.done.T, samples.log_prob.shape)
    return dataclasses.replace(samples, obs=Sequences(samples.obs, jnp.moveaxis(hidden, 1, 0), done))


def _sequential(
    setup: Setup, hyper: Hyper, now: Schedule, team: Team, tagged: dict[Tag, jax.Array]
) -> tuple[TrainState, Constraint, Metrics]:
    """Updates agents in random order, each corrected by the ratios of those before it (HAPPO)."""

    def one_agent(
        carry: tuple[TrainState, Constraint, jax.Array], i: jax.Array
    ) -> tuple[tuple[TrainState, Constraint, jax.Array], Metrics]:
        actor, constraint, factor = carry
        net, own, mine, excess = select_agent(team._replace(actor=actor, constraint=constraint), i)
        mine, key = corrected(mine, factor), jax.random.fold_in(tagged[Tag.ACTOR], i)
        net, reach, metrics = update_policy(setup, hyper, now, net, mine, excess + own.lowered, key)
        log_ratio, metrics["kl_per_agent"] = policy_change(setup, net.params, mine)
        own = respond(setup, hyper, own, mine, excess, log_ratio, reach)
        actor, constraint = jax.tree.map(lambda all_, one: all_.at[i].set(one), (actor, constraint), (net, own))
        # The factor corrects the distribution of the executed joint action: no regret weight in it.
        return (actor, constraint, factor * jnp.exp(log_ratio)), metrics

    order = jax.random.permutation(tagged[Tag.ORDER], setup.nets.num_agents)
    start = (team.actor, team.constraint, jnp.ones_like(team.samples.factor[0]))
    (actor, constraint, _), metrics = jax.lax.scan(one_agent, start, order)
    metrics["kl_per_agent"] = metrics["kl_per_agent"][jnp.argsort(order)]
    return actor, constraint, metrics


def _simultaneous(
    setup: Setup, hyper: Hyper, now: Schedule, team: Team, tagged: dict[Tag, jax.Array]
) -> tuple[TrainState, Constraint, Metrics]:
    """Updates all agents from the same policies.

    A shared actor is fitted to the samples of all agents, and held to the limit of the one that is furthest beyond.
    """
    actor, constraint, samples, excess = team
    actors = setup.nets.num_actors
    keys = jax.vmap(jax.random.fold_in, (None, 0))(tagged[Tag.ACTOR], jnp.arange(actors))
    per_actor = jax.tree.map(lambda x: x.reshape(actors, -1, *x.shape[2:]), samples)
    excesses = (excess + constraint.lowered).reshape(actors, -1, excess.shape[-1]).max(1)
    actor, reach, metrics = jax.vmap(lambda *each: update_policy(setup, hyper, now, *each))(
        actor, per_actor, excesses, keys
    )

    def of_all(x: jax.Array) -> jax.Array:
        return jnp.broadcast_to(x, (setup.nets.num_agents, *x.shape[1:]))

    params = jax.tree.map(of_all, actor.params)
    log_ratio, metrics["kl_per_agent"] = jax.vmap(lambda *each: policy_change(setup, *each))(params, samples)
    constraint = jax.vmap(lambda *each: respond(setup, hyper, *each))(
        constraint, samples, excess, log_ratio, of_all(reach)
    )
    return actor, constraint, metrics


def corrected(samples: PolicySamples, factor: jax.Array) -> PolicySamples:
    """An agent's samples with the ratios of those before it, M [R].

    With `paid` costs M weighs the reward's advantage alone, M A_r - sum_k lambda_k A_c,k: Equation 7 as printed.
    """
    if samples.paid is None:
        return dataclasses.replace(samples, factor=factor)
    return dataclasses.replace(samples, advantage=factor * samples.advantage - samples.paid)


def select_agent(tree: Any, i: jax.Array | int) -> Any:
    """Agent i's part of a pytree with leading [N]."""
    return jax.tree.map(lambda x: x[i], tree)


def policy_change(setup: Setup, params: Params, samples: PolicySamples) -> tuple[jax.Array, jax.Array]:
    """How far a policy is from the one that acted: log-ratios [R], and the mean KL(old || new) in nats."""
    samples = sharding.shard(samples)
    mean, std = setup.nets.policy(params, samples.obs)
    kl = distributions.kl(samples.mean, samples.std, mean, std, samples.mask).mean()
    return distributions.log_prob(samples.action, mean, std, samples.mask) - samples.log_prob, kl


def update_policy(
    setup: Setup,
    hyper: Hyper,
    now: Schedule,
    net: TrainState,
    samples: PolicySamples,
    violation: jax.Array,
    key: jax.Array,
) -> tuple[TrainState, jax.Array, Metrics]:
    """One policy's step on its samples [R, ...]: of a trust region, or epochs of policy gradient (PPO).

    Args:
      violation: [K] in units of the limit, how far costs are beyond what the policy is to keep, a lowered limit.

    Returns:
      the network; [] in units of the limit, the most that a trust region's step promised to take off the cost, else
      0; metrics.
    """
    if setup.method.constraint == "trust_region":
        return trust_region_step(setup, now, net, samples, violation)
    passes = {"epochs": setup.config.epochs, "minibatches": setup.config.minibatches}
    limits = {"learning_rate": now.actor_lr, "max_grad_norm": hyper.max_grad_norm}
    loss = policy_loss(setup, hyper, now, samples, violation)
    fit_all = fit if samples.moving_log_weight is None else _fit_as_weights_move
    new, metrics = fit_all(net, loss, samples, key, **limits, **passes)
    first_order = setup.method.surrogate == "first_order"
    # Nothing clips FOCOPS's ratios. The paper ends an update beyond this bound; here the step is shortened to it.
    kl_max = jnp.minimum(hyper.kl_max, now.kl_limit) if first_order else hyper.kl_max
    params, metrics["share_of_step"] = _limit_kl(setup, kl_max, net.params, new.params, samples)
    return TrainState(params, new.opt_state), jnp.zeros(()), metrics


def _fit_as_weights_move(
    net: TrainState, loss: Loss, samples: PolicySamples, key: jax.Array, *, epochs: int, **options: Any
) -> tuple[TrainState, Metrics]:
    """As `fit`, but epoch e has the weights moving_log_weight[:, e]."""

    def epoch(net: TrainState, given: tuple[jax.Array, jax.Array]) -> tuple[TrainState, Metrics]:
        rows = dataclasses.replace(samples, log_weight=given[0], moving_log_weight=None)
        return fit(net, loss, rows, given[1], epochs=1, **options)

    weights = jnp.moveaxis(jnp.asarray(samples.moving_log_weight), -1, 0)
    net, metrics = jax.lax.scan(epoch, net, (weights, jax.random.split(key, epochs)))
    return net, jax.tree.map(lambda x: x[-1], metrics)


def policy_loss(setup: Setup, hyper: Hyper, now: Schedule, samples: PolicySamples, violation: jax.Array) -> Loss:
    """What epochs minimise, of one policy's weights and a minibatch of `samples`: the method's surrogate and penalty.

    Args:
      violation: see `update_policy`; only a penalty reads it.
    """
    penalised = setup.method.constraint == "penalty"
    rows = tuple(range(samples.log_prob.ndim))
    scale = jnp.maximum(samples.cost_advantage.std(rows) + 1e-5, COST_STD_FLOOR) if penalised else 1.0

    def loss(params: Params, samples: PolicySamples) -> tuple[jax.Array, Metrics]:
        mean, std = setup.nets.policy(params, samples.obs)
        log_ratio = distributions.log_prob(samples.action, mean, std, samples.mask) - samples.log_prob
        ratios = (log_ratio, samples.log_weight)
        if setup.method.surrogate == "first_order":
            kl = distributions.kl(mean, std, samples.mean, samples.std, samples.mask)
            gain = first_order_surrogate(*ratios, samples.advantage, samples.factor, kl, now.kl_limit)
        else:
            gain = clipped_surrogate(*ratios, samples.advantage, samples.factor, hyper.clip)
        entropy = distributions.entropy(std, samples.mask).mean()
        outside = jnp.abs(jnp.exp(log_ratio + samples.log_weight) - 1) > hyper.clip
        deviation = (std * samples.mask).sum() / samples.mask.sum()
        metrics = {"entropy": entropy, "clipped": outside.mean(), "std": deviation}
        total = -gain.mean() - hyper.entropy_coef * entropy
        if penalised:
            costs = samples.cost_advantage / scale
            metrics["penalty"] = clipped_penalty(*ratios, costs, samples.factor, violation / scale, hyper.clip)
            total += hyper.lambda_max * metrics["penalty"]
        return total, metrics

    return loss


def _limit_kl(
    setup: Setup, kl_max: jax.Array | float, old: Params, new: Params, samples: PolicySamples
) -> tuple[Params, jax.Array]:
    """Weights on the way from `old` to `new` where KL(old || new) is about `kl_max`, and that share of the way; `new`
    itself, bit for bit, and 1 where it is no further. To second order the divergence is the way's square.
    """
    _, kl = policy_change(setup, new, samples)
    share = jnp.sqrt(jnp.minimum(1.0, kl_max / jnp.maximum(kl, 1e-12)))
    return jax.tree.map(lambda x, y: jnp.where(share < 1, x + share * (y - x), y), old, new), share
