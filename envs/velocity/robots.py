"""The robots of the velocity tasks: data, but for the rules of health.

The models are Gymnasium's (LICENSE next to them); every file says what was changed so that MuJoCo 3.17 computes what
the reference's MuJoCo 2.3.3 does.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import jax
import mujoco

Healthy = Callable[[jax.Array, jax.Array], jax.Array]  # qpos, qvel (NumPy's too) -> [] bool; a nan is not healthy


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot with its reward, its rule of health and its start.

    Attributes:
      substeps: integration steps in a control step.
      place: what the velocity is a difference of: the torso's `xpos`, the centre of mass, or the first of `qpos`.
      axes: entries of the place that are kept, x and perhaps y.
      speed: what costs: the norm of the velocity, the size of its x, or its x with the sign.
      forward, survival, control: weights of x velocity (1 / (m/s)), of a step, and of the sum of squared actions.
      healthy: False ends the episode; None if nothing does.
      noise: half-width of the uniform noise on qpos (quaternion included) and on qvel at the start.
      normal_velocity: the noise on qvel is normal with this standard deviation instead.
      unseen: first entries of qpos that the state leaves out.
      velocity_bound: qvel is clipped to it in the state.
      sees_forces: the state continues with inertias, velocities and forces of all bodies.
    """

    substeps: int
    place: Literal["torso_xpos", "com", "qpos"]
    axes: int
    speed: Literal["norm", "size", "signed"]
    control: float
    noise: float
    forward: float = 1.0
    survival: float = 0.0
    healthy: Healthy | None = None
    normal_velocity: bool = False
    unseen: int = 1
    velocity_bound: float = math.inf
    sees_forces: bool = False


def _ant_is_healthy(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    finite = (abs(qpos) < math.inf).all() & (abs(qvel) < math.inf).all()
    return finite & (qpos[2] >= 0.2) & (qpos[2] <= 1.0)


def _hopper_is_healthy(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    bounded = (abs(qpos[2:]) < 100.0).all() & (abs(qvel) < 100.0).all()
    return bounded & (qpos[1] > 0.7) & (abs(qpos[2]) < 0.2)


def _walker_is_healthy(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    return (qpos[1] > 0.8) & (qpos[1] < 2.0) & (abs(qpos[2]) < 1.0)


def _humanoid_is_healthy(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    return (qpos[2] > 1.0) & (qpos[2] < 2.0)


_HOPPER = Robot(
    substeps=4,
    place="qpos",
    axes=1,
    speed="size",
    control=1e-3,
    noise=5e-3,
    survival=1.0,
    healthy=_hopper_is_healthy,
    velocity_bound=10.0,
)
ROBOTS = {
    "ant": Robot(
        substeps=5,
        place="torso_xpos",
        axes=2,
        speed="norm",
        control=0.5,
        noise=0.1,
        survival=1.0,
        healthy=_ant_is_healthy,
        normal_velocity=True,
        unseen=2,
    ),
    "half_cheetah": Robot(substeps=5, place="qpos", axes=1, speed="size", control=0.1, noise=0.1, normal_velocity=True),
    "hopper": _HOPPER,
    "walker2d": dataclasses.replace(_HOPPER, healthy=_walker_is_healthy),
    "swimmer": Robot(substeps=4, place="qpos", axes=2, speed="signed", control=1e-4, noise=0.1, unseen=2),
    "humanoid": Robot(
        substeps=5,
        place="com",
        axes=2,
        speed="norm",
        control=0.1,
        noise=0.01,
        forward=1.25,
        survival=5.0,
        healthy=_humanoid_is_healthy,
        unseen=2,
        sees_forces=True,
    ),
}


@functools.cache
def model(robot: str) -> mujoco.MjModel:
    """The compiled MJCF; engines copy it."""
    return mujoco.MjModel.from_xml_path(str(Path(__file__).parent / f"{robot}.xml"))
