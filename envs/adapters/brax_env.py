"""A task as a brax environment."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
from brax import envs as brax_envs

from ..base import Env, State


class BraxEnv(brax_envs.Env):
    """See `adapters.to_brax`."""

    def __init__(self, env: Env) -> None:
        self._env = env

    def reset(self, rng: jax.Array) -> brax_envs.State:
        """The start of an episode drawn with `rng`, a typed key or a raw one [2]."""
        typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        state = self._env.reset(rng if typed else jax.random.wrap_key_data(rng))
        return brax_envs.State(**self._view(state), info={})

    def step(self, state: brax_envs.State, action: jax.Array) -> brax_envs.State:
        """One control step with the team's `action` [N * A]."""
        mask = jnp.asarray(self._env.spec.action_mask)
        view = self._view(self._env.step(cast(State, state.pipeline_state), action.reshape(mask.shape) * mask))
        view["metrics"] = {**state.metrics, **view["metrics"]}  # brax's wrappers add theirs and expect them back
        return dataclasses.replace(state, **view)

    @property
    def observation_size(self) -> int:
        """N * O."""
        return self._env.spec.num_agents * self._env.spec.obs_dim

    @property
    def action_size(self) -> int:
        """N * A."""
        return self._env.spec.num_agents * self._env.spec.action_dim

    @property
    def backend(self) -> str:
        """The physics engine's name."""
        return self._env.engine

    def _view(self, state: State) -> dict[str, Any]:
        """What brax reads of `state`; the whole of it is carried where brax carries its physics."""
        return {
            "pipeline_state": state,
            "obs": state.obs.ravel(),
            "reward": state.reward,
            "done": state.terminated.astype(state.reward.dtype),
            "metrics": {**state.info, "cost": state.cost.sum(-1).mean()},
        }
