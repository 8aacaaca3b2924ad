"""A brax or MuJoCo Playground environment as a task; neither library is imported."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..base import EnvSpec, State
from ..errors import TaskError, one_of
from ..partition import evenly, parse


class FromBrax:
    """See `adapters.from_brax`."""

    shares_cost = True

    def __init__(
        self,
        env: Any,
        cost: str,
        cost_limit: float,
        above: float | None,
        horizon: int,
        partition: str | Sequence[Sequence[int]],
        name: str,
    ) -> None:
        self._env, self._cost, self._above = env, cost, above
        start = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), jnp.uint32))
        one_of("metric", cost, start.metrics)
        if start.metrics[cost].shape != ():
            raise TaskError(f"metric '{cost}' must be a scalar, but has shape {start.metrics[cost].shape}")
        count = env.action_size
        self._partition = parse(partition, count) if partition else evenly(1, count)
        mask = self._partition.mask
        agents = len(mask)
        shown, state = (x.shape for x in _seen(start.obs))
        if len(shown) != 1 or len(state) != 1:
            raise TaskError(f"observations must be vectors, but have shapes {shown} and {state}")
        self._index = np.eye(agents, dtype=np.float32) if agents > 1 else np.zeros((1, 0), np.float32)
        self.engine = "mjx" if hasattr(env, "mjx_model") or getattr(env, "backend", "") == "mjx" else "xla"
        self.spec = EnvSpec(
            name=name,
            num_agents=agents,
            obs_dim=shown[0] + self._index.shape[1],
            action_dim=mask.shape[1],
            state_dim=state[0],
            num_costs=1,
            horizon=horizon,
            action_mask=mask,
            cost_limit=cost_limit,
        )

    def reset(self, key: jax.Array) -> State:
        """The start of an episode drawn with `key`; no transition led there, so it has no reward and no cost."""
        start = self._view(self._env.reset(jax.random.key_data(key)))
        return dataclasses.replace(start, reward=jnp.zeros_like(start.reward), cost=jnp.zeros_like(start.cost))

    def step(self, state: State, action: jax.Array) -> State:
        """One control step with `action` [N, A], clipped to [-1, 1]."""
        return self._view(self._env.step(state.carry, self._partition.join(jnp.clip(action, -1.0, 1.0))))

    def _view(self, state: Any) -> State:
        """Our State of the library's, which is carried as it is."""
        seen, whole = _seen(state.obs)
        agents = len(self._index)
        obs = jnp.concatenate([jnp.broadcast_to(seen, (agents, *seen.shape)), self._index.astype(seen.dtype)], axis=1)
        metric = state.metrics[self._cost]
        paid = jnp.clip(metric, 0.0, 1.0) if self._above is None else metric > self._above
        return State(
            obs=obs,
            global_state=whole,
            reward=jnp.asarray(state.reward, seen.dtype),
            cost=jnp.full((agents, 1), paid, seen.dtype),
            terminated=jnp.asarray(state.done, bool),
            info={name: jnp.asarray(x, seen.dtype) for name, x in state.metrics.items() if jnp.shape(x) == ()},
            carry=state,
        )


def _seen(obs: Any) -> tuple[Any, Any]:
    """What agents and critics see: Playground has a dictionary of both for some environments."""
    if not isinstance(obs, dict):
        return obs, obs
    if "state" not in obs:
        raise TaskError(f"observations are a dictionary without 'state': {', '.join(obs)}")
    return obs["state"], obs.get("privileged_state", obs["state"])
