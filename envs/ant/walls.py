"""Where the corridor runs, and its walls as geoms: drawn only, costly to be behind, or solid."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import cmath
import functools
import itertools
import math
from pathlib import Path
from typing import Any

import mujoco

MODEL = Path(__file__).parent / "ant_corridor.xml"
WALLS = ("reference", "costly", "solid")
TORSO_AND_FEET = ("torso_geom", *(f"foot_{leg}_geom" for leg in range(1, 5)))

SLOPE = math.tan(math.radians(30.0))  # of the corridor's centre line, up or down
SLOPES = (SLOPE, -SLOPE, SLOPE, 0.0)  # of its segments
FOLDS = (20.0, 60.0, 100.0)  # m along x, where one segment ends and the next begins
HALF_WIDTH = 5.0  # m along y from the centre line to a wall
DANGER = 1.8  # m along y to either side of a wall

REACH = 600.0  # m along x from the start, either way: further than an ant runs in an episode
THICKNESS, HEIGHT = 1.0, 1.4  # m, of a solid wall; thick enough that no step ends behind it
COSTLY_REACH = 20.0  # m, how far the floor behind a costly wall is drawn as costly
_TOUCHING = 2  # the bit of `contype` and `conaffinity` for contacts with solid walls
_MOST_CONTACTS = 32  # of an ant with solid walls; MJX has no broad phase and would solve for all 97
_PIECES = tuple(itertools.product((1, -1), range(len(SLOPES))))  # side (1 is left), segment


@functools.cache
def model(walls: str = "reference") -> mujoco.MjModel:
    """The compiled MJCF with walls of one of `WALLS`; engines copy it."""
    if walls == "reference":
        return mujoco.MjModel.from_xml_path(str(MODEL))
    spec = mujoco.MjSpec.from_file(str(MODEL))
    (_make_solid if walls == "solid" else _widen_bands)(spec)
    changed = spec.compile()
    changed.stat.extent = model().stat.extent  # scales how near and far a camera sees
    return changed


def _make_solid(spec: mujoco.MjSpec) -> None:
    """Boxes behind the walls' lines, without gaps, in place of the walls that are drawn.

    They touch torso and feet only: a leg is in the convex hull of both, so a flat wall that stops these stops it. As
    bodies of their own they cost less time than as geoms of one, because each gets a bounding box along its wall.
    """
    _remove(spec, "wall")
    spec.add_numeric(name="max_contact_points", size=1, data=[_MOST_CONTACTS])
    for name in TORSO_AND_FEET:
        spec.geom(name).contype |= _TOUCHING
    for side, segment in _PIECES:
        pos, quat, size = _strip(side, segment, 0.0, THICKNESS)
        body = spec.worldbody.add_body(pos=[*pos, HEIGHT / 2], quat=quat)
        body.add_geom(
            spec.find_default("wall"),
            name=_name("wall", side, segment),
            size=[*size, HEIGHT / 2],
            conaffinity=_TOUCHING,
        )


def _widen_bands(spec: mujoco.MjSpec) -> None:
    """Danger bands that continue behind the walls."""
    _remove(spec, "danger")
    for side, segment in _PIECES:
        inside = DANGER * math.cos(math.atan(SLOPES[segment]))  # across the wall
        pos, quat, size = _strip(side, segment, inside, COSTLY_REACH)
        spec.worldbody.add_geom(
            spec.find_default("danger"),
            name=_name("danger", side, segment),
            pos=[*pos, 0.001],
            quat=quat,
            size=[*size, 0.001],
        )


def _name(kind: str, side: int, segment: int) -> str:
    return f"{kind}_{'left' if side > 0 else 'right'}_{segment + 1}"


def _remove(spec: mujoco.MjSpec, kind: str) -> None:
    for geom in list(spec.geoms):
        if geom.name.startswith(kind):
            spec.delete(geom)


def _strip(side: int, segment: int, inside: float, outside: float) -> tuple[Any, Any, Any]:
    """Middle [2], quaternion [4] and half sizes [2] of a strip along a wall, `inside` to `outside` m across its line.

    On the outer side of a fold it is longer than the line, so that strips of neighbours leave no wedge between them.
    """
    start, end = _corner(side, segment), _corner(side, segment + 1)
    along = (end - start) / abs(end - start)
    start -= along * outside * _opening(side, segment)
    end += along * outside * _opening(side, segment + 1)
    middle = (start + end) / 2 + side * 1j * along * (outside - inside) / 2
    half_yaw = cmath.phase(along) / 2
    quat = [math.cos(half_yaw), 0, 0, math.sin(half_yaw)]
    return [middle.real, middle.imag], quat, [abs(end - start) / 2, (inside + outside) / 2]


def _corner(side: int, number: int) -> complex:
    """x + iy (m) of a wall's fold; its ends count as folds."""
    x, y = -REACH, -REACH * SLOPE
    for place, slope in zip((*FOLDS, REACH)[:number], SLOPES, strict=False):
        x, y = place, y + (place - x) * slope
    return complex(x, y + side * HALF_WIDTH)


def _opening(side: int, number: int) -> float:
    """Tangent of half the turn at a wall's fold where it turns away from this side, else 0."""
    if number in (0, len(SLOPES)):
        return 0.0
    before, after = (math.atan(slope) for slope in SLOPES[number - 1 : number + 1])
    return max(0.0, math.tan(side * (before - after) / 2))
