"""How good and how safe a policy is: whole episodes under fixed keys, each environment's first episode only.

Counting first episodes only keeps short episodes from being counted more often than long ones.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from .. import limits, tasks
from ..errors import UsageError
from . import sharding
from .rollout import ObserveCost, cost_beyond
from .setup import Setup
from .types import ActingState, Hyper, Metrics, Tag

EVALUATION_KEY = 20_260_000  # far from the seeds people use for training
FRESH_KEY = EVALUATION_KEY + 1  # of starts by which no policy was chosen
COUNTS = ("non_finite", "cost_out_of_range")  # of steps of an episode that broke the contract of tasks
STEP = "step/"  # before the names of what `play` records of every step

Act = Callable[[tasks.State, jax.Array], jax.Array]  # state of all environments, step -> action [B, N, A]
Hidden = jax.Array | None  # [B, N, H], what recurrent actors remember
ActAndRecall = Callable[[tasks.State, jax.Array, Hidden], tuple[jax.Array, Hidden]]


def evaluate(
    setup: Setup,
    state: ActingState,
    episodes: int,
    *,
    deterministic: bool,
    fresh: bool = False,
    hyper: Hyper | None = None,
    record: bool = False,
) -> Metrics:
    """Runs one seed's policy for `episodes` whole episodes; vmap it over the states of several seeds.

    Args:
      setup: the run's task and networks.
      state: a learner state of one seed, or what of it acts.
      episodes: environments, one episode each.
      deterministic: take the mean action instead of a sample.
      fresh: from starts, and with noise, other than those that training and `publish` choose by.
      hyper: says which costs are observed; the setup's own if None.
      record: also return every step, as in `play`.

    Returns:
      The metrics of `play`, and within_limit [episodes]: whether each cost of each agent (the true one, of several each
      observed one) is within its limit.

    Raises:
      UsageError: `episodes` is below 1, or `state` is of several seeds.
    """
    if episodes < 1:
        raise UsageError(f"evaluate takes at least 1 episode, not {episodes}")
    if jnp.ndim(state.obs_moments.weight):
        raise UsageError(
            "evaluate takes the state of one seed; for several: jax.vmap(lambda s: evaluate(setup, s, ...))"
        )
    hyper = setup.hyper if hyper is None else hyper
    key = jax.random.key(FRESH_KEY if fresh else EVALUATION_KEY)

    def act(env: tasks.State, t: jax.Array, hidden: Hidden) -> tuple[jax.Array, Hidden]:
        mean, std, hidden = setup.nets.act(state.actor.params, setup.scale(state.obs_moments, env.obs), hidden)
        noise = 0.0 if deterministic else jax.random.normal(jax.random.fold_in(key, t), mean.shape)
        return mean + std * noise, hidden

    def observe(cost: jax.Array, t: jax.Array) -> jax.Array:
        step_key = jax.random.fold_in(jax.random.fold_in(key, Tag.OBSERVED_COST), t)
        return tasks.observed_cost(cost, step_key, hyper.cost_seen)

    memory = setup.nets.start(episodes)
    metrics, costs = _play(setup.vector.env, act, memory and memory.actor, episodes, observe, fresh, record)
    beyond = cost_beyond(*costs, hyper)
    return metrics | {"within_limit": jnp.all(beyond == 0, axis=(-2, -1)).astype(beyond.dtype)}


def play(
    env: tasks.Env,
    act: Act,
    episodes: int,
    observe: ObserveCost = lambda cost, t: cost,
    fresh: bool = False,
    record: bool = False,
) -> Metrics:
    """`episodes` whole episodes of any policy, from starts that are always the same.

    Args:
      observe: what of a step's cost the learner observes; all of it by default.
      fresh: as in `evaluate`.
      record: also return every step.

    Returns:
      episode_reward, episode_cost (one agent's, mean over agents, summed over K), episode_length, violation_rate (share
      of the episode's steps with a cost above 0 for some agent), true_episode_cost and true_violation_rate (the same of
      what the costs were before `observe`), non_finite and cost_out_of_range (steps of the episode that were not
      finite, or had a cost outside [0, 1]), each agent's and cost's episode_cost/... and true_episode_cost/... (see
      `limits.columns`), and the task's info (means over the episode), each [episodes]; all undiscounted. With `record`
      also `step/NAME` [horizon, episodes, ...]: obs (before the action), next_obs (before any reset), action, reward,
      cost as observed, true_cost, terminated, truncated, info/NAME; 0 after an episode's end.
    """
    return _play(env, lambda state, t, _: (act(state, t), None), None, episodes, observe, fresh, record)[0]


def _play(
    env: tasks.Env,
    act: ActAndRecall,
    hidden: Hidden,
    episodes: int,
    observe: ObserveCost,
    fresh: bool,
    record: bool,
) -> tuple[Metrics, tuple[jax.Array, jax.Array]]:
    """What `play` returns, and the episodes' costs [episodes, N, K], as observed and as they were.

    Args:
      hidden: before the first step. It is never reset, because nothing counts after an environment's first episode.
    """
    vector, spec = tasks.VectorEnv(env, episodes), env.spec
    mask = jnp.asarray(spec.action_mask)
    step_per_device = sharding.per_device(vector.step)

    def step(
        carry: tuple[tasks.VectorState, Hidden, jax.Array, Metrics], t: jax.Array
    ) -> tuple[tuple[tasks.VectorState, Hidden, jax.Array, Metrics], Metrics]:
        state, hidden, alive, sums = carry
        action, hidden = act(state.env, t, hidden)
        seen, action = state.env.obs, action * mask
        state, outcome = step_per_device(state, action)
        each = observe(outcome.cost, t)
        now = {
            "episode_reward": outcome.reward,
            "episode_cost": each,
            "episode_length": jnp.ones_like(outcome.reward),
            "violation_rate": (each > 0).any((-2, -1)),
            "true_episode_cost": outcome.cost,
            "true_violation_rate": (outcome.cost > 0).any((-2, -1)),
            "non_finite": outcome.non_finite,
            "cost_out_of_range": outcome.cost_out_of_range,
            **{f"info/{name}": x for name, x in outcome.info.items()},
        }
        # No product: what is not finite, in `info`, times 0 is not 0.
        sums = {name: sums[name] + _masked(now[name], alive) for name in sums}
        kept = _recorded(seen, action, each, outcome, alive) if record else {}
        return (state, hidden, alive & ~(outcome.terminated | outcome.truncated), sums), kept

    key = jax.random.key(FRESH_KEY if fresh else EVALUATION_KEY)
    start = vector.reset(jax.random.fold_in(key, vector.horizon))
    names = ["episode_reward", "episode_length", "violation_rate", "true_violation_rate", *COUNTS]
    names += [f"info/{name}" for name in start.env.info]
    sums = {name: jnp.zeros(episodes, start.env.reward.dtype) for name in names}
    costs = ("episode_cost", "true_episode_cost")
    sums |= {name: jnp.zeros((episodes, spec.num_agents, spec.num_costs), start.env.reward.dtype) for name in costs}
    carry = (start, hidden, jnp.ones(episodes, bool), sums)
    (*_, sums), kept = jax.lax.scan(step, carry, jnp.arange(vector.horizon))
    observed, true = (sums.pop(name) for name in costs)
    per_step = [name for name in sums if not name.startswith("episode_") and name not in COUNTS]
    found = {**sums, **{name: sums[name] / sums["episode_length"] for name in per_step}, **kept}
    shared = tasks.shares_cost(env)
    for name, cost in zip(costs, (observed, true), strict=True):
        found[name] = cost.sum(-1).mean(-1)
        found |= limits.worst(name, cost, shared) | limits.columns(name, cost, shared)
    return found, (observed, true)


def _masked(x: jax.Array, alive: jax.Array) -> jax.Array:
    """What a step gave [B, ...], 0 where an episode has ended."""
    return jnp.where(alive.reshape(alive.shape + (1,) * (x.ndim - 1)), x, jnp.zeros_like(x))


def _recorded(
    obs: jax.Array, action: jax.Array, observed: jax.Array, outcome: tasks.Outcome, alive: jax.Array
) -> dict[str, jax.Array]:
    """What `play` keeps of one step of all environments, 0 where an episode has ended."""
    kept = {
        "obs": obs,
        "next_obs": outcome.next_obs,
        "action": action,
        "reward": outcome.reward,
        "cost": observed,
        "true_cost": outcome.cost,
        "terminated": outcome.terminated,
        "truncated": outcome.truncated,
        **{f"info/{name}": x for name, x in outcome.info.items()},
    }
    return {f"{STEP}{name}": _masked(x, alive) for name, x in kept.items()}


def interval(x: np.ndarray) -> tuple[float, float]:
    """Of independent values [n]: the mean and the half-width of its 95 % interval (Student's t; nan for n = 1)."""
    n = len(x)
    if n == 1:
        return float(x[0]), float("nan")
    quantile = float(scipy.special.stdtrit(n - 1, 0.975))
    return float(x.mean()), quantile * float(x.std(ddof=1)) / n**0.5


def is_better(
    reward: np.ndarray, cost: np.ndarray, best_reward: np.ndarray, best_cost: np.ndarray, limit: float | np.ndarray
) -> np.ndarray:
    """Whether a policy is better than the best so far: [...] bool, of mean episode rewards and costs [...].

    Within the cost limit beats beyond it; within it the higher reward is better, beyond it the lower cost. A nan
    (no episode ended) is never better.
    """
    within, was_within = cost <= limit, best_cost <= limit
    return np.where(within & was_within, reward > best_reward, np.where(was_within, False, cost < best_cost))
