"""What a robot senses: its own motion, and lidars of things around it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ..blocks import Block, Blocks
from .kinematics import Pose, pose

GRAVITY = 9.81  # m/s2
MAGNETIC = np.array([0.0, -0.5, 0.0], np.float32)  # the world's field, without unit

_SITE = "frame of the sensor"
_MOTION = (
    Block("accelerometer", 3, "m/s2", f"{_SITE}, gravity included"),
    Block("velocimeter", 3, "m/s", _SITE),
    Block("gyro", 3, "rad/s", _SITE),
    Block("magnetometer", 3, "-", f"the world's (0, -0.5, 0) in the {_SITE}"),
)
_HINGES = ", ".join(f"{joint}{leg}" for leg in range(1, 5) for joint in ("hip", "ankle"))
SENSORS: dict[str, Blocks] = {
    "point": _MOTION,
    "ant": (
        *_MOTION,
        Block("joint speeds", 8, "rad/s", _HINGES),
        Block("height", 1, "m", "of the sensor"),
        Block("angular velocity", 3, "rad/s", "of the torso, world frame"),
        Block("joint angles", 16, "-", "sine and cosine of each joint, in the same order"),
    ),
}


def sensors(robot: str, site: float, qpos: jax.Array, qvel: jax.Array, qacc: jax.Array) -> jax.Array:
    """The entries of `SENSORS` for one robot, from its own entries of qpos, qvel and qacc at the same moment.

    Args:
      site: m, height of the sensor above the robot's origin.
    """
    body = pose(robot, qpos)
    if robot == "point":
        zero = jnp.zeros_like(qpos[0])
        acceleration = jnp.stack([qacc[0], qacc[1], zero + GRAVITY])
        velocity, spin = jnp.stack([qvel[0], qvel[1], zero]), jnp.stack([zero, zero, qvel[2]])
        turned = body.rotation.T
        return jnp.concatenate([turned @ acceleration, turned @ velocity, spin, turned @ MAGNETIC])
    arm = jnp.stack([jnp.zeros_like(qpos[0]), jnp.zeros_like(qpos[0]), jnp.full_like(qpos[0], site)])
    spin, spin_rate = qvel[3:6], qacc[3:6]  # in the torso's frame
    turned = body.rotation.T
    up = jnp.array([0.0, 0.0, GRAVITY], qpos.dtype)
    acceleration = turned @ (qacc[:3] + up) + jnp.cross(spin_rate, arm) + jnp.cross(spin, jnp.cross(spin, arm))
    velocity = turned @ qvel[:3] + jnp.cross(spin, arm)
    height = qpos[2] + (body.rotation @ arm)[2]
    angles = jnp.stack([jnp.sin(qpos[7:]), jnp.cos(qpos[7:])], axis=1).ravel()
    return jnp.concatenate(
        [acceleration, velocity, spin, turned @ MAGNETIC, qvel[6:], height[None], body.rotation @ spin, angles]
    )


def lidar(points: jax.Array, body: Pose, bins: int, reach: float) -> jax.Array:
    """[bins] how near the nearest of `points` [P, 2] is in each direction: 1 where the body is, 0 from `reach` m on.

    A point shows in its own bin and, by where it lies within it, in the two next to it. The bins lie in the plane of
    the body, so a tilted body sees other directions and distances.
    """
    places = jnp.concatenate([points, jnp.zeros_like(points[:, :1])], axis=1)
    seen = ((places - body.place) @ body.rotation)[:, :2]
    near = jnp.maximum(0.0, reach - jnp.sqrt(jnp.sum(seen**2, axis=1))) / reach
    angle = jnp.mod(jnp.arctan2(seen[:, 1], seen[:, 0]), 2 * jnp.pi) / (2 * jnp.pi / bins)
    own = jnp.floor(angle)
    within = angle - own
    offset = jnp.mod(jnp.arange(bins) - own[:, None].astype(jnp.int32), bins)  # in single precision `own` may be `bins`
    shares = jnp.where(offset == 0, 1.0, jnp.where(offset == 1, within[:, None], 0.0))
    shares = jnp.where(offset == bins - 1, 1.0 - within[:, None], shares)
    return jnp.max(shares * near[:, None], axis=0, initial=0.0)
