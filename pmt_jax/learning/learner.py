"""One learner for all methods: an update reads from top to bottom like the paper's Algorithms 1 and 2."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from .. import tasks
from ..config.settings import Config, Hyper
from ..errors import UsageError
from . import emotions, rollout, sharding
from .debug import check_finite, watched
from .maths import lagrangian, running_moments
from .maths.advantages import gae
from .maths.losses import value_loss
from .optimise import fit, init_train_state
from .policy_update import in_lambda_unit, policy_rows, update_policies
from .rollout import flatten_steps
from .setup import Setup, make_setup
from .types import Batch, Critic, LearnerState, Metrics, Params, Tag

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
    if config.init or config.init_fear:
        raise UsageError("make_train starts anew; init and init_fear are for pmt train, which reads run folders")
    setup = make_setup(config, env)

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
    _, like = jax.eval_shape(partial(train_step, setup, hyper), state)
    nothing = jax.tree.map(lambda x: jnp.zeros((most, *x.shape), x.dtype), like)

    def step(i: jax.Array, carry: tuple[LearnerState, Metrics]) -> tuple[LearnerState, Metrics]:
        state, seen = carry
        state, metrics = train_step(setup, hyper, state)
        return state, jax.tree.map(lambda x, new: x.at[i].set(new), seen, metrics)

    return jax.lax.fori_loop(0, updates, step, (state, nothing))


def init(setup: Setup, hyper: Hyper, key: jax.Array) -> LearnerState:
    """The state before the first update of the run that `key` names."""
    spec = setup.vector.spec
    tagged = {tag: jax.random.fold_in(key, tag) for tag in Tag}
    heads = (spec.num_agents, spec.num_costs)
    constrained = setup.method.constraint == "lagrangian"
    return LearnerState(
        actor=jax.vmap(init_train_state)(setup.nets.init_actor(tagged[Tag.ACTOR])),
        critic=Critic(init_train_state(setup.nets.init_critic(tagged[Tag.CRITIC])), running_moments.init(())),
        cost_critic=Critic(
            init_train_state(setup.nets.init_cost_critic(tagged[Tag.COST_CRITIC])), running_moments.init(heads)
        ),
        fear=init_train_state(setup.nets.init_fear(tagged[Tag.FEAR], hyper.fear_start))
        if setup.method.cost_signal == "fear"
        else None,
        regret=(
            jax.vmap(init_train_state)(setup.nets.init_regret(tagged[Tag.REGRET]))
            if setup.method.ratio_weight == "regret"
            else None
        ),
        multiplier=jnp.full(heads, hyper.lambda_init * constrained),
        episode_cost=jnp.full(heads, lagrangian.held_limit(hyper.cost_limit, hyper.cost_margin)),  # no excess yet
        obs_moments=running_moments.init((spec.obs_dim,)),
        state_moments=running_moments.init((spec.state_dim,)),
        rollout=rollout.start(setup.vector, tagged[Tag.ENV], setup.config.episode_starts == "spread"),
        key=tagged[Tag.UPDATE],
        update=jnp.zeros((), jnp.int32),
    )


def train_step(setup: Setup, hyper: Hyper, state: LearnerState) -> tuple[LearnerState, Metrics]:
    """One update: act, appraise, estimate advantages, fit the critics, update the policies."""
    key = jax.random.fold_in(state.key, state.update)
    tagged = {tag: jax.random.fold_in(key, tag) for tag in Tag}
    hyper = _annealed(setup, hyper, state.update)

    # 1 Information source: the team acts.
    state, batch = _act(setup, hyper, state, tagged)

    # 2 Threat appraisal: what counts as danger, and how much an action is regretted.
    (fear, cost_signal, fear_metrics), (regret, log_weight, regret_metrics) = sharding.side_by_side(
        partial(emotions.appraise_fear, setup, hyper, state.fear, batch, tagged[Tag.FEAR]),
        partial(emotions.appraise_regret, setup, hyper, state.regret, batch, tagged[Tag.REGRET]),
    )

    # 3 Advantages of reward and of danger.
    value, next_value = _values(state.critic, setup.nets.value, batch)
    cost_value, next_cost_value = _values(state.cost_critic, setup.nets.cost_value, batch)
    ends = (batch.terminated, batch.done, hyper.gamma, hyper.gae_lambda)
    advantage, returns = gae(batch.reward, value, next_value, *ends)
    cost_advantage, cost_returns = gae(cost_signal, cost_value, next_cost_value, *ends)

    # 4 Critics, and 5 coping response: every agent's policy, and its multipliers.
    episode_cost = _episode_cost(setup, hyper, state, batch, cost_value)
    cost_excess = _cost_excess(setup, hyper, episode_cost)
    weigh = partial(_weight_of_cost, setup, hyper, state, cost_excess)
    actor_rows = policy_rows(setup, hyper, weigh(state.multiplier), batch, advantage, cost_advantage, log_weight)
    rows, cost_rows = (batch.state, value, returns), (batch.state, cost_value, cost_returns)
    fit_critic = partial(_fit_critic, setup, hyper)
    cost_clip = jnp.where(jnp.isnan(hyper.cost_value_clip), hyper.clip, hyper.cost_value_clip)
    fitted = sharding.side_by_side(
        partial(fit_critic, state.critic, setup.nets.value, hyper.clip, rows, tagged[Tag.CRITIC]),
        partial(fit_critic, state.cost_critic, setup.nets.cost_value, cost_clip, cost_rows, tagged[Tag.COST_CRITIC]),
        partial(update_policies, setup, hyper, state.actor, state.multiplier, actor_rows, cost_excess, tagged),
    )
    (critic, critic_metrics), (cost_critic, cost_critic_metrics), (actor, multiplier, actor_metrics) = fitted

    computed = {"batch": batch, "fear": fear, "cost_signal": cost_signal, "regret": regret, "log_weight": log_weight}
    computed |= {"advantage": advantage, "returns": returns, "cost_advantage": cost_advantage}
    learned = {"critic": critic, "cost_critic": cost_critic, "fear": fear, "regret": regret, "actor": actor}
    learned |= {"multiplier": multiplier, "episode_cost": episode_cost}
    check_finite(setup, state.update, **{**computed, "cost_returns": cost_returns, **learned})
    state = dataclasses.replace(state, **learned, update=state.update + 1)
    return state, {
        **rollout.summary(batch),
        **rollout.limits_kept(batch, hyper, setup.vector.horizon),
        "lambda": weigh(multiplier).mean(),
        "cost_excess": cost_excess.mean(),
        **{f"critic/{k}": x for k, x in critic_metrics.items()},
        **{f"cost_critic/{k}": x for k, x in cost_critic_metrics.items()},
        **{f"actor/{k}": x for k, x in actor_metrics.items()},
        **{f"fear/{k}": x for k, x in fear_metrics.items()},
        **{f"regret/{k}": x for k, x in regret_metrics.items()},
    }


def _annealed(setup: Setup, hyper: Hyper, update: jax.Array) -> Hyper:
    """`hyper` after so many updates: learning rates, bounds on a policy's step, and how its noise falls."""
    # Steps are counted in f32: as int32 they overflow after 2.1e9 steps of a seed.
    steps = update.astype(jnp.float32) * setup.config.batch_size

    def left(half_life: jax.Array | float, start: jax.Array | float = 0) -> jax.Array:
        return jnp.exp2(-(jnp.maximum(steps - start, 0) / half_life))

    rates = {name: getattr(hyper, name) for name in ("actor_lr", "critic_lr", "emotion_lr")}
    rates["fear_lr_start"] = hyper.fear_lr_start / (update + 1)
    rates = {name: rate * left(hyper.lr_half_life) for name, rate in rates.items()}
    shorter = left(hyper.actor_lr_half_life, hyper.std_decay_start)
    rates["actor_lr"] *= shorter
    kl_left = jnp.maximum(left(hyper.kl_half_life), 1e-30)  # no share of an infinite bound is 0 times it
    bounds = {
        "kl_max": hyper.kl_max * kl_left,
        "kl_limit": hyper.kl_limit * jnp.maximum(kl_left * shorter**2, 1e-30),
        "limit_windup": jnp.minimum(hyper.limit_windup, 1 / jnp.sqrt(kl_left)),
    }
    std_half_life = jnp.where(steps < hyper.std_decay_start, jnp.inf, hyper.std_half_life)
    return dataclasses.replace(hyper, **rates, **bounds, std_half_life=std_half_life)


def _act(setup: Setup, hyper: Hyper, state: LearnerState, tagged: dict[Tag, jax.Array]) -> tuple[LearnerState, Batch]:
    """Collects a batch with the moments of observations frozen, then adds what was seen to the moments."""
    normalisers = (
        partial(setup.scale, state.obs_moments),
        partial(setup.scale, state.state_moments),
    )

    def feel(cost: jax.Array, t: jax.Array) -> jax.Array:
        return tasks.felt_cost(cost, jax.random.fold_in(tagged[Tag.FELT], t), hyper.cost_seen, hyper.cost_false)

    after, batch, (obs, global_state) = rollout.collect(
        watched(setup, state.update),
        state.rollout,
        lambda obs: setup.nets.policies(state.actor.params, obs),
        normalisers,
        tagged[Tag.ACTION],
        setup.config.rollout_length,
        feel,
    )
    moments = (
        running_moments.accumulate(state.obs_moments, obs),
        running_moments.accumulate(state.state_moments, global_state),
    )
    return dataclasses.replace(state, rollout=after, obs_moments=moments[0], state_moments=moments[1]), batch


def _episode_cost(setup: Setup, hyper: Hyper, state: LearnerState, batch: Batch, cost_value: jax.Array) -> jax.Array:
    """The undiscounted cost per episode [N, K] that the constraint is held against."""
    horizon = setup.vector.horizon
    if setup.config.cost_estimate == "critic":
        return (1 - hyper.gamma) * horizon * cost_value.mean((0, 1))
    return rollout.episode_cost_estimate(batch, state.episode_cost, setup.config.cost_estimate, horizon)


def _cost_excess(setup: Setup, hyper: Hyper, episode_cost: jax.Array) -> jax.Array:
    """How far an estimate [N, K] is beyond what the learner holds it to, in cost per step."""
    held = lagrangian.held_limit(hyper.cost_limit, hyper.cost_margin)
    return lagrangian.cost_excess(episode_cost, held, setup.vector.horizon)


def _weight_of_cost(
    setup: Setup, hyper: Hyper, state: LearnerState, cost_excess: jax.Array, multiplier: jax.Array
) -> jax.Array:
    """What the policies weigh costs with [N, K]: the multiplier that a state carries, or the PID's sum with it."""
    if setup.config.lambda_rule == "integral" or setup.method.constraint != "lagrangian":
        return multiplier
    excesses = (cost_excess, _cost_excess(setup, hyper, state.episode_cost))
    now, before = (in_lambda_unit(setup, hyper, excess) for excess in excesses)
    return lagrangian.pid(multiplier, now, before, hyper.lambda_kp, hyper.lambda_kd, hyper.lambda_max)


ValueFn = Callable[[Params, jax.Array], jax.Array]


def _values(critic: Critic, value_fn: ValueFn, batch: Batch) -> tuple[jax.Array, jax.Array]:
    """Values of the states and of the true next states [T, B, ...], in the signal's unit."""
    both = value_fn(critic.net.params, jnp.stack([batch.state, batch.next_state]))
    value, next_value = running_moments.denormalise(critic.returns, both)
    return value, next_value


def _fit_critic(
    setup: Setup,
    hyper: Hyper,
    critic: Critic,
    value_fn: ValueFn,
    clip: jax.Array | float,
    rows: tuple[jax.Array, jax.Array, jax.Array],
    key: jax.Array,
) -> tuple[Critic, Metrics]:
    """Updates the moments of the returns once, then fits the critic to them in the new units.

    Args:
      clip: half-width of the interval of values, in those units.
      rows: states [T, B, S], values when they were collected and returns, both [T, B, ...] in the signal's unit.
    """
    state, old_value, returns = rows
    moments = running_moments.update_ema(critic.returns, returns, hyper.value_norm_decay)
    normalised = (state, running_moments.normalise(moments, old_value), running_moments.normalise(moments, returns))

    def loss(params: Params, minibatch: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, old, target = minibatch
        return value_loss(value_fn(params, state), old, target, clip).mean(), {}

    passes = {"epochs": setup.config.epochs, "minibatches": setup.config.minibatches}
    limits = {"learning_rate": hyper.critic_lr, "max_grad_norm": hyper.max_grad_norm}
    net, metrics = fit(critic.net, loss, jax.tree.map(flatten_steps, normalised), key, **limits, **passes)
    unexplained = jnp.var(returns - old_value) / jnp.maximum(jnp.var(returns), 1e-8)
    return Critic(net, moments), {**metrics, "explained_variance": 1 - unexplained}
