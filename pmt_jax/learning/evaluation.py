"""How good and how safe a policy is: whole episodes under fixed keys, each environment's first episode only.

Counting first episodes only keeps short episodes from being counted more often than long ones.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from .. import tasks
from . import sharding
from .rollout import Feel, cost_beyond
from .setup import Setup
from .types import ActingState, Hyper, Metrics, Tag

EVALUATION_KEY = 20_260_000  # far from the seeds people use for training
FRESH_KEY = EVALUATION_KEY + 1  # of starts by which no policy was chosen
COUNTS = ("non_finite", "cost_out_of_range")  # of steps of an episode that broke the contract of tasks
STEP = "step/"  # before the names of what `play` records of every step

Act = Callable[[tasks.State, jax.Array], jax.Array]  # state of all environments, step -> action [B, N, A]


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
    """Runs one seed's policy for `episodes` whole episodes.

    Args:
      setup: the run's task and networks.
      state: a learner state of one seed, or what of it acts.
      episodes: environments, one episode each.
      deterministic: take the mean action instead of a sample.
      fresh: from starts, and with noise, other than those that training and `publish` choose by.
      hyper: says what of the costs is felt; the setup's own if None.
      record: also return every step, as in `play`.

    Returns:
      The metrics of `play`, and within_limit [episodes]: whether an episode's cost (the true one, of several each felt
      one) is within its limit.
    """
    felt = setup.hyper if hyper is None else hyper
    key = jax.random.key(FRESH_KEY if fresh else EVALUATION_KEY)

    def act(env: tasks.State, t: jax.Array) -> jax.Array:
        mean, std = setup.nets.policies(state.actor.params, setup.scale(state.obs_moments, env.obs))
        noise = 0.0 if deterministic else jax.random.normal(jax.random.fold_in(key, t), mean.shape)
        return mean + std * noise

    def feel(cost: jax.Array, t: jax.Array) -> jax.Array:
        step_key = jax.random.fold_in(jax.random.fold_in(key, Tag.FELT), t)
        return tasks.felt_cost(cost, step_key, felt.cost_seen, felt.cost_false)

    metrics = play(setup.vector.env, act, episodes, feel, fresh, record)
    count = setup.vector.spec.num_costs
    names = [f"episode_cost/{k}" for k in range(count)] if count > 1 else ["episode_cost"]
    costs = jnp.stack([metrics[name] for name in names], axis=-1)
    beyond = cost_beyond(costs, metrics["true_episode_cost"][:, None], felt, setup.vector.horizon)
    return metrics | {"within_limit": jnp.all(beyond == 0, axis=-1).astype(costs.dtype)}


def play(
    env: tasks.Env,
    act: Act,
    episodes: int,
    feel: Feel = lambda cost, t: cost,
    fresh: bool = False,
    record: bool = False,
) -> Metrics:
    """`episodes` whole episodes of any policy, from starts that are always the same.

    Args:
      feel: what of a step's cost the team notices; all of it by default.
      fresh: as in `evaluate`.
      record: also return every step.

    Returns:
      episode_reward, episode_cost (one agent's, mean over agents, summed over K), episode_length, violation_rate (share
      of the episode's steps with a cost above 0 for some agent), true_episode_cost and true_violation_rate (the same of
      what the costs were before `feel`), non_finite and cost_out_of_range (steps of the episode that were not finite,
      or had a cost outside [0, 1]), episode_cost/k of each of several costs, and the task's info (means over the
      episode), each [episodes]; all undiscounted. With `record` also `step/NAME` [horizon, episodes, ...]: obs (before
      the action), action, reward, cost as felt, true_cost, terminated, truncated, info/NAME; 0 after an episode's end.
    """
    vector = tasks.VectorEnv(env, episodes)
    mask = jnp.asarray(vector.spec.action_mask)
    several = range(vector.spec.num_costs if vector.spec.num_costs > 1 else 0)
    step_per_device = sharding.per_device(vector.step)

    def step(
        carry: tuple[tasks.VectorState, jax.Array, Metrics], t: jax.Array
    ) -> tuple[tuple[tasks.VectorState, jax.Array, Metrics], Metrics]:
        state, alive, sums = carry
        seen, action = state.env.obs, act(state.env, t) * mask
        state, outcome = step_per_device(state, action)
        each = feel(outcome.cost, t)
        cost, true_cost = each.sum(-1), outcome.cost.sum(-1)
        now = {
            "episode_reward": outcome.reward,
            "episode_cost": cost.mean(-1),
            "episode_length": jnp.ones_like(outcome.reward),
            "violation_rate": cost.max(-1) > 0,
            "true_episode_cost": true_cost.mean(-1),
            "true_violation_rate": true_cost.max(-1) > 0,
            "non_finite": outcome.non_finite,
            "cost_out_of_range": outcome.cost_out_of_range,
            **{f"episode_cost/{k}": each[..., k].mean(-1) for k in several},
            **{f"info/{name}": x for name, x in outcome.info.items()},
        }
        # No product: what is not finite, in `info`, times 0 is not 0.
        sums = {name: sums[name] + jnp.where(alive, now[name], 0) for name in sums}
        kept = _recorded(seen, action, each, outcome, alive) if record else {}
        return (state, alive & ~(outcome.terminated | outcome.truncated), sums), kept

    key = jax.random.key(FRESH_KEY if fresh else EVALUATION_KEY)
    start = vector.reset(jax.random.fold_in(key, vector.horizon))
    names = [f"episode_cost/{k}" for k in several]
    names += ["episode_reward", "episode_cost", "episode_length", "violation_rate"]
    names += ["true_episode_cost", "true_violation_rate", *COUNTS]
    names += [f"info/{name}" for name in start.env.info]
    sums = {name: jnp.zeros(episodes, start.env.reward.dtype) for name in names}
    carry = (start, jnp.ones(episodes, bool), sums)
    (_, _, sums), kept = jax.lax.scan(step, carry, jnp.arange(vector.horizon))
    per_step = [name for name in sums if not name.removeprefix("true_").startswith("episode_") and name not in COUNTS]
    return {**sums, **{name: sums[name] / sums["episode_length"] for name in per_step}, **kept}


def _recorded(
    obs: jax.Array, action: jax.Array, felt: jax.Array, outcome: tasks.Outcome, alive: jax.Array
) -> dict[str, jax.Array]:
    """What `play` keeps of one step of all environments, 0 where an episode has ended."""
    kept = {
        "obs": obs,
        "action": action,
        "reward": outcome.reward,
        "cost": felt,
        "true_cost": outcome.cost,
        "terminated": outcome.terminated,
        "truncated": outcome.truncated,
        **{f"info/{name}": x for name, x in outcome.info.items()},
    }

    def masked(x: jax.Array) -> jax.Array:
        return jnp.where(alive.reshape(alive.shape + (1,) * (x.ndim - 1)), x, jnp.zeros_like(x))

    return {f"{STEP}{name}": masked(x) for name, x in kept.items()}


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
