"""What a picture shows besides robots and vases: goals, hazards, who pays, and the robots' lidars."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import mujoco
import numpy as np

from .models import COLOURS, VASE_COLOUR

GOAL_RADIUS, HAZARD_RADIUS, FLAT = 0.3, 0.2, 0.004  # m
HAZARD_COLOUR = (0.35, 0.3, 0.75, 0.45)
PAYING = (0.86, 0.16, 0.12, 0.5)
RING, NEXT, DOT = 0.26, 0.05, 0.02  # m: how far from the robot the first lidar's marks float, the next ones, their size


def decorate(scene: mujoco.MjvScene, raw: dict[str, np.ndarray]) -> None:
    """Appends discs for goals (in their robot's colour) and hazards, a disc below robots that pay, and lidars' marks.

    The lidars are rings about a robot, outwards of hazards, of its own goal and of vases; a mark is as solid as near.
    """
    disc = mujoco.mjtGeom.mjGEOM_CYLINDER
    for place, colour in zip(raw["goals"], COLOURS, strict=False):
        _add(scene, disc, (*place, FLAT), (GOAL_RADIUS, GOAL_RADIUS, FLAT), (*colour, 0.5))
    for place in raw["hazards"]:
        _add(scene, disc, (*place, FLAT), (HAZARD_RADIUS, HAZARD_RADIUS, FLAT), HAZARD_COLOUR)
    for i, (robot, paying) in enumerate(zip(raw["robots"], raw["paying"], strict=True)):
        if paying > 0:
            _add(scene, disc, (*robot[:2], 3 * FLAT), (0.2, 0.2, FLAT), PAYING)
        colours = {"hazard_lidar": HAZARD_COLOUR[:3], "goal_lidar": COLOURS[i], "vase_lidar": VASE_COLOUR}
        for ring, (lidar, colour) in enumerate(colours.items()):
            _ring(scene, robot, raw["headings"][i], raw[lidar][i], RING + NEXT * ring, colour)


def _ring(
    scene: mujoco.MjvScene,
    robot: np.ndarray,
    heading: float,
    seen: np.ndarray,
    radius: float,
    colour: tuple[float, ...],
) -> None:
    """Marks where a lidar [bins] shows anything."""
    angles = heading + (np.arange(len(seen)) + 0.5) * 2 * np.pi / len(seen)
    for angle, near in zip(angles, seen, strict=True):
        if near > 0:
            at = robot + radius * np.array([np.cos(angle), np.sin(angle), 0.5])
            _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, at, (DOT, 0.0, 0.0), (*colour, float(near)))


def _add(scene: mujoco.MjvScene, kind: int, place: object, size: tuple[float, ...], colour: tuple[float, ...]) -> None:
    if scene.ngeom >= scene.maxgeom:
        return
    geom = scene.geoms[scene.ngeom]
    pose = np.asarray(place, float), np.eye(3).ravel()
    mujoco.mjv_initGeom(geom, kind, np.array(size, float), *pose, np.array(colour, np.float32))
    scene.ngeom += 1
