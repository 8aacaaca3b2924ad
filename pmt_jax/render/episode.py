"""One whole episode of a trained team, kept step by step: what pictures are made of."""

from __future__ import annotations

import base64
import dataclasses
import functools
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import tasks
from ..learning.evaluation import EVALUATION_KEY
from ..learning.setup import Setup
from ..learning.types import ActingState
from ..limits import Limits
from ..policies.load import load_seed


@dataclasses.dataclass(frozen=True)
class Episode:
    """T control steps; entry 0 of every array is the moment after the reset.

    Attributes:
      env: the environment it was played in; method, seed: whose policy played.
      limits: on each agent's summed costs.
      raw: {name: [T + 1, ...]}, what the task's picture reads of each moment.
      step: [T + 1] control steps since the reset.
      reward, cost: [T + 1] of the step that led to each moment; cost is the mean over agents, summed over costs.
      reward_sum, cost_sum: [T + 1] of the episode so far; the cost is that of the agent who has the most.
      info: {name: [T + 1]} the task's metrics.
      action: [T + 1, N, A] that led to each moment; 0 at the reset.
    """

    env: tasks.Env
    method: str
    seed: int
    limits: Limits
    raw: dict[str, np.ndarray]
    step: np.ndarray
    reward: np.ndarray
    cost: np.ndarray
    reward_sum: np.ndarray
    cost_sum: np.ndarray
    info: dict[str, np.ndarray]
    action: np.ndarray

    def __len__(self) -> int:
        return len(self.reward)

    @property
    def picture(self) -> Any:
        """How the task declares that it is drawn: a `Scene`, a `NetworkMap` or `Plain` of `envs.base`."""
        return tasks.declarations(self.env).picture

    def at(self, t: int) -> dict[str, np.ndarray]:
        """The raw quantities of moment `t`."""
        return {name: x[t] for name, x in self.raw.items()}

    def cut(self, moments: slice) -> Episode:
        """The part of it that pictures show; a cost between two moments counts at the later one."""
        names = ("raw", "step", "reward", "reward_sum", "cost_sum", "info", "action")
        arrays = jax.tree.map(lambda x: x[moments], {name: getattr(self, name) for name in names})
        kept = np.arange(len(self))[moments]
        since = np.concatenate([kept[:1], kept[:-1] + 1])
        cost = np.array([self.cost[a : b + 1].max() for a, b in zip(since, kept, strict=True)])
        return dataclasses.replace(self, cost=cost, **arrays)


def record_run(folder: pathlib.Path, seed: int | None = None, number: int = 0, deterministic: bool = False) -> Episode:
    """Plays one episode with the policy of a run folder.

    Args:
      folder: the run folder, or the name of a pretrained policy.
      seed: of the run's seeds; its first if None.
      number: which of the fixed starts.
      deterministic: take the mean action instead of a sample.

    Raises:
      UsageError: the folder holds no run that can be loaded, or no such seed.
    """
    setup, seed, state = load_seed(folder, seed)
    program = jax.jit(functools.partial(record, setup, deterministic=deterministic))
    moments = jax.device_get(program(state, jnp.asarray(number)))
    return _whole(setup, seed, moments)


def record(setup: Setup, state: ActingState, number: jax.Array, *, deterministic: bool) -> dict[str, Any]:
    """The moments of one episode up to its time limit, whether or not it ended before; pure.

    Args:
      state: a learner state of one seed, or what of it acts.
      number: [] which of the fixed starts.

    Returns:
      raw, reward, cost, info, action, terminated with a leading [horizon + 1]; see `Episode`, but cost is each agent's.
    """
    env = setup.vector.env
    mask, picture = jnp.asarray(env.spec.action_mask), tasks.declarations(env).picture
    start_key, noise_key = jax.random.split(jax.random.fold_in(jax.random.key(EVALUATION_KEY), number))

    def moment(s: tasks.State, action: jax.Array) -> dict[str, Any]:
        found = picture.raw(s)
        raw = {k: x for k, x in found.items() if x is not None and not jnp.issubdtype(x.dtype, jax.dtypes.prng_key)}
        step = {
            "reward": s.reward,
            "cost": s.cost.sum(-1),
            "info": s.info,
            "action": action,
            "terminated": s.terminated,
        }
        return {"raw": raw, **step}

    def step(now: tuple[tasks.State, Any], t: jax.Array) -> tuple[tuple[tasks.State, Any], dict[str, Any]]:
        s, hidden = now
        mean, std, hidden = setup.nets.act(state.actor.params, setup.scale(state.obs_moments, s.obs[None]), hidden)
        noise = 0.0 if deterministic else jax.random.normal(jax.random.fold_in(noise_key, t), mean.shape)
        action = (mean + std * noise)[0] * mask
        after = env.step(s, action)
        return (after, hidden), moment(after, action)

    start, memory = env.reset(start_key), setup.nets.start(1)
    _, later = jax.lax.scan(step, (start, memory and memory.actor), jnp.arange(setup.vector.horizon))
    return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), moment(start, 0 * mask), later)


def _whole(setup: Setup, seed: int, moments: dict[str, Any]) -> Episode:
    """The moments up to the first termination, without those that are not finite (nothing can draw them)."""
    raw = [x for x in moments["raw"].values() if np.issubdtype(x.dtype, np.floating)]
    floats = [x.reshape(len(x), -1) for x in (moments["reward"], *raw)]
    broken = np.asarray(~np.isfinite(np.concatenate(floats, axis=1)).all(axis=1))
    ends = np.flatnonzero(moments.pop("terminated") & ~broken) + 1
    length = min([len(broken), *ends[:1], *np.flatnonzero(broken)[:1]])
    costs = moments.pop("cost")
    moments["cost"] = costs.mean(1)
    sums = {"reward_sum": moments["reward"].cumsum(), "cost_sum": costs.cumsum(0).max(1)}
    steps = np.arange(len(broken))
    limits = setup.limits.true(setup.config.cost_seen)  # as the costs are
    whole = Episode(setup.vector.env, setup.label, seed, limits, step=steps, **moments, **sums)
    return whole.cut(slice(length))


def to_base64(x: np.ndarray) -> str:
    """Numbers for a page's script: bytes as they are, everything else as little-endian f32."""
    return base64.b64encode(np.ascontiguousarray(x, "u1" if x.dtype == np.uint8 else "<f4").tobytes()).decode()
