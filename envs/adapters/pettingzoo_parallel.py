"""A task as a PettingZoo parallel environment."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pettingzoo
from gymnasium.spaces import Box, Space

from ..base import Env
from ..vector import VectorEnv

ByAgent = dict[str, Any]


class PettingZooParallel(pettingzoo.ParallelEnv):
    """See `adapters.to_pettingzoo`."""

    def __init__(self, env: Env, seed: int) -> None:
        spec = env.spec
        self.metadata = {"name": spec.name, "render_modes": []}
        self.possible_agents = [f"agent_{i}" for i in range(spec.num_agents)]
        self.agents: list[str] = []
        self._mask = np.asarray(spec.action_mask, bool)
        sizes = zip(self.possible_agents, self._mask.sum(1), strict=True)
        self.action_spaces = {agent: Box(-1.0, 1.0, (int(size),), np.float32) for agent, size in sizes}
        self.observation_spaces = {
            agent: Box(-np.inf, np.inf, (spec.obs_dim,), np.float32) for agent in self.possible_agents
        }
        self.state_space = Box(-np.inf, np.inf, (spec.state_dim,), np.float32)
        self._vector = VectorEnv(env, 1)
        self._reset, self._step = jax.jit(self._vector.reset), jax.jit(self._vector.step)
        self._rng = np.random.default_rng(seed)
        self._state: Any = None
        self._global_state: Any = None

    def observation_space(self, agent: str) -> Space:
        """`agent`'s observations: [O], always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space:
        """`agent`'s actions: its own entries, each in [-1, 1]; always the same object."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ByAgent, ByAgent]:
        """A fresh episode; the same `seed` starts the same one. The task has no `options`."""
        del options
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        self._state = self._reset(jax.random.key(int(self._rng.integers(2**31))))
        first = jax.tree.map(lambda x: x[0], self._state.env)
        self._global_state = np.asarray(first.global_state)
        return self._each(first.obs), self._infos(first.cost, first.info)

    def step(self, actions: ByAgent) -> tuple[ByAgent, ByAgent, ByAgent, ByAgent, ByAgent]:
        """One control step with every agent's action; an episode ends for all agents at once."""
        joint = np.zeros((1, *self._mask.shape), np.float32)
        for i, agent in enumerate(self.possible_agents):
            joint[0, i, self._mask[i]] = actions[agent]
        self._state, outcome = self._step(self._state, joint)
        happened = jax.tree.map(lambda x: x[0], jax.device_get(outcome))
        self._global_state = happened.next_global_state
        flags = happened.reward.item(), happened.terminated.item(), happened.truncated.item()
        rewards, terminated, truncated = (dict.fromkeys(self.agents, flag) for flag in flags)
        infos = self._infos(happened.cost, happened.info)
        if flags[1] or flags[2]:
            self.agents = []
        return self._each(happened.next_obs), rewards, terminated, truncated, infos

    def state(self) -> np.ndarray:
        """The global state [S] that centralised critics see."""
        return self._global_state

    def _each(self, rows: Any) -> ByAgent:
        return dict(zip(self.possible_agents, np.asarray(rows), strict=True))

    def _infos(self, cost: Any, info: dict[str, Any]) -> ByAgent:
        shared = {name: float(x) for name, x in info.items()}
        return {agent: {"cost": row, **shared} for agent, row in self._each(cost).items()}
