"""How good and how safe a policy is: whole episodes under fixed keys, each environment's first episode only.

Counting first episodes only keeps short episodes from being counted more often than long ones.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from . import normalise, tasks
from .run import Run
from .types import LearnerState, Metrics

EVALUATION_KEY = 20_260_000  # far from the seeds people use for training


def evaluate(run: Run, state: LearnerState, episodes: int, *, deterministic: bool) -> Metrics:
    """Runs one seed's policy for `episodes` whole episodes.

    Args:
      run: the run's task and networks.
      state: a learner state of one seed.
      episodes: environments, one episode each.
      deterministic: take the mean action instead of a sample.

    Returns:
      episode_reward, episode_cost (one agent's, mean over agents, summed over K), episode_length, violation_rate (share
      of the episode's steps with a cost above 0 for some agent) and the task's info (means over the episode), each
      [episodes]; all undiscounted.
    """
    vector = tasks.VectorEnv(run.vector.env, episodes)
    key = jax.random.key(EVALUATION_KEY)
    running = run.config.obs_norm == "running"
    mask = jnp.asarray(vector.spec.action_mask)

    def step(carry: tuple[tasks.VectorState, jax.Array, Metrics], t: jax.Array) -> tuple[tuple, None]:
        envs, alive, sums = carry
        obs = normalise.normalise_obs(state.obs_moments, envs.env.obs) if running else envs.env.obs
        mean, std = run.nets.policies(state.actor.params, obs)
        noise = 0.0 if deterministic else jax.random.normal(jax.random.fold_in(key, t), mean.shape)
        envs, outcome = vector.step(envs, (mean + std * noise) * mask)
        cost = outcome.cost.sum(-1)
        now = {
            "episode_reward": outcome.reward,
            "episode_cost": cost.mean(-1),
            "episode_length": jnp.ones_like(outcome.reward),
            "violation_rate": (cost.max(-1) > 0).astype(outcome.reward.dtype),
            **{f"info/{name}": x.astype(outcome.reward.dtype) for name, x in outcome.info.items()},
        }
        sums = {name: sums[name] + alive * now[name] for name in sums}
        return (envs, alive & ~(outcome.terminated | outcome.truncated), sums), None

    envs = vector.reset(jax.random.fold_in(key, vector.horizon))
    names = ["episode_reward", "episode_cost", "episode_length", "violation_rate"]
    names += [f"info/{name}" for name in envs.env.info]
    sums = {name: jnp.zeros(episodes) for name in names}
    start = (envs, jnp.ones(episodes, bool), sums)
    (_, _, sums), _ = jax.lax.scan(step, start, jnp.arange(vector.horizon))
    per_step = [name for name in sums if not name.startswith("episode_")]
    return {**sums, **{name: sums[name] / sums["episode_length"] for name in per_step}}
