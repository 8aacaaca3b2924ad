"""The usual baselines: no reactive power, random actions, IEEE 1547 droop, and optimal dispatch.

Each function makes a policy for an environment of `envs.voltage.control`: `policy(state) -> action` [N, 1], pure, to be
jitted and vmapped like the environment itself.

Examples:
  >>> import jax, envs
  >>> env = envs.make("voltage_33")
  >>> policy = droop(env)
  >>> state = env.reset(jax.random.key(0))
  >>> policy(state).shape
  (6, 1)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import optax

from ..base import Controller, EnvSpec, State
from .power_flow import PowerFlow

# IEEE 1547-2018, category B: 44 % of the rating over 6 % of voltage. The standard's default curve has a dead band of
# 2 % around nominal voltage, the baseline that is quoted for this benchmark has none.
DROOP_SLOPE = 0.44 / 0.06
DROOP_RESPONSE = 0.5  # share of the way to the curve in one control step; all of it would oscillate


class Grid(Protocol):
    """What a baseline reads of an environment of `envs.voltage.control`, see there."""

    spec: EnvSpec
    scenario: Any
    s_max: jax.Array
    v_lower: float
    v_upper: float

    def q_limit(self, row: jax.Array) -> jax.Array:
        """[n_pv] MVAr."""
        ...

    def flow(self, state: State, action: jax.Array) -> PowerFlow:
        """What the next step's row gives under `action`."""
        ...


def zero(env: Grid) -> Controller:
    """No reactive power."""
    return lambda state: jnp.zeros((env.spec.num_agents, 1), state.obs.dtype)


def random(env: Grid) -> Controller:
    """Uniform in [-1, 1], drawn from the state's own key."""

    def policy(state: State) -> jax.Array:
        key = jax.random.fold_in(jax.random.fold_in(state.carry.key, state.carry.start_row), state.carry.steps)
        return jax.random.uniform(key, (env.spec.num_agents, 1), state.obs.dtype, -1.0, 1.0)

    return policy


def droop(
    env: Grid,
    slope: float = DROOP_SLOPE,
    dead_band: float = 0.0,
    largest_share: float = 1.0,
    response: float = DROOP_RESPONSE,
) -> Controller:
    """Volt-var droop on each inverter's own voltage, followed with a first-order lag.

    Args:
      slope: reactive power per p.u. of voltage, as a share of the inverter's rating.
      dead_band: p.u. around 1 without reactive power.
      largest_share: of the rating, where the curve ends (0.44 in the standard); a, the action, ends at 1 anyway.
      response: share of the way to the curve that one control step makes.
    """
    buses = jnp.asarray(env.scenario.table["pv_bus"])

    def policy(state: State) -> jax.Array:
        off = state.carry.vm_pu[buses] - 1
        beyond = jnp.sign(off) * jnp.maximum(jnp.abs(off) - dead_band, 0)
        target = -env.s_max * jnp.clip(slope * beyond, -largest_share, largest_share)
        q = state.carry.q + response * (target - state.carry.q)
        return q_to_action(env, state, q)

    return policy


def opf(env: Grid, iterations: int = 60, margin: float = 5e-4, price: float = 20.0) -> Controller:
    """Least line losses with voltages in the band, knowing the row to come and every bus: a bound, not a controller.

    Adam on the actions through the differentiable power flow. Leaving the band costs `price` MW per p.u. and bus, from
    `margin` p.u. inside of it on; if the band cannot be kept, the violation becomes small.
    """
    lower, upper = env.v_lower + margin, env.v_upper - margin

    def objective(action: jax.Array, state: State) -> jax.Array:
        flow = env.flow(state, action)
        excess = jnp.maximum(flow.vm_pu - upper, 0) + jnp.maximum(lower - flow.vm_pu, 0)
        return flow.line_loss_mw + price * jnp.sum(excess)

    gradient = jax.grad(objective)
    adam = optax.adam(optax.polynomial_schedule(0.2, 0.0, 1.5, iterations), b1=0.8, b2=0.95, eps=1e-6)

    def policy(state: State) -> jax.Array:
        def descend(_: jax.Array, c: tuple[jax.Array, optax.OptState]) -> tuple[jax.Array, optax.OptState]:
            action, moments = c
            slope = jnp.nan_to_num(gradient(action, state))  # nan where the flow has no solution: stay
            step, moments = adam.update(slope, moments)
            return jnp.clip(action + jnp.asarray(step), -1.0, 1.0), moments

        start = jnp.clip(q_to_action(env, state, state.carry.q), -1.0, 1.0)
        return jax.lax.fori_loop(0, iterations, descend, (start, adam.init(start)))[0]

    return policy


CONTROLLERS: dict[str, Callable[[Grid], Controller]] = {
    "zero": zero,
    "random": random,
    "droop": droop,
    "opf": opf,
}


def q_to_action(env: Grid, state: State, q: jax.Array) -> jax.Array:
    """[N, 1] the action that sets reactive powers `q` [N] MVAr in the next step; beyond [-1, 1] if it cannot."""
    limit = env.scenario.action_scale * env.q_limit(state.carry.row)
    return (q / jnp.maximum(limit, 1e-9))[:, None]
