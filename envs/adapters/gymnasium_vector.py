"""A task as a gymnasium vector environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ..base import Env
from ..vector import VectorEnv

Info = dict[str, Any]


class GymnasiumVector(gymnasium.vector.VectorEnv):
    """See `adapters.to_gymnasium`."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env: Env, num_envs: int, seed: int) -> None:
        spec = env.spec
        self.num_envs = num_envs
        self.single_observation_space = Box(-np.inf, np.inf, (spec.num_agents, spec.obs_dim), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (spec.num_agents, spec.action_dim), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._vector = VectorEnv(env, num_envs)
        self._reset, self._step = jax.jit(self._vector.reset), jax.jit(self._vector.step)
        self._np_random, self._np_random_seed = seeding.np_random(seed)
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[np.ndarray, Info]:
        """Fresh episodes everywhere; the same `seed` starts the same ones. The task has no `options`."""
        del options
        super().reset(seed=seed)
        self._state = self._reset(jax.random.key(int(self.np_random.integers(2**31))))
        return self._seen()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """One control step of all environments with `actions` [num_envs, N, A]; those that end start anew at once."""
        self._state, outcome = self._step(self._state, np.asarray(actions, np.float32) * self._vector.spec.action_mask)
        happened = jax.device_get(outcome)
        done = happened.terminated | happened.truncated
        obs, info = self._seen()
        info |= {"cost": happened.cost, **happened.info}
        if done.any():
            info |= {"final_obs": happened.next_obs, "_final_obs": done}
        return obs, happened.reward, happened.terminated, happened.truncated, info

    def _seen(self) -> tuple[np.ndarray, Info]:
        obs, state, cost, info = jax.device_get(
            (self._state.env.obs, self._state.env.global_state, self._state.env.cost, self._state.env.info)
        )
        return obs, {"global_state": state, "cost": cost, **info}
