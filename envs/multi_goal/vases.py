"""The vases that a step simulates: as many as there are slots, those that move and those nearest to a robot."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from ..physics import PhysicsState

MOVING = 1e-5  # m/s or rad/s, of any entry of a vase's velocity


@dataclasses.dataclass(frozen=True)
class Vases:
    """Where vases are in the state, which holds all of them.

    Attributes:
      nq, nv: entries of all robots, which come first.
      count: V; slots: K, of the model that is stepped.
      reach: m to a robot, within which it may touch a vase in a step.
    """

    nq: int
    nv: int
    count: int
    slots: int
    reach: float

    def qpos(self, physics: PhysicsState) -> jax.Array:
        """[V, 7]."""
        return physics.qpos[self.nq :].reshape(self.count, 7)

    def qvel(self, physics: PhysicsState) -> jax.Array:
        """[V, 6]."""
        return physics.qvel[self.nv :].reshape(self.count, 6)

    def choose(self, physics: PhysicsState, robots: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The vases [K] to simulate, next to robots at [N, 2] m, and how many [] more would move or be touched."""
        place = self.qpos(physics)[:, :2]
        nearest = jnp.sqrt(jnp.sum((place[:, None] - robots) ** 2, axis=2)).min(1)
        moving = (jnp.abs(self.qvel(physics)) > MOVING).any(1)
        _, chosen = jax.lax.top_k(jnp.where(moving, jnp.inf, -nearest), self.slots)
        active = (moving | (nearest < self.reach)).sum()
        return jnp.sort(chosen), jnp.maximum(active - self.slots, 0).astype(nearest.dtype)

    def take(self, physics: PhysicsState, chosen: jax.Array) -> PhysicsState:
        """The state of the model with K vases."""
        return PhysicsState(
            jnp.concatenate([physics.qpos[: self.nq], self.qpos(physics)[chosen].ravel()]),
            *(self._entries(x, chosen) for x in (physics.qvel, physics.warmstart)),
        )

    def put(self, physics: PhysicsState, chosen: jax.Array, after: PhysicsState) -> PhysicsState:
        """The whole state after a step of the chosen ones: the others stay, at rest."""
        vases = self.qpos(physics).at[chosen].set(after.qpos[self.nq :].reshape(-1, 7))
        qvel, warmstart = (
            jnp.concatenate(
                [x[: self.nv], jnp.zeros((self.count, 6), x.dtype).at[chosen].set(x[self.nv :].reshape(-1, 6)).ravel()]
            )
            for x in (after.qvel, after.warmstart)
        )
        return PhysicsState(jnp.concatenate([after.qpos[: self.nq], vases.ravel()]), qvel, warmstart)

    def _entries(self, x: jax.Array, chosen: jax.Array) -> jax.Array:
        return jnp.concatenate([x[: self.nv], x[self.nv :].reshape(self.count, 6)[chosen].ravel()])
