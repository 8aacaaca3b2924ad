"""One learner for all methods: an update reads from top to bottom like the paper's Algorithms 1 and 2."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from . import distributions, dual, networks, normalise, rollout, tasks
from .config import HYPER_FIELDS, Config, Hyper
from .coping import clipped_surrogate, hybrid_advantage
from .fit import fit, untrained, value_loss
from .methods import METHODS, Method
from .returns import gae, standardise
from .types import Batch, Critic, LearnerState, Metrics, Params, PolicyRows, Tag, Trained

Train = Callable[..., tuple[LearnerState, Metrics]]


@dataclasses.dataclass(frozen=True)
class Run:
    """What is fixed before training: settings, a row of the method table, the task and the networks' functions."""

    config: Config
    method: Method
    vector: tasks.VectorEnv
    nets: networks.Networks

    @property
    def hyper(self) -> Hyper:
        """The numbers of `config` that are traced, as f32 scalars; a cost limit left open is the task's."""
        values = {name: getattr(self.config, name) for name in HYPER_FIELDS}
        if math.isnan(values["cost_limit"]):
            values["cost_limit"] = self.vector.spec.cost_limit
        traced: dict[str, Any] = {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}
        return Hyper(**traced)


def setup(config: Config, env: tasks.Env | None = None) -> Run:
    """Builds the task and the networks of a run.

    Args:
      env: an environment of your own, in place of `config.task`.

    Raises:
      UsageError: unknown task or task option, or an engine that cannot run here.
    """
    method = METHODS[config.method]
    env = env or tasks.make(config.task, config.physics, **dict(config.env))
    nets = networks.build(config, env.spec, method.share_actor)
    return Run(config, method, tasks.VectorEnv(env, config.num_envs), nets)


def make_train(config: Config, env: tasks.Env | None = None) -> Train:
    """The whole training as one pure function of a key; vmap it over keys to train seeds, over `hyper` to sweep.

    Args:
      config: the run's settings.
      env: an environment of your own, in place of `config.task`.

    Returns:
      train: (key, hyper=the config's) -> (LearnerState, Metrics with a leading [updates]).

    Example:
      >>> from pmt_jax import load_config
      >>> train = make_train(load_config("lane", num_envs=8, steps=200, log_interval=1))
      >>> keys = jax.random.split(jax.random.key(0), 2)
      >>> state, metrics = jax.jit(jax.vmap(train))(keys)
      >>> metrics["violation_rate"].shape
      (2, 1)
    """
    run = setup(config, env)

    def train(key: jax.Array, hyper: Hyper = run.hyper) -> tuple[LearnerState, Metrics]:
        return train_chunk(run, hyper, init(run, hyper, key), config.num_updates)

    return train


def train_chunk(run: Run, hyper: Hyper, state: LearnerState, updates: int) -> tuple[LearnerState, Metrics]:
    """`updates` updates in one scan; metrics have a leading [updates]."""
    return jax.lax.scan(lambda s, _: train_step(run, hyper, s), state, length=updates)


def init(run: Run, hyper: Hyper, key: jax.Array) -> LearnerState:
    """The state before the first update of the run that `key` names."""
    spec = run.vector.spec
    tagged = {tag: jax.random.fold_in(key, tag) for tag in Tag}
    heads = (spec.num_agents, spec.num_costs)
    constrained = run.method.constraint == "lagrangian"
    return LearnerState(
        actor=jax.vmap(untrained)(run.nets.init_actor(tagged[Tag.ACTOR])),
        critic=Critic(untrained(run.nets.init_critic(tagged[Tag.CRITIC])), normalise.init(())),
        cost_critic=Critic(untrained(run.nets.init_cost_critic(tagged[Tag.COST_CRITIC])), normalise.init(heads)),
        multiplier=jnp.full(heads, hyper.lambda_init * constrained),
        episode_cost=jnp.full(heads, hyper.cost_limit),
        obs_moments=normalise.init((spec.obs_dim,)),
        state_moments=normalise.init((spec.state_dim,)),
        rollout=rollout.start(run.vector, tagged[Tag.ENV]),
        key=tagged[Tag.UPDATE],
        update=jnp.zeros((), jnp.int32),
    )


def train_step(run: Run, hyper: Hyper, state: LearnerState) -> tuple[LearnerState, Metrics]:
    """One update: act, appraise, estimate advantages, fit the critics, cope."""
    config, horizon = run.config, run.vector.horizon
    key = jax.random.fold_in(state.key, state.update)
    tagged = {tag: jax.random.fold_in(key, tag) for tag in Tag}

    # 1 Information source: the team acts.
    state, batch = _act(run, state, tagged[Tag.ACTION])
    episode_cost = rollout.episode_cost_estimate(batch, state.episode_cost, config.violation, horizon)

    # 2 Threat appraisal: what counts as danger, and how much an action is regretted.
    cost_signal = batch.cost
    log_weight = jnp.zeros_like(batch.log_prob)

    # 3 Advantages of reward and of danger.
    value, next_value = _values(state.critic, run.nets.value, batch)
    cost_value, next_cost_value = _values(state.cost_critic, run.nets.cost_value, batch)
    ends = (batch.terminated, batch.done, hyper.discount, hyper.trace_decay)
    advantage, returns = gae(batch.reward, value, next_value, *ends)
    cost_advantage, cost_returns = gae(cost_signal, cost_value, next_cost_value, *ends)

    # 4 Critics.
    critic, critic_metrics = _fit_critic(
        run, hyper, state.critic, run.nets.value, batch.state, value, returns, tagged[Tag.CRITIC]
    )
    cost_critic, cost_critic_metrics = _fit_critic(
        run,
        hyper,
        state.cost_critic,
        run.nets.cost_value,
        batch.state,
        cost_value,
        cost_returns,
        tagged[Tag.COST_CRITIC],
    )

    # 5 Coping response: every agent's policy, and the price of danger.
    rows = _policy_rows(run, hyper, state, batch, advantage, cost_advantage, log_weight)
    violation = dual.violation(episode_cost, hyper.cost_limit, horizon)
    cope = {"sequential": _cope_in_turn, "simultaneous": _cope_at_once}[run.method.order]
    actor, multiplier, actor_metrics = cope(run, hyper, state, rows, violation, tagged)

    state = dataclasses.replace(
        state,
        actor=actor,
        critic=critic,
        cost_critic=cost_critic,
        multiplier=multiplier,
        episode_cost=episode_cost,
        update=state.update + 1,
    )
    return state, {
        **rollout.summary(batch),
        "lambda": multiplier.mean(),
        "violation": violation.mean(),
        **{f"critic/{k}": x for k, x in critic_metrics.items()},
        **{f"cost_critic/{k}": x for k, x in cost_critic_metrics.items()},
        **{f"actor/{k}": x for k, x in actor_metrics.items()},
    }


def _act(run: Run, state: LearnerState, key: jax.Array) -> tuple[LearnerState, Batch]:
    """Collects a batch with the moments of observations frozen, then adds what was seen to the moments."""
    running = run.config.obs_norm == "running"

    def normaliser(moments: Any) -> rollout.Normalise:
        return lambda x: normalise.normalise_obs(moments, x) if running else x

    normalisers = (normaliser(state.obs_moments), normaliser(state.state_moments))
    after, batch, (obs, global_state) = rollout.collect(
        run.vector,
        state.rollout,
        lambda obs: run.nets.policies(state.actor.params, obs),
        normalisers,
        key,
        run.config.rollout_length,
    )
    moments = (
        normalise.accumulate(state.obs_moments, obs),
        normalise.accumulate(state.state_moments, global_state),
    )
    return dataclasses.replace(state, rollout=after, obs_moments=moments[0], state_moments=moments[1]), batch


ValueFn = Callable[[Params, jax.Array], jax.Array]


def _values(critic: Critic, value_fn: ValueFn, batch: Batch) -> tuple[jax.Array, jax.Array]:
    """Values of the states and of the true next states [T, B, ...], in the signal's unit."""
    both = value_fn(critic.net.params, jnp.stack([batch.state, batch.next_state]))
    value, next_value = normalise.denormalise(critic.returns, both)
    return value, next_value


def _fit_critic(
    run: Run,
    hyper: Hyper,
    critic: Critic,
    value_fn: ValueFn,
    state: jax.Array,
    old_value: jax.Array,
    returns: jax.Array,
    key: jax.Array,
) -> tuple[Critic, Metrics]:
    """Updates the moments of the returns once, then fits the critic to them in the new units (Eq. 12)."""
    moments = normalise.forget(critic.returns, returns, hyper.value_decay)
    rows = (state, normalise.normalise(moments, old_value), normalise.normalise(moments, returns))

    def loss(params: Params, minibatch: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, old, target = minibatch
        return value_loss(value_fn(params, state), old, target, hyper.clip).mean(), {}

    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
    net, metrics = fit(critic.net, loss, flat, key, learning_rate=hyper.critic_lr, **_passes(run, hyper))
    unexplained = jnp.var(returns - old_value) / jnp.maximum(jnp.var(returns), 1e-8)
    return Critic(net, moments), {**metrics, "explained_variance": 1 - unexplained}


def _passes(run: Run, hyper: Hyper) -> dict[str, Any]:
    return {"max_grad_norm": hyper.max_grad_norm, "epochs": run.config.epochs, "minibatches": run.config.minibatches}


def _policy_rows(
    run: Run,
    hyper: Hyper,
    state: LearnerState,
    batch: Batch,
    advantage: jax.Array,
    cost_advantage: jax.Array,
    log_weight: jax.Array,
) -> PolicyRows:
    """The batch as every agent's policy sees it: leaves [N, R, ...]."""
    _, advantage = standardise(advantage)
    centred, scaled = standardise(cost_advantage, hyper.cost_std_floor)
    felt = scaled if run.config.cost_advantage == "std" else centred
    _, std = run.nets.policies(state.actor.params, batch.obs[0, 0])
    rows = PolicyRows(
        obs=batch.obs,
        action=batch.action,
        mask=jnp.broadcast_to(jnp.asarray(run.vector.spec.action_mask), batch.action.shape),
        log_prob=batch.log_prob,
        mean=batch.mean,
        std=jnp.broadcast_to(std, batch.action.shape),
        advantage=hybrid_advantage(advantage[..., None], felt, state.multiplier),
        cost_advantage=centred,
        log_weight=log_weight,
        factor=jnp.ones_like(batch.log_prob),
    )
    return jax.tree.map(lambda x: jnp.moveaxis(x.reshape(-1, *x.shape[2:]), 1, 0), rows)


def _cope_in_turn(
    run: Run, hyper: Hyper, state: LearnerState, rows: PolicyRows, violation: jax.Array, tagged: dict[Tag, jax.Array]
) -> tuple[Trained, jax.Array, Metrics]:
    """Agents improve one after the other in random order, each corrected by what those before it changed (HAPPO)."""

    def one_agent(
        carry: tuple[Trained, jax.Array, jax.Array], i: jax.Array
    ) -> tuple[tuple[Trained, jax.Array, jax.Array], Metrics]:
        actor, multiplier, factor = carry
        mine = dataclasses.replace(_of(rows, i), factor=factor)
        net, metrics = _improve(run, hyper, _of(actor, i), mine, jax.random.fold_in(tagged[Tag.ACTOR], i))
        log_ratio = _log_ratio(run, net.params, mine)
        price = _price(run, hyper, multiplier[i], mine, violation[i], log_ratio)
        actor = jax.tree.map(lambda all_, one: all_.at[i].set(one), actor, net)
        return (actor, multiplier.at[i].set(price), factor * jnp.exp(log_ratio)), metrics

    order = jax.random.permutation(tagged[Tag.ORDER], run.nets.num_agents)
    start = (state.actor, state.multiplier, jnp.ones_like(rows.factor[0]))
    (actor, multiplier, _), metrics = jax.lax.scan(one_agent, start, order)
    return actor, multiplier, jax.tree.map(lambda x: x.mean(0), metrics)


def _cope_at_once(
    run: Run, hyper: Hyper, state: LearnerState, rows: PolicyRows, violation: jax.Array, tagged: dict[Tag, jax.Array]
) -> tuple[Trained, jax.Array, Metrics]:
    """All agents improve from the same policies; a shared actor learns from everybody's rows together."""
    agents = jnp.arange(run.nets.num_actors)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(tagged[Tag.ACTOR], agents)
    per_actor = jax.tree.map(lambda x: x.reshape(run.nets.num_actors, -1, *x.shape[2:]), rows)
    actor, metrics = jax.vmap(lambda net, mine, key: _improve(run, hyper, net, mine, key))(state.actor, per_actor, keys)
    log_ratio = jax.vmap(lambda net, mine: _log_ratio(run, net.params, mine))(actor, per_actor)
    log_ratio = log_ratio.reshape(rows.log_prob.shape)
    price = jax.vmap(lambda *each: _price(run, hyper, *each))(state.multiplier, rows, violation, log_ratio)
    return actor, price, jax.tree.map(lambda x: x.mean(0), metrics)


def _of(tree: Any, i: jax.Array) -> Any:
    """Agent i's part of a pytree with leading [N]."""
    return jax.tree.map(lambda x: x[i], tree)


def _log_ratio(run: Run, params: Params, rows: PolicyRows) -> jax.Array:
    """log pi(a|o) - log pi_old(a|o), [R]."""
    mean, std = run.nets.policy(params, rows.obs)
    return distributions.log_prob(rows.action, mean, std, rows.mask) - rows.log_prob


def _improve(run: Run, hyper: Hyper, net: Trained, rows: PolicyRows, key: jax.Array) -> tuple[Trained, Metrics]:
    """One policy's epochs of clipped policy gradient on its rows."""

    def loss(params: Params, rows: PolicyRows) -> tuple[jax.Array, Metrics]:
        mean, std = run.nets.policy(params, rows.obs)
        log_ratio = distributions.log_prob(rows.action, mean, std, rows.mask) - rows.log_prob
        gain = clipped_surrogate(log_ratio, rows.log_weight, rows.advantage, rows.factor, hyper.clip)
        entropy = distributions.entropy(std, rows.mask).mean()
        outside = jnp.abs(jnp.exp(log_ratio + rows.log_weight) - 1) > hyper.clip
        metrics = {
            "entropy": entropy,
            "clipped": outside.mean(),
            "kl": distributions.kl(rows.mean, rows.std, mean, std, rows.mask).mean(),
            "std": (std * rows.mask).sum() / rows.mask.sum(),
        }
        return -gain.mean() - hyper.entropy_coef * entropy, metrics

    return fit(net, loss, rows, key, learning_rate=hyper.actor_lr, **_passes(run, hyper))


def _price(
    run: Run, hyper: Hyper, multiplier: jax.Array, rows: PolicyRows, violation: jax.Array, log_ratio: jax.Array
) -> jax.Array:
    """One agent's multipliers [K] after its policy has improved."""
    if run.method.constraint != "lagrangian":
        return multiplier
    ratio = jnp.exp(log_ratio + rows.log_weight)
    surrogate = hyper.surrogate_weight * jnp.mean(ratio[:, None] * rows.cost_advantage, axis=0)
    return dual.dual_update(multiplier, violation, surrogate, hyper.lambda_lr, hyper.lambda_max)
