"""A model's tables as C++ constants, in the rows of rows.h."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from .model import FIELDS, Body, Joint, Motor, Pair, Place, Point, Tables


def header(tables: Tables) -> str:
    """The text that the step's sources include for a model."""
    t = tables
    chains = [body.chain for body in t.bodies]
    columns = max(1, *map(len, [*chains, *(pair.dofs for pair in t.pairs)]))
    lines = ["// Written by header.py.", '#include "rows.h"', *_sizes(t), *_numbers(t)]
    lines += [f"constexpr int MOST_COLUMNS = {columns};"]
    lines += [
        _table("BodyRow", "BODIES", [_body(t, k) for k in range(len(t.bodies))]),
        _table("JointRow", "JOINTS", map(_joint, t.joints)),
        _table("PlaceRow", "PLACES", map(_place, t.places)),
        _table("BoxRow", "BOXES", ((b.body, b.centre, b.axes, b.size) for b in t.boxes)),
        _table("PointRow", "POINTS", map(_point, t.points)),
        _table(
            "SegmentRow",
            "SEGMENTS",
            ((s.body, s.place, s.half.any(), s.centre, s.half, s.side, s.radius) for s in t.segments),
        ),
        _table("BlockRow", "BLOCKS", (_block(t, k) for k in range(len(t.blocks)))),
        _table("PairRow", "PAIRS", (_pair(t, pair) for pair in t.pairs)),
        _table("LimitRow", "LIMITS", t.limits),
        _table("MotorRow", "MOTORS", map(_motor, t.motors)),
        _table("ReadingRow", "READINGS", _readings(t)),
        _ragged("int", "CHAINS", chains, columns),
        _ragged("int", "ANCESTORS", t.ancestors, max(1, *map(len, t.ancestors))),
        _ragged("int", "PAIR_DOFS", [pair.dofs for pair in t.pairs], columns),
        _ragged("Real", "PAIR_SIGNS", [pair.signs for pair in t.pairs], columns),
    ]
    for name in ("armature", "damping", "stiffness", "spring"):
        lines.append(f"constexpr Real {name.upper()}[] = {_value(getattr(t, name))};")
    lines.append(f"constexpr int QPOS_OF_DOF[] = {_value(t.qpos_of_dof)};")
    return "\n".join(lines) + "\n"


def _sizes(t: Tables) -> list[str]:
    sizes = {
        "NQ": t.nq,
        "NV": t.nv,
        "NU": t.nu,
        "NBODIES": len(t.bodies),
        "NJOINTS": len(t.joints),
        "NPLACES": t.nbody,
        "NBOXES": len(t.boxes),
        "NPOINTS": len(t.points),
        "NSEGMENTS": len(t.segments),
        "NBLOCKS": len(t.blocks),
        "NPAIRS": len(t.pairs),
        "NBLOCK_PAIRS": sum(pair.blocks == 1 for pair in t.pairs),
        "NBOX_PAIRS": sum(pair.blocks == 2 for pair in t.pairs),
        "ROOTED": t.rooted,
        "NLIMITS": len(t.limits),
        "NREADINGS": sum(len(reading.rows) for reading in t.readings.values()),
        "WIDTH": t.width,
        "FORWARD": t.forward,
        "RUNGE_KUTTA": t.rk4,
        "HAS_FREE": t.has_free,
        "DAMPED": (t.damping != 0).any(),
        "SPRINGS": (t.stiffness != 0).any(),
        "SHIFTS": any(joint.shift for joint in t.joints),
        "SERVOS": not all(motor.plain for motor in t.motors),
        "DIRECTIONS": t.directions,
        "FILLS": t.fills,
        "MOST_CONTACTS": t.most_contacts,
        "ITERATIONS": t.iterations,
        "LINE_SEARCH": t.line_search,
    }
    return [f"constexpr int {name} = {int(value)};" for name, value in sizes.items()]


def _numbers(t: Tables) -> list[str]:
    numbers = {
        "TIMESTEP": t.timestep,
        "GRAVITY": t.gravity,
        "IMPROVEMENT_SCALE": t.improvement_scale,
        "DENSITY": t.density,
        "VISCOSITY": t.viscosity,
    }
    return [f"constexpr Real {name} = {_value(value)};" for name, value in numbers.items()]


def _body(t: Tables, k: int) -> tuple[Any, ...]:
    body: Body = t.bodies[k]
    own = [j for j, joint in enumerate(t.joints) if joint.body == k]
    first, last = (own[0], own[-1] + 1) if own else (0, 0)
    inertia = symmetric(body.inertia)
    return (body.parent, first, last, body.mass, body.com, inertia, *_axial(body.inertia), body.subtree_mass)


def _axial(inertia: np.ndarray) -> tuple[bool, float, float, np.ndarray]:
    """Whether an inertia is across E + along axis axis', and these three."""
    values, axes = np.linalg.eigh(inertia)
    for other, axis in ((0, 2), (2, 0)):
        if inertia.any() and abs(values[1] - values[other]) < 1e-9 * values[2]:
            return True, float(values[1]), float(values[axis] - values[1]), axes[:, axis]
    return False, 0.0, 0.0, np.zeros(3)


def symmetric(matrix: np.ndarray) -> np.ndarray:
    """[6]: xx yy zz xy xz yz of [3, 3]."""
    return matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _joint(joint: Joint) -> tuple[Any, ...]:
    kind = 3 if joint.free else 1 if joint.hinge else 2 if joint.shift else 0
    turns = not np.array_equal(joint.rotation, np.eye(3))
    addresses = (kind, joint.body, joint.qpos, joint.dof, turns, joint.position.any())
    return (*addresses, joint.reference, joint.axis, joint.anchor, joint.position, joint.rotation, joint.quat)


def _point(point: Point) -> tuple[Any, ...]:
    capsule = point.axis.any() and not point.corner
    at = (point.body, point.place, capsule, point.corner, point.centre, point.axis)
    return (*at, point.radius, point.height, point.contact)


def _motor(motor: Motor) -> tuple[Any, ...]:
    at = (motor.dof, motor.qpos, motor.body, motor.place, motor.push, motor.turn)
    return (*at, motor.gear, motor.gain, motor.low, motor.high, motor.bias, motor.weakest, motor.strongest)


def _place(place: Place) -> tuple[Any, ...]:
    where = (place.position, place.rotation, place.quat)
    return (place.body, place.root, place.moves, *where, place.mass, place.com, symmetric(place.inertia))


def _pair(t: Tables, pair: Pair) -> tuple[Any, ...]:
    return (pair.first, pair.second, len(pair.dofs), pair.rooted, t.reach(pair), pair.contact)


def _block(t: Tables, k: int) -> tuple[Any, ...]:
    block = t.blocks[k]
    own = [c for c, pair in enumerate(t.pairs) if pair.blocks == 1 and pair.first == k]
    reach = block.reach if np.isfinite(block.reach) else 0.0
    first, last = (own[0], own[-1] + 1) if own else (0, 0)
    return (block.body, block.place, first, last, block.axes, block.offset, block.size, reach)


def _readings(t: Tables) -> Iterable[tuple[int, int]]:
    fields = list(FIELDS)
    return [(fields.index(reading.field), row) for reading in t.readings.values() for row in reading.rows]


def _table(kind: str, name: str, rows: Iterable[Any]) -> str:
    """An array of rows; of one row of zeros if there is none, as C++ has no empty arrays."""
    return f"constexpr {kind} {name}[] = {{{', '.join(map(_value, rows)) or '{}'}}};"


def _ragged(kind: str, name: str, rows: Iterable[Iterable[float]], width: int) -> str:
    """Rows of different lengths, filled up with zeros, and these lengths."""
    rows = [list(row) for row in rows] or [[]]
    cast = float if kind == "Real" else int
    padded = [[cast(x) for x in row] + [cast(0)] * (width - len(row)) for row in rows]
    counts = f"constexpr int N{name}[] = {_value([len(row) for row in rows])};"
    return f"{counts}\nconstexpr {kind} {name}[][{width}] = {_value(padded)};"


def _value(value: Any) -> str:
    """A C++ constant: numbers as they are to the last bit, sequences and rows in braces."""
    if isinstance(value, np.ndarray):
        value = value.reshape(-1).tolist()
    if isinstance(value, (list, tuple)):
        return "{" + ", ".join(map(_value, value)) + "}"
    if isinstance(value, (bool, np.bool_, int, np.integer)):
        return str(int(value))
    number = float(value)
    if np.isinf(number):
        return "Real(INFINITY)" if number > 0 else "-Real(INFINITY)"
    return f"Real({number!r})"
