"""`recall`, a task for recurrent policies: its danger is shown at the start of an episode and must be remembered."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import EnvSpec, State

STEPS = 8
LIMIT = 1.0
OPTIMUM = float(STEPS)  # away from the danger in every step
# A policy without memory knows the side in the first step alone. In any other, whatever it does, half of the episodes
# have the danger on the side that it takes: a step that moves earns at most 1 and costs 1/2 in the mean, one that stays
# at 0 earns and costs nothing. With a cost of at most LIMIT an episode, 2 * LIMIT steps move besides the first.
WITHOUT_MEMORY = 1 + 2 * LIMIT


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Carry:
    """side [] -1 or 1, where the danger is; time [] int32."""

    side: jax.Array
    time: jax.Array


class Recall:
    """Two agents move a point along a line, u = mean of their actions in [-1, 1], and it returns to 0 after each step.

    The reward is abs(u), on either side. One side is dangerous for the whole episode: there a step costs 1.
    Observations and the state show the side in the first step alone, and the time.
    """

    engine = "xla"
    shares_cost = True

    def __init__(self) -> None:
        self.spec = EnvSpec(
            name="recall",
            num_agents=2,
            obs_dim=4,
            action_dim=1,
            state_dim=2,
            num_costs=1,
            horizon=STEPS,
            action_mask=np.ones((2, 1), np.float32),
            cost_limit=LIMIT,
        )

    def reset(self, key: jax.Array) -> State:
        side = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
        return self._state(Carry(side, jnp.int32(0)), jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        carry = dataclasses.replace(state.carry, time=state.carry.time + 1)
        return self._state(carry, jnp.clip(action, -1.0, 1.0).mean())

    def _state(self, carry: Any, u: jax.Array) -> State:
        seen = jnp.stack([jnp.where(carry.time == 0, carry.side, 0.0), carry.time / STEPS])
        return State(
            obs=jnp.concatenate([jnp.broadcast_to(seen, (2, 2)), jnp.eye(2)], axis=1),
            global_state=seen,
            reward=jnp.abs(u),
            cost=jnp.broadcast_to(u * carry.side > 0, (2, 1)).astype(u.dtype),
            terminated=jnp.asarray(False),
            info={"u": u},
            carry=carry,
        )
