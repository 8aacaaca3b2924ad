"""Three constrained tasks small enough for their optimum to be known, for tests of the learner.

Agents (two of them) with two actions each share reward and cost; an episode has 25 steps and never terminates.

| task | dynamics | reward | cost | optimum at limit 0 / at its limit / unconstrained (its cost) |
|---|---|---|---|---|
| `lane` | y' = 0.8 y + 0.2 sum_i mean(a_i) | 1 - (y' - 1)^2 | y' > 0.5 | 18.64 / 18.85 / 24.561 (24) |
| `switch` | none | 1 - (a_00 - 0.9)^2 - 0.1 sum_others (a - 0.5)^2 | abs(a_00) > 0.3 | 16 / 16.36 / 25 (25) |
| `noisy` | as `lane` | as `lane` | y' > 0.5, with probability 0.3 | as `lane`; a step beyond costs 0.3 in the mean |

`lane` has a cost of the state, like the ant; `switch` a cost of the action alone, like the hands; `noisy` a cost that
must be appraised before it can be avoided.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .base import Declarations, EnvSpec, State
from .blocks import Block, agent_index, length
from .errors import at_least, typed

HORIZON = 25
ACTION_DIM = 2


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Carry:
    """position [], time [] int32 (steps since reset), key: what the next step's noise is drawn from."""

    position: jax.Array
    time: jax.Array
    key: jax.Array


class Lane:
    """The team steers one point along a line: the goal is at 1, the danger begins at 0.5."""

    name = "lane"
    cost_limit = 1.0
    engine = "xla"
    shares_cost = True

    @typed
    def __init__(self, num_agents: int = 2) -> None:
        """`num_agents` other than 2 gives a task of the same kind whose optimum is not in the table."""
        at_least("num_agents", num_agents, 1)
        seen = (
            Block("position", 1, "-", "2 y - 1"),
            Block("last action", num_agents * ACTION_DIM, "-", "of all agents, after clipping"),
            Block("time", 1, "-", f"steps since the reset / {HORIZON}"),
        )
        self.declares = Declarations(
            observation=(*seen, agent_index(num_agents)),
            state=seen,
            actions=tuple(tuple(f"a_{i}{j}" for j in range(ACTION_DIM)) for i in range(num_agents)),
        )
        self.spec = EnvSpec(
            name=self.name,
            num_agents=num_agents,
            obs_dim=length(self.declares.observation),
            action_dim=ACTION_DIM,
            state_dim=length(seen),
            num_costs=1,
            horizon=HORIZON,
            action_mask=np.ones((num_agents, ACTION_DIM), np.float32),
            cost_limit=self.cost_limit,
        )

    def reset(self, key: jax.Array) -> State:
        return self.restore(position=0.0, time=0, last_action=jnp.zeros(self.spec.action_mask.shape), key=key)

    def step(self, state: State, action: jax.Array) -> State:
        action = jnp.clip(action, -1.0, 1.0)
        key, noise_key = jax.random.split(state.carry.key)
        position = self._get_position(state.carry.position, action)
        carry = Carry(position, state.carry.time + 1, key)
        return self._state(
            carry,
            action,
            reward=self._get_reward(position, action),
            cost=self._get_cost(position, action, noise_key).astype(position.dtype),
        )

    def restore(self, position: Any, time: Any, last_action: Any, key: Any = None) -> State:
        """The state at `position` [] after `time` [] steps, where `last_action` [N, A] was the last joint action."""
        carry = Carry(
            jnp.asarray(position, float), jnp.asarray(time, jnp.int32), jax.random.key(0) if key is None else key
        )
        zero = jnp.zeros_like(carry.position)
        return self._state(carry, jnp.asarray(last_action, float), reward=zero, cost=zero)

    def raw(self, state: State) -> dict[str, Any]:
        """What `restore` takes."""
        last_action = state.global_state[1:-1].reshape(self.spec.action_mask.shape)
        return {**vars(state.carry), "last_action": last_action}

    def _state(self, carry: Carry, last_action: jax.Array, reward: jax.Array, cost: jax.Array) -> State:
        time = carry.time / jnp.asarray(HORIZON, carry.position.dtype)
        seen = jnp.concatenate([(2 * carry.position - 1)[None], last_action.ravel(), time[None]])
        num_agents = self.spec.num_agents
        agent_id = jnp.eye(num_agents, dtype=seen.dtype)
        return State(
            obs=jnp.concatenate([jnp.broadcast_to(seen, (num_agents, seen.size)), agent_id], axis=1),
            global_state=seen,
            reward=reward,
            cost=jnp.broadcast_to(cost, (num_agents, 1)),
            terminated=jnp.asarray(False),
            info={"position": carry.position},
            carry=carry,
        )

    def _get_position(self, position: jax.Array, action: jax.Array) -> jax.Array:
        return 0.8 * position + 0.2 * jnp.sum(jnp.mean(action, axis=-1))

    def _get_reward(self, position: jax.Array, action: jax.Array) -> jax.Array:
        del action
        return 1 - (position - 1) ** 2

    def _get_cost(self, position: jax.Array, action: jax.Array, key: jax.Array) -> jax.Array:
        del action, key
        return position > 0.5


class Switch(Lane):
    """The best action of agent 0's first actuator is 0.9; beyond 0.3 it costs. Nothing moves."""

    name = "switch"
    shares_cost = True

    def _get_position(self, position: jax.Array, action: jax.Array) -> jax.Array:
        del action
        return position

    def _get_reward(self, position: jax.Array, action: jax.Array) -> jax.Array:
        del position
        others = action.ravel()[1:]
        return 1 - (action[0, 0] - 0.9) ** 2 - 0.1 * jnp.sum((others - 0.5) ** 2)

    def _get_cost(self, position: jax.Array, action: jax.Array, key: jax.Array) -> jax.Array:
        del position, key
        return jnp.abs(action[0, 0]) > 0.3


class Noisy(Lane):
    """`lane` whose danger costs with probability 0.3: the cost signal is mostly noise, fear should not be."""

    name = "noisy"
    cost_limit = 0.5
    shares_cost = True

    def _get_cost(self, position: jax.Array, action: jax.Array, key: jax.Array) -> jax.Array:
        return super()._get_cost(position, action, key) & jax.random.bernoulli(key, 0.3)
