"""A task of your own, trained with `pmt train docs/examples/my_env.py --method f4sg --steps 1e5 --num-envs 48`.

Two agents carry a pole down a corridor, one at each end. Each pushes its end along y; the pole should move fast, and
tilting it makes it faster, but tilting it further than 0.3 costs.
"""

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import EnvSpec, State

NUM_AGENTS = 2


class Pole:
    """The contract of envs/base.py: a spec, an engine, and pure `reset` and `step` of one environment."""

    engine = "xla"  # plain JAX, no physics engine behind it
    spec = EnvSpec(
        name="pole",
        num_agents=NUM_AGENTS,
        obs_dim=3,  # own end, the other end, my place in the team
        action_dim=1,
        state_dim=2,  # both ends: what the critics and the fear prior network see
        num_costs=1,
        horizon=50,  # control steps; the vector wrapper truncates and resets, never the task
        action_mask=np.ones((NUM_AGENTS, 1), np.float32),
        cost_limit=2.0,  # allowed cost of one agent per episode, undiscounted
    )

    def reset(self, key: jax.Array) -> State:
        """Both ends start near the middle."""
        return self._state(0.1 * jax.random.normal(key, (NUM_AGENTS,)), reward=0.0, cost=0.0)

    def step(self, state: State, action: jax.Array) -> State:
        """One control step with `action` [N, A]; clipping it is the task's business."""
        ends = state.carry + 0.1 * jnp.clip(action[:, 0], -1.0, 1.0)
        tilt = jnp.abs(ends[0] - ends[1])
        speed = 1.0 + tilt - 0.1 * jnp.sum(ends**2)
        return self._state(ends, reward=speed, cost=tilt > 0.3)

    def _state(self, ends: jax.Array, reward: jax.Array | float, cost: jax.Array | float) -> State:
        place = jnp.linspace(-1.0, 1.0, NUM_AGENTS)
        return State(
            obs=jnp.stack([ends, ends[::-1], place], axis=1),  # [N, O]
            global_state=ends,  # [S]
            reward=jnp.asarray(reward, jnp.float32),  # [] the team's
            cost=jnp.full((NUM_AGENTS, 1), cost, jnp.float32),  # [N, K] in [0, 1]
            terminated=jnp.max(jnp.abs(ends)) > 2.0,  # [] bool: hit the wall
            info={"tilt": jnp.abs(ends[0] - ends[1])},  # scalars to be logged as info/tilt
            carry=ends,  # whatever the next step needs; any pytree of arrays
        )
