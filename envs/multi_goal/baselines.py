"""Policies that need no training: none, random, and for points one that turns to its goal and goes there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp

from ..base import Controller, EnvSpec, State


class Robots(Protocol):
    """What a baseline reads of an environment of `envs.multi_goal.multi_goal`, see there."""

    robot: str
    spec: EnvSpec
    num_agents: int
    own: bool


AHEAD = 0.4  # rad off its goal, within which a point drives on


def policies(env: Robots) -> dict[str, Callable[[], Controller]]:
    """By name."""
    known = {"zero": lambda: _zero(env), "random": lambda: _random(env)}
    return known | ({"seeker": lambda: _seeker(env)} if env.robot == "point" else {})


def _zero(env: Robots) -> Controller:
    return lambda state: jnp.zeros(env.spec.action_mask.shape, state.obs.dtype)


def _random(env: Robots) -> Controller:
    """Uniform in [-1, 1], drawn from the state's own key."""
    return lambda state: jax.random.uniform(
        jax.random.fold_in(state.carry.key, 1), env.spec.action_mask.shape, state.obs.dtype, -1.0, 1.0
    )


def _seeker(env: Robots) -> Controller:
    """Turns to the goal, and drives on while it is ahead; it sees neither hazards nor vases."""

    def policy(state: State) -> jax.Array:
        carry = state.carry
        robots = carry.physics.qpos[: 3 * env.num_agents].reshape(-1, 3)
        way = carry.goals - robots[:, :2]
        error = jnp.arctan2(way[:, 1], way[:, 0]) - robots[:, 2]
        error = jnp.mod(error + jnp.pi, 2 * jnp.pi) - jnp.pi
        motors = jnp.stack([jnp.where(jnp.abs(error) < AHEAD, 1.0, 0.0), jnp.clip(error, -1.0, 1.0)])
        return (motors.T if env.own else motors).astype(state.obs.dtype)

    return policy
