"""Where a robot's parts are, from its own qpos: poses, and the geoms that touch things."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Pose(NamedTuple):
    """`place` [..., 3] m and `rotation` [..., 3, 3], whose columns are the body's axes in the world."""

    place: jax.Array
    rotation: jax.Array


POINT_HEIGHT = 0.1  # m, of the origin of a point, which qpos does not hold

_SIGNS = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], np.float32)  # directions of legs 1 to 4
_ANKLES = np.array([[-1, 1, 0], [1, 1, 0], [-1, 1, 0], [1, 1, 0]], np.float32) / np.sqrt(np.float32(2))  # axes


def matrix(quat: jax.Array) -> jax.Array:
    """[3, 3] of a unit quaternion [4], w first."""
    w, x, y, z = quat
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def about(axis: jax.Array | np.ndarray, angle: jax.Array) -> jax.Array:
    """[3, 3] rotation by `angle` [] rad about a unit `axis` [3] (Rodrigues)."""
    x, y, z = axis
    cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], angle.dtype)
    return jnp.eye(3, dtype=angle.dtype) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * (cross @ cross)


def pose(robot: str, qpos: jax.Array) -> Pose:
    """Of a robot's origin, from its own entries of qpos: [3] of a point, [15] of an ant, [7] of a vase."""
    if robot == "point":
        place = jnp.stack([qpos[0], qpos[1], jnp.full_like(qpos[0], POINT_HEIGHT)])
        return Pose(place, about(np.array([0.0, 0.0, 1.0]), qpos[2]))
    return Pose(qpos[:3], matrix(qpos[3:7]))


def legs(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of an ant: starts and ends [4, 3, 3] m (leg; aux, thigh, foot) of the axes of its capsules."""
    torso = pose("ant", qpos)
    hips, ankles = qpos[7::2], qpos[8::2]

    def leg(sign: jax.Array, axis: jax.Array, hip: jax.Array, ankle: jax.Array) -> tuple[jax.Array, jax.Array]:
        part = 0.05 * sign
        thigh = torso.rotation @ about(np.array([0.0, 0.0, 1.0]), hip)
        foot = thigh @ about(axis, ankle)
        first = torso.place + torso.rotation @ part
        second = first + thigh @ part
        third = second + foot @ (2 * part)
        return jnp.stack([torso.place, first, second]), jnp.stack([first, second, third])

    signs, axes = jnp.asarray(_SIGNS, qpos.dtype), jnp.asarray(_ANKLES, qpos.dtype)
    return jax.vmap(leg)(signs, axes, hips, ankles)
