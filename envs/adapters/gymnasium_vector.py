"""A task as a gymnasium vector environment."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ..base import Env
from ..errors import TaskError, one_of
from ..vector import Outcome, VectorEnv, VectorState
from .arrays import action, boxes, count, key, owned

Info = dict[str, Any]
MODES = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)


class GymnasiumVector(gymnasium.vector.VectorEnv):
    """See `adapters.to_gymnasium`."""

    def __init__(self, env: Env, num_envs: int, seed: int, autoreset_mode: AutoresetMode | str) -> None:
        mode = str(getattr(autoreset_mode, "value", autoreset_mode))
        self._mode = AutoresetMode(one_of("autoreset_mode", mode, [x.value for x in MODES]))
        self.metadata = {"autoreset_mode": self._mode}
        self.num_envs = count("num_envs", num_envs)
        single = boxes(env)
        self.single_observation_space, self.single_action_space = single["obs"], single["action"]
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._env = env
        self._np_random, self._np_random_seed = seeding.np_random(seed)
        self._state: VectorState | None = None
        self._waiting = np.zeros(self.num_envs, bool)  # for a step that only shows the new episode
        self._compile()

    def _compile(self) -> None:
        self._vector = VectorEnv(self._env, self.num_envs)
        self._reset, self._step = jax.jit(self._vector.reset), jax.jit(functools.partial(_step, self._vector))

    def __getstate__(self) -> dict[str, Any]:
        """All but the programs, which the copy compiles anew."""
        return {name: x for name, x in vars(self).items() if name not in ("_reset", "_step", "_vector")}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self.__dict__.update(kept)
        self._compile()

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[np.ndarray, Info]:
        """Fresh episodes everywhere; the same `seed` starts the same ones. The task has no `options`.

        Raises:
          TaskError: `options` asks for some of the environments only.
        """
        if "reset_mask" in (options or {}):
            raise TaskError("reset_mask cannot be had: episodes that end begin anew by themselves; reset without it")
        super().reset(seed=seed)
        self._state = state = self._reset(key(self.np_random))
        self._waiting[:] = False
        start = owned(state.env)
        return start.obs, {**start.info, "global_state": start.global_state, "cost": start.cost}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """One control step of all environments with `actions` [num_envs, N, A].

        Raises:
          TaskError: there was no `reset` before, or `actions` has another shape.
        """
        if self._state is None:
            raise TaskError("step was called before reset, which begins the first episodes; call reset() first")
        joint = action(actions, self.action_space, "actions") * self._vector.spec.action_mask
        self._state, happened, start = self._step(self._state, self._waiting, joint)
        happened, start = owned(happened), owned(start)
        done = happened.terminated | happened.truncated
        info = {**happened.info, "cost": happened.cost}
        if self._mode is AutoresetMode.NEXT_STEP:
            self._waiting = done
            shown, state = happened.next_obs, happened.next_global_state
        else:
            shown, state = start.obs, start.global_state
            if done.any():
                last = {"global_state": happened.next_global_state, **owned(info)}
                each = last | {f"_{name}": done.copy() for name in last}
                info |= {"final_obs": happened.next_obs, "_final_obs": done.copy()}
                info |= {"final_info": each, "_final_info": done.copy()}
        info["global_state"] = state
        return shown, happened.reward, happened.terminated, happened.truncated, info


def _step(
    vector: VectorEnv, state: VectorState, waiting: jax.Array, action: jax.Array
) -> tuple[VectorState, Outcome, Any]:
    """A step of the environments that are not `waiting` [B]; the others only show where their new episode begins.

    Returns:
      the state; what happened; and the State from which the next step starts.
    """
    after, outcome = vector.step(state, action)
    begun, nothing = state.env, jnp.zeros(vector.num_envs, bool)
    shown = Outcome(
        begun.reward, begun.cost, begun.info, nothing, nothing, begun.obs, begun.global_state, nothing, nothing
    )

    def where_waiting(x: Any, y: Any) -> Any:
        return jax.vmap(lambda yes, x, y: jax.tree.map(functools.partial(jnp.where, yes), x, y))(waiting, x, y)

    after = where_waiting(state, after)
    return after, where_waiting(shown, outcome), after.env
