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


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class JaxMarlState(VectorState):
    """An environment at the moment before its next action, and what its last step led to before any new episode.

    Attributes:
      last_obs: [1, N, O]; last_global_state: [1, S].
    """

    last_obs: jax.Array
    last_global_state: jax.Array

    @classmethod
    def of(cls, state: VectorState, obs: jax.Array, global_state: jax.Array) -> JaxMarlState:
        """`state`, which a step led to by way of these."""
        return cls(**vars(state), last_obs=obs, last_global_state=global_state)


class JaxMarlEnv:
    """See `adapters.to_jaxmarl`."""

    def __init__(self, env: Env) -> None:
        spec = env.spec
        self.num_agents = spec.num_agents
        self.agents = [f"agent_{i}" for i in range(spec.num_agents)]
        self._entries = [np.flatnonzero(row) for row in spec.action_mask]
        self._vector = VectorEnv(env, 1)  # ends episodes and starts new ones
        dtype = jax.eval_shape(env.reset, jax.random.key(0)).obs.dtype
        self.observation_spaces = {agent: Box(-np.inf, np.inf, (spec.obs_dim,), dtype) for agent in self.agents}
        self.action_spaces = {
            agent: Box(-1.0, 1.0, (len(entries),), dtype)
            for agent, entries in zip(self.agents, self._entries, strict=True)
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

    def reset(self, key: jax.Array) -> tuple[ByAgent, JaxMarlState]:
        """The start of an episode drawn with `key`, a typed key or a raw one [2]."""
        typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
        state = self._vector.reset(key if typed else jax.random.wrap_key_data(key))
        return self.get_obs(state), JaxMarlState.of(state, state.env.obs, state.env.global_state)

    def step(
        self, key: jax.Array, state: JaxMarlState, actions: ByAgent, reset_state: JaxMarlState | None = None
    ) -> tuple[ByAgent, JaxMarlState, ByAgent, ByAgent, ByAgent]:
        """One control step; if an episode ends, a new one begins, drawn with the state's own key or `reset_state`.

        Returns:
          observations (of the new episode, if one begins), state, rewards, dones with `__all__`, and infos.
        """
        del key
        joint = jnp.zeros((1, *self._vector.spec.action_mask.shape))
        for i, (agent, entries) in enumerate(zip(self.agents, self._entries, strict=True)):
            joint = joint.at[0, i, entries].set(actions[agent][: len(entries)])
        after, outcome = self._vector.step(_plain(state), joint)
        after = JaxMarlState.of(after, outcome.next_obs, outcome.next_global_state)
        happened = jax.tree.map(lambda x: x[0], outcome)
        done = happened.terminated | happened.truncated
        if reset_state is not None:
            begun = JaxMarlState.of(_plain(reset_state), after.last_obs, after.last_global_state)
            after = jax.tree.map(lambda x, y: jnp.where(done, x, y), begun, after)
        each = {**happened.info, "truncated": happened.truncated}
        infos = {name: jnp.broadcast_to(x, (self.num_agents,)) for name, x in each.items()}
        infos["cost"] = happened.cost.sum(-1)
        if happened.cost.shape[-1] > 1:
            infos |= {f"cost/{k}": happened.cost[:, k] for k in range(happened.cost.shape[-1])}
        dones = dict.fromkeys([*self.agents, "__all__"], done)
        return self.get_obs(after), after, dict.fromkeys(self.agents, happened.reward), dones, infos

    def get_obs(self, state: VectorState) -> ByAgent:
        """Every agent's observation [O]."""
        return dict(zip(self.agents, state.env.obs[0], strict=True))

    def world_state_size(self) -> int:
        """S, the length of the global state."""
        return self._vector.spec.state_dim

    def get_world_state(self, state: VectorState) -> jax.Array:
        """The global state [S], for centralised critics."""
        return state.env.global_state[0]

    def get_last_obs(self, state: JaxMarlState) -> ByAgent:
        """Every agent's observation [O] after the last step; where an episode ended there, its last one."""
        return dict(zip(self.agents, state.last_obs[0], strict=True))

    def get_last_world_state(self, state: JaxMarlState) -> jax.Array:
        """The global state [S] after the last step; where an episode ended there, its last one: a critic bootstraps
        from it at a time limit."""
        return state.last_global_state[0]


def _plain(state: VectorState) -> VectorState:
    return VectorState(state.env, state.elapsed, state.episode, state.key)
