"""One learner for all methods: an update reads from top to bottom like the paper's Algorithms 1 and 2."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from . import appraisal, dual, normalise, rollout, tasks
from .config import Config, Hyper
from .coping import regret_weight
from .fit import fit, untrained, value_loss
from .policy_update import cope, policy_rows
from .returns import gae
from .run import Run, setup
from .types import Batch, Critic, LearnerState, Metrics, Params, Tag, Trained

Train = Callable[..., tuple[LearnerState, Metrics]]


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
        fear=untrained(run.nets.init_fear(tagged[Tag.FEAR])) if run.method.cost_signal == "fear" else None,
        regret=(
            jax.vmap(untrained)(run.nets.init_regret(tagged[Tag.REGRET]))
            if run.method.ratio_weight == "regret"
            else None
        ),
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
    key = jax.random.fold_in(state.key, state.update)
    tagged = {tag: jax.random.fold_in(key, tag) for tag in Tag}
    hyper = _by_now(run, hyper, state.update)

    # 1 Information source: the team acts.
    state, batch = _act(run, state, tagged[Tag.ACTION])

    # 2 Threat appraisal: what counts as danger, and how much an action is regretted.
    fear, cost_signal, fear_metrics = _appraise_fear(run, hyper, state.fear, batch, tagged[Tag.FEAR])
    regret, log_weight, regret_metrics = _appraise_regret(run, hyper, state.regret, batch, tagged[Tag.REGRET])

    # 3 Advantages of reward and of danger.
    value, next_value = _values(state.critic, run.nets.value, batch)
    cost_value, next_cost_value = _values(state.cost_critic, run.nets.cost_value, batch)
    ends = (batch.terminated, batch.done, hyper.discount, hyper.trace_decay)
    advantage, returns = gae(batch.reward, value, next_value, *ends)
    cost_advantage, cost_returns = gae(cost_signal, cost_value, next_cost_value, *ends)

    # 4 Critics.
    rows, cost_rows = (batch.state, value, returns), (batch.state, cost_value, cost_returns)
    fit_critic = functools.partial(_fit_critic, run, hyper)
    critic, critic_metrics = fit_critic(state.critic, run.nets.value, rows, tagged[Tag.CRITIC])
    cost_critic, cost_critic_metrics = fit_critic(
        state.cost_critic, run.nets.cost_value, cost_rows, tagged[Tag.COST_CRITIC]
    )

    # 5 Coping response: every agent's policy, and the price of danger.
    rows = policy_rows(run, hyper, state, batch, advantage, cost_advantage, log_weight)
    episode_cost = _episode_cost(run, hyper, state, batch, cost_value)
    violation = dual.violation(episode_cost, hyper.cost_limit, run.vector.horizon)
    actor, multiplier, actor_metrics = cope(run, hyper, state, rows, violation, tagged)

    state = dataclasses.replace(
        state,
        actor=actor,
        critic=critic,
        cost_critic=cost_critic,
        fear=fear,
        regret=regret,
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
        **{f"fear/{k}": x for k, x in fear_metrics.items()},
        **{f"regret/{k}": x for k, x in regret_metrics.items()},
    }


def _by_now(run: Run, hyper: Hyper, update: jax.Array) -> Hyper:
    """`hyper` with the step sizes that are left after so many updates."""
    left = jnp.exp2(-(update * run.config.batch_size / hyper.lr_half_life))
    rates = ("actor_lr", "critic_lr", "appraisal_lr")
    return dataclasses.replace(hyper, **{name: getattr(hyper, name) * left for name in rates})


def _act(run: Run, state: LearnerState, key: jax.Array) -> tuple[LearnerState, Batch]:
    """Collects a batch with the moments of observations frozen, then adds what was seen to the moments."""
    normalisers = (
        functools.partial(run.scale, state.obs_moments),
        functools.partial(run.scale, state.state_moments),
    )
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


def _appraise_fear(
    run: Run, hyper: Hyper, net: Trained | None, batch: Batch, key: jax.Array
) -> tuple[Trained | None, jax.Array, Metrics]:
    """Learns from the observed costs first, then says how fearful every step was: [T, B, N, K] in (0, 1).

    Without a fear prior network the signal is the cost itself, or what the method makes of the batch. Calibration is
    that of the network before it has seen the batch.
    """
    if net is None:
        signal = run.method.cost_signal
        return None, signal(batch) if callable(signal) else batch.cost, {}
    seen = batch.next_state if run.config.fear_time == "next" else batch.state
    remembered = jax.nn.sigmoid(run.nets.fear(net.params, seen))
    rows = jax.tree.map(_flat, (seen, batch.cost, remembered))
    if run.config.fear_history == "random":
        rows = (*rows[:2], rows[2][jax.random.permutation(jax.random.fold_in(key, 1), rows[2].shape[0])])
    noise = jax.random.logistic(jax.random.fold_in(key, 2), rows[1].shape)

    def loss(params: Params, rows: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, cost, old, noise = rows
        logits = run.nets.fear(params, state)
        distance = appraisal.divergence(logits, cost, run.config.fear_loss, noise, hyper.temperature)
        return appraisal.appraisal_loss(distance, logits, old, jnp.ones_like(cost), hyper.fear_l2), {}

    net, metrics = fit(net, loss, (*rows, noise), key, **_appraisal_passes(run, hyper))
    fear = jax.nn.sigmoid(run.nets.fear(net.params, seen))
    return net, fear, {**metrics, **appraisal.calibration(remembered, batch.cost)}


def _appraise_regret(
    run: Run, hyper: Hyper, net: Trained | None, batch: Batch, key: jax.Array
) -> tuple[Trained | None, jax.Array, Metrics]:
    """Learns how deliberate the costly actions were, then weighs every step's ratio by how regret has changed.

    Returns:
      the networks of all agents, log w [T, B, N] (0 without regret), and metrics: mean regret per action entry on
      costly steps, what it would be on safe ones were they costly, and the weight w over all rows.
    """
    if net is None:
        return None, jnp.zeros_like(batch.log_prob), {}
    mask = jnp.asarray(run.vector.spec.action_mask)
    state = jnp.broadcast_to(batch.state[:, :, None], (*batch.log_prob.shape, batch.state.shape[-1]))
    logits = jax.vmap(run.nets.regret, (0, 2, 2), 2)
    before = logits(net.params, state, batch.action)
    target = appraisal.deliberateness((batch.action - batch.mean) / batch.std, run.config.regret_target)
    target = target * (1 - 2 * appraisal.SMOOTHING) + appraisal.SMOOTHING
    costly = (batch.cost.max(-1, keepdims=True) > 0) * mask
    rows = (state, batch.action, target, jax.nn.sigmoid(before), costly)
    rows = jax.tree.map(lambda x: jnp.moveaxis(_flat(x), 1, 0), rows)

    def loss(params: Params, rows: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, action, target, old, weight = rows
        logits = run.nets.regret(params, state, action)
        distance = appraisal.divergence(logits, target, "ce", jnp.zeros_like(logits), 1.0)
        return appraisal.appraisal_loss(distance, logits, old, weight, hyper.regret_l2), {}

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(run.nets.num_agents))
    learned, metrics = jax.vmap(lambda *each: fit(each[0], loss, each[1], each[2], **_appraisal_passes(run, hyper)))(
        net, rows, keys
    )
    # Adam's momentum would move a network that had nothing to learn from.
    learned = jax.tree.map(lambda new, old: jnp.where(costly.any(), new, old), learned, net)
    after = logits(learned.params, state, batch.action)
    new, old = appraisal.regret(after, batch.cost), appraisal.regret(before, batch.cost)
    bound = hyper.kappa * hyper.clip
    if run.config.regret_response != "letter":  # the other responses answer to regret itself, not to its change
        old = jnp.zeros_like(new)
    if run.config.regret_response == "advantage":  # no ratio is touched, so there is no clip interval to leave
        bound = hyper.regret_max
    log_weight = regret_weight(
        new,
        old,
        mask,
        choose=run.config.regret_mask,
        omega=hyper.omega,
        regret_max=hyper.regret_max,
        bound=bound,
    )
    weight = jnp.exp(log_weight)
    diagnostics = {
        "on_costly": (new * mask).sum() / costly.sum(),
        "on_safe": (jax.nn.sigmoid(after) * (mask - costly)).sum() / (mask - costly).sum(),
        "weight_mean": weight.mean(),
        "weight_std": weight.std(),
    }
    return learned, log_weight, {**{k: x.mean(0) for k, x in metrics.items()}, **diagnostics}


def _appraisal_passes(run: Run, hyper: Hyper) -> dict[str, Any]:
    return {
        "learning_rate": hyper.appraisal_lr,
        "max_grad_norm": hyper.max_grad_norm,
        "epochs": run.config.appraisal_epochs,
        "minibatches": run.config.minibatches,
    }


def _flat(x: jax.Array) -> jax.Array:
    """[T, B, ...] as rows [R, ...]."""
    return x.reshape(-1, *x.shape[2:])


def _episode_cost(run: Run, hyper: Hyper, state: LearnerState, batch: Batch, cost_value: jax.Array) -> jax.Array:
    """The undiscounted cost per episode [N, K] that the constraint is held against."""
    horizon = run.vector.horizon
    if run.config.violation == "critic":
        return (1 - hyper.discount) * horizon * cost_value.mean((0, 1))
    return rollout.episode_cost_estimate(batch, state.episode_cost, run.config.violation, horizon)


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
    rows: tuple[jax.Array, jax.Array, jax.Array],
    key: jax.Array,
) -> tuple[Critic, Metrics]:
    """Updates the moments of the returns once, then fits the critic to them in the new units.

    Args:
      rows: states [T, B, S], values when they were collected and returns, both [T, B, ...] in the signal's unit.
    """
    state, old_value, returns = rows
    moments = normalise.forget(critic.returns, returns, hyper.value_decay)
    normalised = (state, normalise.normalise(moments, old_value), normalise.normalise(moments, returns))

    def loss(params: Params, minibatch: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, old, target = minibatch
        return value_loss(value_fn(params, state), old, target, hyper.clip).mean(), {}

    passes = {"epochs": run.config.epochs, "minibatches": run.config.minibatches}
    limits = {"learning_rate": hyper.critic_lr, "max_grad_norm": hyper.max_grad_norm}
    net, metrics = fit(critic.net, loss, jax.tree.map(_flat, normalised), key, **limits, **passes)
    unexplained = jnp.var(returns - old_value) / jnp.maximum(jnp.var(returns), 1e-8)
    return Critic(net, moments), {**metrics, "explained_variance": 1 - unexplained}
