"""Rollout: the team acts in all environments for some steps, and a batch keeps observations, actions and costs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import limits
from ..tasks import Outcome, State, VectorEnv
from . import sharding
from .maths import distributions, gru
from .setup import limit_less_margin
from .types import Batch, Hyper, Memory, RolloutState, Sequences

Hidden = jax.Array | None  # [B, N, H]; None of policies that are not recurrent
# obs [B, N, O], hidden -> mean [B, N, A], std [N, A], hidden
GaussianPolicy = Callable[[jax.Array, Hidden], tuple[jax.Array, jax.Array, Hidden]]
Normalise = Callable[[jax.Array], jax.Array]
ObserveCost = Callable[[jax.Array, jax.Array], jax.Array]  # true cost [B, N, K], the step's number -> observed cost


def start(vector: VectorEnv, key: jax.Array, spread: bool = False, memory: Memory | None = None) -> RolloutState:
    """Fresh episodes everywhere, nothing summed yet.

    Args:
      spread: the time limit counts as if environment b of B had spent b / B of an episode, so that it ends episodes
        evenly over time. The first episodes are cut short by that, and no metric of episodes counts them.
      memory: of recurrent networks, see `Networks.start`.
    """
    spec = vector.spec
    first = vector.reset(key)
    if spread:
        elapsed = np.arange(vector.num_envs) * vector.horizon // vector.num_envs
        first = dataclasses.replace(first, elapsed=jnp.asarray(elapsed, first.elapsed.dtype))
    zero = jnp.zeros(vector.num_envs)
    zeros = jnp.zeros((vector.num_envs, spec.num_agents, spec.num_costs))
    return RolloutState(
        vector=first,
        reward_sum=zero,
        cost_sum=zeros,
        true_cost_sum=zeros,
        length=jnp.zeros(vector.num_envs, jnp.int32),
        memory=memory,
    )


def collect(
    vector: VectorEnv,
    state: RolloutState,
    policy: GaussianPolicy,
    normalise: tuple[Normalise, Normalise],
    key: jax.Array,
    steps: int,
    observe: ObserveCost = lambda cost, t: cost,
    keep_next_obs: bool = False,
) -> tuple[RolloutState, Batch, tuple[jax.Array, jax.Array]]:
    """`steps` control steps of all environments under `policy`, with actions drawn from `key`.

    Args:
      policy: of normalised observations, and of the actors' hidden states, which are reset where an episode ends.
      normalise: for observations and for global states.
      observe: what of a step's cost the learner observes; all of it by default.
      keep_next_obs: the batch has them, for critics of observations.

    Returns:
      the state to continue from, the batch [T, B, ...], and the raw observations and states [T, B, ...] seen.
    """
    mask = jnp.asarray(vector.spec.action_mask)
    normalise_obs, normalise_state = normalise
    step_per_device = sharding.per_device(vector.step)

    def step(state: RolloutState, t: jax.Array) -> tuple[RolloutState, tuple[Batch, tuple[jax.Array, jax.Array]]]:
        env: State = state.vector.env
        obs = normalise_obs(env.obs)
        mean, std, hidden = policy(obs, state.memory and state.memory.actor)
        action = mean + std * jax.random.normal(jax.random.fold_in(key, t), mean.shape)
        next_vector, outcome = step_per_device(state.vector, action * mask)
        observed = observe(outcome.cost, t)
        sums = RolloutState(
            next_vector,
            state.reward_sum + outcome.reward,
            state.cost_sum + observed,
            state.true_cost_sum + outcome.cost,
            state.length + 1,
            state.memory and dataclasses.replace(state.memory, actor=hidden),
        )
        seen = {
            "obs": obs,
            "action": action,
            "log_prob": distributions.log_prob(action, mean, std, mask),
            "mean": mean,
            "std": jnp.broadcast_to(std, mean.shape),
            "state": normalise_state(env.global_state),
            "next_state": normalise_state(outcome.next_global_state),
            "cost": observed,
            "whole": state.vector.elapsed == state.length,
            "next_obs": normalise_obs(outcome.next_obs) if keep_next_obs else None,
        }
        return _clear_finished(sums, outcome), (_record(seen, outcome, sums), (env.obs, env.global_state))

    state, (batch, raw) = jax.lax.scan(step, state, jnp.arange(steps))
    return state, batch, raw


def _record(seen: dict[str, Any], outcome: Outcome, sums: RolloutState) -> Batch:
    return Batch(
        **seen,
        reward=outcome.reward,
        true_cost=outcome.cost,
        terminated=outcome.terminated,
        truncated=outcome.truncated,
        info=outcome.info,
        non_finite=outcome.non_finite,
        cost_out_of_range=outcome.cost_out_of_range,
        episode_reward=sums.reward_sum,
        episode_cost=sums.cost_sum,
        true_episode_cost=sums.true_cost_sum,
        episode_length=sums.length,
    )


def _clear_finished(sums: RolloutState, outcome: Outcome) -> RolloutState:
    going = ~(outcome.terminated | outcome.truncated)
    each = going[:, None, None]
    costs = (sums.cost_sum * each, sums.true_cost_sum * each)
    memory = sums.memory and dataclasses.replace(sums.memory, actor=gru.reset(sums.memory.actor, ~going))
    return RolloutState(sums.vector, sums.reward_sum * going, *costs, sums.length * going, memory)


def finished_mean(batch: Batch, x: jax.Array) -> jax.Array:
    """Mean of `x` [T, B, ...] over the steps that ended a whole episode; nan if none did."""
    finished = batch.finished.reshape(batch.done.shape + (1,) * (x.ndim - 2))
    return jnp.sum(x * finished, (0, 1)) / finished.sum()  # 0 / 0 is nan


def limit_metrics(batch: Batch, hyper: Hyper) -> dict[str, jax.Array]:
    """Metrics of the episodes that ended, against their limits: scalars, nan if none ended.

    within_limit: share of them in which each cost of each agent is within its limit. episode_cost_beyond: their mean
    cost beyond it, 0 of an episode within it, in the limit's unit: that of the agent furthest beyond, of several costs
    the sum.
    """
    beyond = cost_beyond(batch.episode_cost, batch.true_episode_cost, hyper)
    return {
        "within_limit": finished_mean(batch, jnp.all(beyond == 0, axis=(-2, -1))),
        "episode_cost_beyond": finished_mean(batch, beyond.max(-2).sum(-1)),
    }


def cost_beyond(observed: jax.Array, true: jax.Array, hyper: Hyper) -> jax.Array:
    """How far episode costs [..., K] are beyond their limits, 0 within: the true one, of several each observed one.

    The limit is on observed costs, so a true cost counts as the observed one that it is expected to give.
    """
    cost = observed if observed.shape[-1] > 1 else hyper.cost_seen * true
    return jnp.maximum(limits.excess(cost, limit_less_margin(hyper, 0.0), jnp), 0.0)


def summary(batch: Batch, shares_cost: bool = False) -> dict[str, jax.Array]:
    """Metrics of a batch, scalars; episode metrics are means over the episodes that ended (nan if none did).

    episode_reward, episode_cost: undiscounted sums over an episode, the cost of one agent (mean over agents; costs
    summed over K), and next to it each agent's and cost's, see `limits.columns`. violation_rate: share of steps with a
    cost above 0 for some agent. step_reward, step_cost: means per step. Costs are as observed; true_episode_cost,
    true_violation_rate and true_step_cost are the same of the true costs (see `envs.vector.observed_cost`).

    Args:
      shares_cost: whether the task declares that agents share their costs; `cost_spread` then says how far they differ.
    """
    cost, true_cost = batch.cost.sum(-1), batch.true_cost.sum(-1)
    spread = {"cost_spread": (batch.true_cost.max(2) - batch.true_cost.min(2)).max()} if shares_cost else {}
    return {
        "episode_reward": finished_mean(batch, batch.episode_reward),
        "episode_cost": finished_mean(batch, batch.episode_cost.sum(-1).mean(-1)),
        "episode_length": finished_mean(batch, batch.episode_length),
        "episodes": batch.finished.sum(),
        "terminations": (batch.terminated & batch.whole).sum(),
        "violation_rate": (cost.max(-1) > 0).mean(),
        "step_reward": batch.reward.mean(),
        "step_cost": cost.mean(),
        "true_episode_cost": finished_mean(batch, batch.true_episode_cost.sum(-1).mean(-1)),
        "true_violation_rate": (true_cost.max(-1) > 0).mean(),
        "true_step_cost": true_cost.mean(),
        "non_finite": batch.non_finite.sum(),
        "cost_out_of_range": batch.cost_out_of_range.sum(),
        "worst_cost": _worst_cost(batch),
        **spread,
        **_each_cost("episode_cost", finished_mean(batch, batch.episode_cost), shares_cost),
        **_each_cost("true_episode_cost", finished_mean(batch, batch.true_episode_cost), shares_cost),
        **{f"info/{name}": x.mean() for name, x in batch.info.items()},
    }


def _each_cost(name: str, mean: jax.Array, shares_cost: bool) -> dict[str, jax.Array]:
    return limits.worst(name, mean, shares_cost) | limits.columns(name, mean, shares_cost)


def _worst_cost(batch: Batch) -> jax.Array:
    """The true cost that is farthest outside [0, 1], []; nan if all are within."""
    low, high = batch.true_cost.min(), batch.true_cost.max()
    worst = jnp.where(-low > high - 1, low, high)
    return jnp.where(batch.cost_out_of_range.any(), worst, jnp.nan)


def flatten_steps(x: jax.Array) -> jax.Array:
    """[T, B, ...] as samples [R, ...]."""
    return x.reshape(-1, *x.shape[2:])


def rows(tree: Any) -> Any:
    """Arrays of a batch [T, B, ...] as rows to fit on: steps [T B, ...], or with `Sequences` among them [B, T, ...]."""

    def is_whole(x: Any) -> bool:
        return isinstance(x, Sequences)

    whole = any(map(is_whole, jax.tree.leaves(tree, is_leaf=is_whole)))
    arrange = (lambda x: x.swapaxes(0, 1)) if whole else flatten_steps
    return jax.tree.map(lambda x: x if is_whole(x) else arrange(x), tree, is_leaf=is_whole)


def sequences(x: jax.Array, hidden: jax.Array, done: jax.Array) -> Sequences:
    """What a recurrent network saw in a batch: x [T, B, ...], done [T, B], and its `hidden` [B, ..., H] before it."""
    return Sequences(x.swapaxes(0, 1), hidden, done.swapaxes(0, 1))
