"""A task with JaxMARL's programming interface; JaxMARL itself need not be installed."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base import Env
from ..vector import VectorEnv, VectorState

ByAgent = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Box:
    """Arrays of one shape within bounds, as JaxMARL's spaces are."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any = jnp.float32

    def sample(self, rng: jax.Array) -> jax.Array:
        """Uniform where the bounds are finite, else standard normal."""
        if np.isfinite([self.low, self.high]).all():
            return jax.random.uniform(rng, self.shape, self.dtype, self.low, self.high)
        return jax.random.normal(rng, self.shape, self.dtype)

    def contains(self, x: jax.Array) -> jax.Array:
        """Whether `x` is within the bounds."""
        return jnp.all((x >= self.low) & (x <= self.high))


class JaxMarlEnv:
    """See `adapters.to_jaxmarl`."""

    def __init__(self, env: Env) -> None:
        spec = env.spec
        self.num_agents = spec.num_agents
        self.agents = [f"agent_{i}" for i in range(spec.num_agents)]
        self._entries = [np.flatnonzero(row) for row in spec.action_mask]
        self._vector = VectorEnv(env, 1)  # ends episodes and starts new ones
        self.observation_spaces = {agent: Box(-np.inf, np.inf, (spec.obs_dim,)) for agent in self.agents}
        self.action_spaces = {
            agent: Box(-1.0, 1.0, (len(entries),)) for agent, entries in zip(self.agents, self._entries, strict=True)
        }

    @property
    def name(self) -> str:
        """The task's name."""
        return self._vector.spec.name

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """All agents are of one class."""
        return {"agents": self.agents}

    def observation_space(self, agent: str) -> Box:
        """`agent`'s observations [O]."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """`agent`'s actions: its own entries, each in [-1, 1]."""
        return self.action_spaces[agent]

    def reset(self, key: jax.Array) -> tuple[ByAgent, VectorState]:
        """The start of an episode drawn with `key`, a typed key or a raw one [2]."""
        typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
        state = self._vector.reset(key if typed else jax.random.wrap_key_data(key))
        return self.get_obs(state), state

    def step(
        self, key: jax.Array, state: VectorState, actions: ByAgent, reset_state: VectorState | None = None
    ) -> tuple[ByAgent, VectorState, ByAgent, ByAgent, ByAgent]:
        """One control step; if an episode ends, a new one begins, drawn with the state's own key or `reset_state`.

        Returns:
          observations (of the new episode, if one begins), state, rewards, dones with `__all__`, and infos.
        """
        del key
        joint = jnp.zeros((1, *self._vector.spec.action_mask.shape))
        for i, (agent, entries) in enumerate(zip(self.agents, self._entries, strict=True)):
            joint = joint.at[0, i, entries].set(actions[agent][: len(entries)])
        after, outcome = self._vector.step(state, joint)
        happened = jax.tree.map(lambda x: x[0], outcome)
        done = happened.terminated | happened.truncated
        if reset_state is not None:
            after = jax.tree.map(lambda x, y: jnp.where(done, x, y), reset_state, after)
        each = {"truncated": happened.truncated, **happened.info}
        infos = {name: jnp.broadcast_to(x, (self.num_agents,)) for name, x in each.items()}
        infos["cost"] = happened.cost.sum(-1)
        if happened.cost.shape[-1] > 1:
            infos |= {f"cost/{k}": happened.cost[:, k] for k in range(happened.cost.shape[-1])}
        dones = dict.fromkeys([*self.agents, "__all__"], done)
        return self.get_obs(after), after, dict.fromkeys(self.agents, happened.reward), dones, infos

    def get_obs(self, state: VectorState) -> ByAgent:
        """Every agent's observation [O]."""
        return dict(zip(self.agents, state.env.obs[0], strict=True))
