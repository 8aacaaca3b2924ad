"""The robots as data, and the MuJoCo model of any number of them with vases."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import mujoco

MOST_ROBOTS = 8
VASE = 0.1  # m, half the side of a vase
VASE_MASS = 8e-6  # kg
_FLOOR, _VASE, _ROBOT = 1, 2, 4  # bits of contype and conaffinity; robot i's is _ROBOT << i

VASE_COLOUR = (0.2, 0.75, 0.8)
COLOURS = ((0.86, 0.16, 0.12), (0.13, 0.36, 0.85), (0.95, 0.6, 0.1), (0.5, 0.2, 0.7))  # of robots and their goals
COLOURS += ((0.1, 0.6, 0.6), (0.9, 0.4, 0.7), (0.45, 0.3, 0.15), (0.2, 0.2, 0.25))


@dataclasses.dataclass(frozen=True)
class Robot:
    """What tells the robots apart.

    Attributes:
      timestep: s; rk4: the integrator is RK4, else Euler; a control step is 10 of them.
      nq, nv: entries of qpos and qvel of one robot.
      motors: names of its actuators, in the model's order.
      on_floor: it collides with the floor.
      reach: m from its origin, within which it may touch a vase in a step: its own size, a vase's, and a step's way.
      site: m, height of the sensors above the robot's origin, in its own frame.
      least_height: m, an episode ends where a robot's origin is not above; None if nothing ends it.
    """

    timestep: float
    rk4: bool
    nq: int
    nv: int
    motors: tuple[str, ...]
    on_floor: bool
    reach: float
    site: float
    least_height: float | None


ROBOTS = {
    "point": Robot(
        timestep=0.002,
        rk4=False,
        nq=3,
        nv=3,
        motors=("thrust", "turn"),
        on_floor=False,  # the ball touches it at a distance of exactly 0, which MuJoCo drops; 1e-7 deeper, it sticks
        reach=0.36,
        site=0.0,
        least_height=None,
    ),
    "ant": Robot(
        timestep=0.01,
        rk4=True,
        nq=15,
        nv=14,
        motors=tuple(f"{joint}{leg}" for leg in range(1, 5) for joint in ("hip", "ankle")),
        on_floor=True,
        reach=0.55,
        site=-0.02,
        least_height=0.08,
    ),
}
SUBSTEPS = 10


@functools.cache
def model(robot: str, robots: int, vases: int, size: float) -> mujoco.MjModel:
    """The compiled model: robots, then vases, whose joints have that order; engines copy it.

    Args:
      robot: one of `ROBOTS`; robots, vases: how many; size: m, half the side of the square that the camera shows.
    """
    kind = ROBOTS[robot]
    folder = Path(__file__).parent
    arena = mujoco.MjSpec.from_file(str(folder / "arena.xml"))
    arena.option.timestep = kind.timestep
    integrator = mujoco.mjtIntegrator
    arena.option.integrator = integrator.mjINT_RK4 if kind.rk4 else integrator.mjINT_EULER
    others = (1 << robots) - 1
    for i in range(robots):
        child = mujoco.MjSpec.from_file(str(folder / f"{robot}.xml"))
        for geom in child.geoms:
            geom.contype = _ROBOT << i
            geom.conaffinity = _VASE | (_FLOOR if kind.on_floor else 0) | _ROBOT * (others & ~(1 << i))
            geom.rgba = [*COLOURS[i], 1.0]
        arena.attach(child, prefix=f"{i}/", frame=arena.worldbody.add_frame())
    for v in range(vases):
        _add_vase(arena, v)
    arena.worldbody.add_camera(name="above", pos=[0, 0, 2.5 * size], quat=[1, 0, 0, 0], fovy=48)
    return arena.compile()


def _add_vase(arena: mujoco.MjSpec, number: int) -> None:
    body = arena.worldbody.add_body(name=f"vase{number}", pos=[0, 0, VASE])
    body.add_freejoint()
    body.add_geom(
        name=f"vase{number}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[VASE] * 3,
        mass=VASE_MASS,
        condim=6,
        contype=_VASE,
        conaffinity=_FLOOR | _VASE,
        rgba=[*VASE_COLOUR, 1.0],
    )
