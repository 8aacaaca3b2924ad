"""One learner for all methods: an update reads from top to bottom like the paper's Algorithms 1 and 2."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from .. import tasks
from ..config.settings import Config, Hyper
from ..errors import UsageError
from . import constraint, critics, fear, letter, regret, rollout, schedules, sharding
from .debug import check_finite, watched
from .maths import running_moments
from .maths.advantages import gae
from .optimise import init_train_state
from .policies import Team, policy_samples, update_policies
from .setup import Setup, make_setup
from .types import Batch, Critic, LearnerState, Metrics, Tag, TrainState

Train = Callable[..., tuple[LearnerState, Metrics]]


def make_train(config: Config, env: tasks.Env | None = None) -> Train:
    """The whole training as one pure function of a key; vmap it over keys to train seeds, over `hyper` to sweep.

    Args:
      config: the run's settings.
      env: an environment of your own, in place of `config.task`.

    Returns:
      train: (key, hyper=the config's) -> (LearnerState, Metrics with a leading [updates]).

    Raises:
      UsageError: the settings cannot be used, or name a run to start from.

    Examples:
      >>> from pmt_jax import load_config
      >>> train = make_train(load_config("lane", num_envs=8, steps=200, log_interval=1))
      >>> keys = jax.random.split(jax.random.key(0), 2)
      >>> state, metrics = jax.jit(jax.vmap(train))(keys)
      >>> metrics["violation_rate"].shape
      (2, 1)
    """
    setup = make_setup(config, env)
    if config.init:
        raise UsageError("make_train starts anew; init is for pmt train, which reads run folders")

    def train(key: jax.Array, hyper: Hyper = setup.hyper) -> tuple[LearnerState, Metrics]:
        return train_chunk(setup, hyper, init(setup, hyper, key), config.num_updates)

    return train


def train_chunk(setup: Setup, hyper: Hyper, state: LearnerState, updates: int) -> tuple[LearnerState, Metrics]:
    """`updates` updates in one scan; metrics have a leading [updates]."""
    return jax.lax.scan(lambda s, _: train_step(setup, hyper, s), state, length=updates)


def train_some(
    setup: Setup, hyper: Hyper, state: LearnerState, updates: jax.Array, most: int
) -> tuple[LearnerState, Metrics]:
    """As `train_chunk`, but one program trains any number of `updates`, [] int32 up to `most`.

    Returns:
      the state, and metrics with a leading [most]; those from `updates` on are 0.
    """
    update = jax.jit(partial(train_step, setup), inline=True)  # traced once, for the shapes and for the loop
    _, like = jax.eval_shape(update, hyper, state)
    nothing = jax.tree.map(lambda x: jnp.zeros((most, *x.shape), x.dtype), like)

    def step(i: jax.Array, carry: tuple[LearnerState, Metrics]) -> tuple[LearnerState, Metrics]:
        state, seen = carry
        state, metrics = update(hyper, state)
        return state, jax.tree.map(lambda x, new: x.at[i].set(new), seen, metrics)

    return jax.lax.fori_loop(0, updates, step, (state, nothing))


def init(setup: Setup, hyper: Hyper, key: jax.Array) -> LearnerState:
    """The state before the first update of the run that `key` names."""
    spec = setup.vector.spec
    tagged = {tag: jax.random.fold_in(key, tag) for tag in Tag}
    heads = (spec.num_agents, spec.num_costs)
    return LearnerState(
        actor=jax.vmap(init_train_state)(setup.nets.init_actor(tagged[Tag.ACTOR])),
        critic=Critic(
            init_train_state(setup.nets.init_critic(tagged[Tag.CRITIC])),
            running_moments.init((spec.num_agents,) if setup.own_critics else ()),
        ),
        cost_critic=Critic(
            init_train_state(setup.nets.init_cost_critic(tagged[Tag.COST_CRITIC])), running_moments.init(heads)
        ),
        fear=_init_fear(setup, tagged[Tag.FEAR]) if setup.method.cost_signal == "fear" else None,
        regret=(
            jax.vmap(init_train_state)(setup.nets.init_regret(tagged[Tag.REGRET]))
            if setup.method.ratio_weight == "regret"
            else None
        ),
        constraint=constraint.init(setup, hyper),
        largest_cost=jnp.zeros(heads),
        obs_moments=running_moments.init((spec.obs_dim,)),
        state_moments=running_moments.init((spec.state_dim,)),
        rollout=rollout.start(
            setup.vector,
            tagged[Tag.ENV],
            setup.config.episode_starts == "spread",
            setup.nets.start(setup.vector.num_envs),
        ),
        key=tagged[Tag.UPDATE],
        update=jnp.zeros((), jnp.int32),
    )


def _init_fear(setup: Setup, key: jax.Array) -> TrainState:
    if setup.method.letter:
        return letter.init_fear(setup, key)
    return init_train_state(setup.nets.init_fear(key, jnp.nan))


def train_step(setup: Setup, hyper: Hyper, state: LearnerState) -> tuple[LearnerState, Metrics]:
    """One update: act, appraise, estimate advantages, fit the critics, update the policies."""
    setup = dataclasses.replace(setup, nets=setup.nets.fast)
    key = jax.random.fold_in(state.key, state.update)
    tagged = {tag: jax.random.fold_in(key, tag) for tag in Tag}
    now = schedules.at(setup.config, hyper, state.update)

    # 1 Information source: the team acts.
    memory = state.rollout.memory
    state, batch = act(setup, hyper, state, tagged)

    # 2 Threat appraisal: what counts as danger, and how much an action is regretted.
    largest = jnp.maximum(state.largest_cost, batch.cost.max((0, 1)))
    appraised = _appraise(setup, hyper, now, state, batch, largest, tagged)
    (fear_net, cost_signal, fear_metrics), (regret_nets, log_weight, regret_metrics) = appraised

    # 3 Advantages of reward and of danger, which counts in units of the limit.
    (seen, value, next_value), cost_valued, after = critics.appraise(setup, state, batch, memory)
    cost_seen, cost_value, next_cost_value = cost_valued
    ends = (batch.terminated, batch.done, hyper.gamma, hyper.gae_lambda)
    cost_signal = constraint.in_unit(setup, hyper, cost_signal)
    advantage, returns = gae(batch.reward[..., None] if setup.own_critics else batch.reward, value, next_value, *ends)
    cost_advantage, cost_returns = gae(cost_signal, cost_value, next_cost_value, *ends)

    # 4 The constraint: how far costs are beyond the limit, and what the policies pay for them.
    previous = state.constraint.estimate
    estimate = constraint.estimate_cost(setup, hyper, batch, previous, cost_value)
    excess = constraint.cost_excess(setup, hyper, estimate)
    price = partial(constraint.price, setup, hyper, excess=excess, estimate=previous)
    held = constraint.integrate(setup, hyper, state.constraint, excess)
    signals = (advantage, cost_advantage, log_weight, memory and memory.actor)
    actor_samples = policy_samples(setup, price(held.multiplier), batch, *signals)

    # 5 Critics, and coping response: every agent's policy, and its multipliers.
    samples, cost_samples = (seen, value, returns), (cost_seen, cost_value, cost_returns)
    fit_critic, clip = partial(critics.fit_critic, setup, hyper, now), critics.clip_of_costs(setup, hyper)
    team = Team(state.actor, dataclasses.replace(held, estimate=estimate), actor_samples, excess)
    fitted = sharding.in_parallel(
        partial(fit_critic, state.critic, setup.nets.value, hyper.clip, samples, tagged[Tag.CRITIC]),
        partial(fit_critic, state.cost_critic, setup.nets.cost_value, clip, cost_samples, tagged[Tag.COST_CRITIC]),
        partial(update_policies, setup, hyper, now, team, tagged),
    )
    (critic, critic_metrics), (cost_critic, cost_critic_metrics), (actor, held, actor_metrics) = fitted

    computed = {"batch": batch, "cost_signal": cost_signal, "log_weight": log_weight, "advantage": advantage}
    computed |= {"returns": returns, "cost_advantage": cost_advantage, "cost_returns": cost_returns}
    learned = {"critic": critic, "cost_critic": cost_critic, "fear": fear_net, "regret": regret_nets, "actor": actor}
    learned |= {"constraint": held, "largest_cost": largest}
    check_finite(setup, state.update, **computed, **learned)
    state = dataclasses.replace(state, **learned, rollout=after, update=state.update + 1)
    return state, {
        **rollout.summary(batch, setup.shares_cost),
        **rollout.limit_metrics(batch, hyper),
        **constraint.metrics(setup, held, price(held.multiplier), excess),
        **_named("critic", critic_metrics),
        **_named("cost_critic", cost_critic_metrics),
        **_named("actor", actor_metrics),
        **_named("fear", fear_metrics),
        **_named("regret", regret_metrics),
    }


def _appraise(
    setup: Setup,
    hyper: Hyper,
    now: schedules.Schedule,
    state: LearnerState,
    batch: Batch,
    largest: jax.Array,
    tagged: dict[Tag, jax.Array],
) -> tuple[Any, ...]:
    """What fear and regret make of a batch: each its networks, what it computes, and metrics.

    Args:
      largest: [N, K], the largest cost of a step so far.
    """
    fear_of, regret_of = (letter, letter) if setup.method.letter else (fear, regret)
    return sharding.in_parallel(
        partial(fear_of.appraise_fear, setup, hyper, now, state.fear, batch, largest, tagged[Tag.FEAR]),
        partial(regret_of.appraise_regret, setup, hyper, now, state.regret, batch, tagged[Tag.REGRET]),
    )


def _named(part: str, metrics: Metrics) -> Metrics:
    return {f"{part}/{name}": x for name, x in metrics.items()}


def act(setup: Setup, hyper: Hyper, state: LearnerState, tagged: dict[Tag, jax.Array]) -> tuple[LearnerState, Batch]:
    """Collects a batch with the moments of observations frozen, then adds what was seen to the moments."""
    normalisers = (
        partial(setup.scale, state.obs_moments),
        partial(setup.scale, state.state_moments),
    )

    def observe(cost: jax.Array, t: jax.Array) -> jax.Array:
        return tasks.observed_cost(cost, jax.random.fold_in(tagged[Tag.OBSERVED_COST], t), hyper.cost_seen)

    after, batch, (obs, global_state) = rollout.collect(
        watched(setup, state.update),
        state.rollout,
        partial(setup.nets.act, state.actor.params),
        normalisers,
        tagged[Tag.ACTION],
        setup.config.rollout_length,
        observe,
        setup.own_critics,
    )
    moments = (
        running_moments.accumulate(state.obs_moments, obs),
        running_moments.accumulate(state.state_moments, global_state),
    )
    return dataclasses.replace(state, rollout=after, obs_moments=moments[0], state_moments=moments[1]), batch
