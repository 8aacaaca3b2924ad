"""A task as a PettingZoo parallel environment."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pettingzoo
from gymnasium.spaces import Box, Space

from ..base import Env
from ..errors import TaskError
from ..vector import VectorEnv, VectorState
from .arrays import action, boxes, key, owned

ByAgent = dict[str, Any]


class PettingZooParallel(pettingzoo.ParallelEnv):
    """See `adapters.to_pettingzoo`."""

    def __init__(self, env: Env, seed: int) -> None:
        spec, spaces = env.spec, boxes(env)
        self.metadata = {"name": spec.name, "render_modes": []}
        self.possible_agents = [f"agent_{i}" for i in range(spec.num_agents)]
        self.agents: list[str] = []
        self._mask = np.asarray(spec.action_mask, bool)
        sizes = zip(self.possible_agents, self._mask.sum(1), strict=True)
        self.action_spaces = {agent: Box(-1.0, 1.0, (int(size),), spaces["action"].dtype.type) for agent, size in sizes}
        self.observation_spaces = {
            agent: Box(-np.inf, np.inf, (spec.obs_dim,), spaces["obs"].dtype.type) for agent in self.possible_agents
        }
        self.state_space = spaces["global_state"]
        self._env = env
        self._rng = np.random.default_rng(seed)
        self._state: VectorState | None = None
        self._global_state = np.zeros(0)
        self._compile()

    def _compile(self) -> None:
        self._vector = VectorEnv(self._env, 1)
        self._reset, self._step = jax.jit(self._vector.reset), jax.jit(self._vector.step)

    def __getstate__(self) -> dict[str, Any]:
        """All but the programs, which the copy compiles anew."""
        return {name: x for name, x in vars(self).items() if name not in ("_reset", "_step", "_vector")}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self.__dict__.update(kept)
        self._compile()

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
        self._state = state = self._reset(key(self._rng))
        first = jax.tree.map(lambda x: x[0], owned(state.env))
        self._global_state = first.global_state
        return self._each(first.obs), self._infos(first.cost, first.info)

    def step(self, actions: ByAgent) -> tuple[ByAgent, ByAgent, ByAgent, ByAgent, ByAgent]:
        """One control step with every agent's action; an episode ends for all agents at once.

        Raises:
          TaskError: no episode runs, or an agent's action is missing or has another shape.
        """
        if self._state is None:
            raise TaskError("step was called before reset, which begins the first episode; call reset() first")
        if not self.agents:
            raise TaskError("the episode has ended, so there is nothing to step; call reset() to begin the next one")
        self._state, outcome = self._step(self._state, self._joint(actions))
        happened = jax.tree.map(lambda x: x[0], owned(outcome))
        self._global_state = happened.next_global_state
        flags = happened.reward.item(), happened.terminated.item(), happened.truncated.item()
        rewards, terminated, truncated = (dict.fromkeys(self.agents, flag) for flag in flags)
        infos = self._infos(happened.cost, happened.info)
        if flags[1] or flags[2]:
            self.agents = []
        return self._each(happened.next_obs), rewards, terminated, truncated, infos

    def state(self) -> np.ndarray:
        """The global state [S] that centralised critics see; after the end of an episode its last one.

        Raises:
          TaskError: no episode has begun.
        """
        if self._state is None:
            raise TaskError("state was called before reset, which begins the first episode; call reset() first")
        return self._global_state.copy()

    def _joint(self, actions: ByAgent) -> np.ndarray:
        """[1, N, A] of every agent's own entries."""
        joint = np.zeros((1, *self._mask.shape), self.action_spaces[self.possible_agents[0]].dtype)
        for i, agent in enumerate(self.possible_agents):
            if agent not in actions:
                raise TaskError(f"step needs an action of every agent, but there is none of {agent}")
            joint[0, i, self._mask[i]] = action(actions[agent], self.action_spaces[agent], f"the action of {agent}")
        return joint

    def _each(self, rows: np.ndarray) -> ByAgent:
        return dict(zip(self.possible_agents, rows, strict=True))

    def _infos(self, cost: np.ndarray, info: dict[str, Any]) -> ByAgent:
        shared = {name: float(x) for name, x in info.items()}
        return {agent: {**shared, "cost": row} for agent, row in self._each(cost).items()}
