"""The environment contract: one State in, one State out.

An environment is a value with a `spec` and four pure functions. It never resets itself and knows no horizon;
batching, time limits, auto-reset and broken physics are `envs.vector`'s business alone.

Example:
  >>> import jax, envs
  >>> env = envs.make("lane")
  >>> state = env.reset(jax.random.key(0))
  >>> state = env.step(state, jax.numpy.zeros((env.spec.num_agents, env.spec.action_dim)))
  >>> state.obs.shape == (env.spec.num_agents, env.spec.obs_dim)
  True
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np


@dataclasses.dataclass(frozen=True, eq=False)
class EnvSpec:
    """The static facts of a task.

    Attributes:
      name: the task's name, as `envs.make` takes it.
      num_agents: N.
      obs_dim: O, length of one agent's observation (padded to the longest).
      action_dim: A, length of one agent's action (padded to the longest).
      state_dim: S, length of the global state that centralised critics see.
      num_costs: K, cost functions per agent.
      horizon: control steps after which an episode is truncated.
      action_mask: [N, A], 1 where an agent has that action entry, 0 where it is padding.
      cost_limit: the benchmark's limit on one agent's undiscounted cost per episode.
    """

    name: str
    num_agents: int
    obs_dim: int
    action_dim: int
    state_dim: int
    num_costs: int
    horizon: int
    action_mask: np.ndarray
    cost_limit: float


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """One environment at one moment; `reset` and `step` return the same structure, shapes and dtypes.

    Attributes:
      obs: [N, O] local observations.
      global_state: [S] what centralised critics and the fear prior network see.
      reward: [] the team's reward for the transition that led here (0 after a reset).
      cost: [N, K] in [0, 1], for the transition that led here (0 after a reset).
      terminated: [] bool, the task ended here by its own rule (never by a time limit).
      info: scalars for reporting, the same keys from reset on.
      carry: the environment's own quantities.
    """

    obs: jax.Array
    global_state: jax.Array
    reward: jax.Array
    cost: jax.Array
    terminated: jax.Array
    info: dict[str, jax.Array]
    carry: Any


@runtime_checkable
class Env(Protocol):
    """What `envs.make` returns. All methods are pure and can be jitted and vmapped."""

    spec: EnvSpec
    engine: str  # the physics engine behind it, 'xla' where the task is plain JAX

    def reset(self, key: jax.Array) -> State:
        """The start of an episode drawn with `key`."""
        ...

    def step(self, state: State, action: jax.Array) -> State:
        """One control step with `action` [N, A]; actions are clipped by the task's own rule, not by the caller."""
        ...

    def restore(self, **raw: Any) -> State:
        """A State from the raw quantities that `raw` returns, so that recorded transitions can be replayed."""
        ...

    def raw(self, state: State) -> dict[str, jax.Array]:
        """The raw quantities of a state: `restore(**raw(state))` continues exactly as `state` would."""
        ...


@runtime_checkable
class Drawn(Protocol):
    """What an environment of MuJoCo bodies offers beyond `Env` to be seen; its `raw` must then hold `qpos`.

    Bodies that follow no joint move by `mocap_pos` and `mocap_quat` in `raw`, where it holds them.
    """

    model: Any  # the mujoco.MjModel that pictures are drawn from; its first camera, if any, is the view

    def decorate(self, scene: Any, raw: dict[str, np.ndarray], cost: float) -> None:
        """Changes a mujoco.MjvScene of `model` before it is drawn, by colours or by geoms appended to it.

        Args:
          scene: of the moment that `raw` describes.
          raw: the raw quantities of that moment, without a batch axis.
          cost: of the step that led there, mean over agents, summed over costs.
        """
        ...
