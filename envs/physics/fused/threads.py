"""The tables of a model as C++ for the schedule "one warp a world": threads.h, threads_step.h and threads_readouts.h.

The warp's lanes take the model's items (joints, bodies, dofs, entries of matrices, contacts), so what differs between
items is looked up by lane, and what is the same for all becomes a constant. The order in which M's factor is worked out
is decided here: the trunk (dofs 0 to T - 1, one path) by all lanes alike, the branches on it in rounds, each dof in the
round after the last of those that hang on it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from .model import FIELDS, Contact, Tables

LANES = 32
MOST_SLOTS = LANES  # contacts of a world at a time, each a lane's

_LONGEST_TRUNK = 9  # its triangle is in every lane's registers
_ROUND_COST = 60.0  # of a round of the branches, in a trunk's multiplications


class Schedule(NamedTuple):
    """The order of elimination.

    Attributes:
      trunk: T.
      rounds: the dofs of each.
      below: [nv] how many dofs hang on each; they are the next ones.
    """

    trunk: int
    rounds: tuple[tuple[int, ...], ...]
    below: tuple[int, ...]


def obstacle(tables: Tables) -> str | None:
    """Why a warp cannot step a world of the model, as the rest of a sentence; None if it can."""
    sizes = {
        "degrees of freedom": tables.nv,
        "joints": len(tables.joints),
        "moving bodies": len(tables.bodies),
        "joints with limits": len(tables.limits),
        "bodies in a fluid": len(tables.boxes),
    }
    wrong = [f"{size} {what}" for what, size in sizes.items() if size > LANES]
    return f"cannot step this model: it has {wrong[0]}, and a warp takes {LANES}" if wrong else None


def schedule(tables: Tables) -> Schedule:
    """The cheapest order of elimination."""
    below = tuple(sum(d in above for above in tables.ancestors) for d in range(tables.nv))
    for d, number in enumerate(below):
        assert all(d in tables.ancestors[k] for k in range(d + 1, d + 1 + number)), "dofs are not in depth-first order"
    longest = 0
    while longest < min(tables.nv, _LONGEST_TRUNK) and len(tables.ancestors[longest]) == longest:
        longest += 1
    choices = [Schedule(trunk, _rounds(tables, trunk), below) for trunk in range(longest + 1)]
    return min(choices, key=lambda s: len(s.rounds) * _ROUND_COST + s.trunk**3 / 6 + 1.5 * s.trunk**2)


def _rounds(tables: Tables, trunk: int) -> tuple[tuple[int, ...], ...]:
    height = [0] * tables.nv
    for d in reversed(range(tables.nv)):
        for above in tables.ancestors[d][:1]:
            height[above] = max(height[above], height[d] + 1)
    branches = range(trunk, tables.nv)
    return tuple(
        tuple(d for d in branches if height[d] == k) for k in range(max((height[d] for d in branches), default=-1) + 1)
    )


def source(tables: Tables) -> str:
    """The file MODEL that threads_step.h includes."""
    out = _Writer()
    _sizes(out, tables)
    _tree(out, tables)
    _entries(out, tables)
    _factor(out, tables, schedule(tables))
    _contacts(out, tables)
    _limits(out, tables)
    _readings(out, tables)
    return out.text()


class _Writer:
    """Lines of C++, a table a line."""

    def __init__(self) -> None:
        self._lines = ["// Tables of one model, written by threads.py.", "#pragma once"]

    def text(self) -> str:
        return "\n".join(self._lines) + "\n"

    def define(self, **values: int) -> None:
        self._lines += [f"#define {name} {int(value)}" for name, value in values.items()]

    def line(self, text: str) -> None:
        self._lines.append(text)

    def constant(self, **values: float) -> None:
        self._lines += [f"constexpr real {name} = {_number(value)};" for name, value in values.items()]

    def fixed(self, name: str, values: Sequence[int]) -> None:
        """Numbers that the compiler reads."""
        listed = ", ".join(str(int(v)) for v in values) or "0"
        self._lines.append(f"constexpr int {name}[] = {{{listed}}};")

    def scalars(self, name: str, values: Iterable[float], kind: str = "real") -> None:
        """A function of an item's index; a constant if all items agree."""
        values = list(values)
        shown = [_number(v) if kind == "real" else f"{int(v)}{'u' * (kind == 'unsigned')}" for v in values]
        if len(set(shown)) <= 1:
            self._lines.append(f"DEVICE {kind} {name}(int) {{ return {shown[0] if shown else 0}; }}")
            return
        self._lines.append(f"TABLE({kind}) {name.upper()}_[] = {{{', '.join(shown)}}};")
        self._lines.append(f"DEVICE {kind} {name}(int i) {{ return {name.upper()}_[i]; }}")

    def vectors(self, name: str, values: Iterable[np.ndarray]) -> None:
        rows = np.array(list(values), float).reshape(-1, 3)
        for k, part in enumerate("xyz"):
            self.scalars(f"{name}_{part}", rows[:, k])
        self._lines.append(f"DEVICE Vec {name}(int i) {{ return {{{name}_x(i), {name}_y(i), {name}_z(i)}}; }}")

    def matrices(self, name: str, values: Iterable[np.ndarray]) -> None:
        rows = np.array(list(values), float).reshape(-1, 3, 3)
        for k, part in enumerate("abc"):
            self.vectors(f"{name}_{part}", rows[:, k])
        self._lines.append(f"DEVICE Mat {name}(int i) {{ return {{{name}_a(i), {name}_b(i), {name}_c(i)}}; }}")

    def symmetric(self, name: str, values: Iterable[np.ndarray]) -> None:
        rows = np.array(list(values), float).reshape(-1, 3, 3)
        parts = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
        for part, (i, j) in parts.items():
            self.scalars(f"{name}_{part}", rows[:, i, j])
        listed = ", ".join(f"{name}_{part}(i)" for part in parts)
        self._lines.append(f"DEVICE Sym {name}(int i) {{ return {{{listed}}}; }}")

    def quats(self, name: str, values: Iterable[np.ndarray]) -> None:
        rows = np.array(list(values), float).reshape(-1, 4)
        self.scalars(f"{name}_w", rows[:, 0])
        self.vectors(f"{name}_v", rows[:, 1:])


def _number(value: float) -> str:
    """A literal; what is beyond floats becomes the largest that is not."""
    return f"real({float(np.clip(value, -3e38, 3e38))!r})"


def _sizes(out: _Writer, t: Tables) -> None:
    candidates = len(t.points) + len(_touches(t))
    own = candidates <= MOST_SLOTS and t.most_contacts >= candidates
    out.define(
        NQ=t.nq,
        NV=t.nv,
        NU=t.nu,
        SUBSTEPS=t.substeps,
        RK4=t.rk4,
        FREE=t.has_free,
        BODIES=len(t.bodies),
        JOINTS=len(t.joints),
        POINTS=len(t.points),
        PAIRS=len(_touches(t)),
        CANDIDATES=candidates,
        OWN_SLOTS=own,
        SLOTS=max(1, candidates if own else min(MOST_SLOTS, t.most_contacts)),
        LIMITS=len(t.limits),
        FLUID=bool(t.boxes),
        BOXES=len(t.boxes),
        FILLS=t.fills,
        DAMPED=t.damping.any(),
        SPRINGS=t.stiffness.any(),
        ITERATIONS=t.iterations,
    )
    out.constant(
        TIMESTEP=t.timestep,
        GRAVITY=t.gravity,
        DENSITY=t.density,
        VISCOSITY=t.viscosity,
        IMPROVEMENT_SCALE=t.improvement_scale,
    )


def _tree(out: _Writer, t: Tables) -> None:
    """Joints, bodies, dofs and motors."""
    out.line("enum { HINGE, SLIDE, SHIFT };")
    out.scalars("joint_kind", (0 if j.hinge else 2 if j.shift else 1 for j in t.joints), "int")
    for name in ("qpos", "dof", "body"):
        out.scalars(f"joint_{name}", (getattr(j, name) for j in t.joints), "int")
    out.scalars("joint_reference", (j.reference for j in t.joints))
    for name in ("axis", "anchor", "position"):
        out.vectors(f"joint_{name}", (getattr(j, name) for j in t.joints))
    out.matrices("joint_rotation", (j.rotation for j in t.joints))
    out.quats("joint_quat", (j.quat for j in t.joints))
    chains = [_chain(t, body) for body in range(len(t.bodies))]
    depth = max(map(len, chains))
    out.define(
        DEPTH=depth,
        ALL_HINGES=all(j.hinge for j in t.joints),
        TURNED_JOINTS=any((j.rotation != np.eye(3)).any() for j in t.joints),
        OFFSET_JOINTS=any(j.position.any() for j in t.joints),
    )
    out.scalars("chain_joint", (c[k] if k < len(c) else -1 for k in range(depth) for c in chains), "int")
    out.scalars("body_mass", (b.mass for b in t.bodies))
    out.scalars("body_subtree_mass", (b.subtree_mass for b in t.bodies))
    out.vectors("body_com", (b.com for b in t.bodies))
    out.symmetric("body_inertia", (b.inertia for b in t.bodies))
    _round_bodies(out, t)
    out.fixed("BODY_PARENT", [b.parent for b in t.bodies])
    parents = {b.parent for k, b in enumerate(t.bodies) if k}
    dragged = {box.body for box in t.boxes}
    out.fixed("BODY_CHANGES", [k in parents | dragged for k in range(len(t.bodies))])
    out.scalars("body_dofs", (_bits(b.chain) for b in t.bodies), "unsigned")
    owner = {j.dof: j.body for j in t.joints}
    out.scalars("dof_body", (owner.get(d, 0) for d in range(t.nv)), "int")
    for name in ("armature", "damping", "stiffness", "spring"):
        out.scalars(f"dof_{name}", getattr(t, name))
    out.scalars("dof_qpos", t.qpos_of_dof, "int")
    out.scalars("motor_dof", (m.dof for m in t.motors), "int")
    for name in ("gain", "low", "high"):
        out.scalars(f"motor_{name}", (getattr(m, name) for m in t.motors))
    if t.boxes:
        out.fixed("BOX_BODY", [b.body for b in t.boxes])
        out.scalars("box_body", (b.body for b in t.boxes), "int")
        out.vectors("box_centre", (b.centre for b in t.boxes))
        out.vectors("box_size", (b.size for b in t.boxes))
        out.matrices("box_axes", (b.axes for b in t.boxes))


def _round_bodies(out: _Writer, t: Tables) -> None:
    """Inertias that are e E + k u u', if all are: fewer products turn them."""
    across, along, axes = [], [], []
    for body in t.bodies:
        values, vectors = np.linalg.eigh(body.inertia)
        pair, single = ((0, 1), 2) if values[1] - values[0] < values[2] - values[1] else ((1, 2), 0)
        across.append(values[list(pair)].mean())
        along.append(values[single] - across[-1])
        axes.append(vectors[:, single])
        if np.ptp(values[list(pair)]) > 1e-9 * max(1e-12, values[2]):
            out.define(ROUND_BODIES=0)
            break
    else:
        out.define(ROUND_BODIES=1)
    out.scalars("body_across", across)
    out.scalars("body_along", along)
    out.vectors("body_round_axis", axes)


def _chain(t: Tables, body: int) -> list[int]:
    """Joints from the base to a body."""
    own = [k for k, joint in enumerate(t.joints) if joint.body == body]
    return [*_chain(t, t.bodies[body].parent), *own] if body else own


def _entries(out: _Writer, t: Tables) -> None:
    """Entries of M and H."""
    base = 6 if t.has_free else 0
    pairs = [(i, j) for i in range(base, t.nv) for j in (i, *t.ancestors[i]) if j >= base]
    out.define(PAIR_ENTRIES=len(pairs), OUTER_DOFS=((1 << t.nv) - 1) & ~((1 << base) - 1))
    out.scalars("pair_entry", (i | j << 8 for i, j in pairs), "unsigned")
    # The base's block: the first moment h crosswise, then the inertia; mass and zeros never change.
    block = [(3, 1, 2, 1), (3, 2, 1, 0), (4, 0, 2, 0), (4, 2, 0, 1), (5, 0, 1, 1), (5, 1, 0, 0)]
    block += [(3, 3, 3, 0), (4, 4, 4, 0), (5, 5, 5, 0), (4, 3, 6, 0), (5, 3, 7, 0), (5, 4, 8, 0)]
    block = block if t.has_free else []
    out.define(BASE_ENTRIES=len(block))
    out.scalars("base_entry", (i | j << 8 | k << 16 | minus << 24 for i, j, k, minus in block), "unsigned")
    entries = [(i, j) for i in range(t.nv) for j in (i, *t.ancestors[i])]
    out.define(ENTRIES=len(entries))
    out.scalars("hessian_entry", (i | j << 8 for i, j in entries), "unsigned")
    slots = [_slots(t, d) for d in range(t.nv)]
    out.scalars("dof_slots", slots, "unsigned")
    out.scalars("entry_slots", (slots[i] & slots[j] for i, j in entries), "unsigned")
    fills = [(i, j) for i in range(t.nv) for j in range(i) if j not in t.ancestors[i]]
    out.define(FILL_ENTRIES=len(fills))
    out.scalars("fill_entry", (i | j << 8 for i, j in fills), "unsigned")


def _slots(t: Tables, dof: int) -> int:
    """The contacts that a dof moves, where each candidate has a slot."""
    moved = [dof in t.bodies[p.body].chain for p in t.points] + [dof in t.pairs[k].dofs for k, _ in _touches(t)]
    return _bits(np.flatnonzero(moved)) if len(moved) <= MOST_SLOTS else 0


def _factor(out: _Writer, t: Tables, plan: Schedule) -> None:
    """The order of elimination; see `Schedule`."""
    trunk, right = plan.trunk, t.nv
    sizes, starts, entries = [], [], []
    for k, dofs in enumerate(plan.rounds):
        starts.append(len(entries))
        for i in dofs:
            columns = [*reversed(t.ancestors[i]), *([right] if k or not t.ancestors[i] else [])]
            entries += [i | j << 8 | (n == 0) << 16 for n, j in enumerate(columns)]
        sizes.append(len(entries) - starts[-1])
    below = [[plan.below[i] for i in dofs] for dofs in plan.rounds]
    out.define(TRUNK=trunk, ROUNDS=len(plan.rounds))
    out.fixed("ROUND_SIZE", sizes)
    out.fixed("ROUND_START", starts)
    out.fixed("ROUND_BELOW", [max(b) for b in below])
    out.fixed("ROUND_EVEN", [min(b) == max(b) for b in below])
    out.scalars("round_entry", entries, "unsigned")
    out.scalars("dof_below", plan.below, "int")
    triangle = [(i, j) for i in range(trunk) for j in range(i + 1)] + [(i, right) for i in range(trunk)]
    out.scalars("trunk_entry", (i | j << 8 for i, j in triangle), "unsigned")
    above = [[a for a in reversed(t.ancestors[i]) if a >= trunk] for i in range(t.nv)]
    levels = 1 + max((len(a) for a in above[trunk:]), default=0)
    out.define(BRANCH_LEVELS=levels)
    out.scalars(
        "dof_on_branch",
        (a[k] if k < len(a) and i >= trunk else i for k in range(levels - 1) for i, a in enumerate(above)),
        "int",
    )


def _touches(t: Tables) -> list[tuple[int, int]]:
    """Pairs of segments and which of their contacts; two capsules that are parallel have two."""
    both = [all(t.segments[s].half.any() for s in (p.first, p.second)) for p in t.pairs]
    return [(k, which) for k, two in enumerate(both) for which in range(1 + two)]


def _contacts(out: _Writer, t: Tables) -> None:
    """Candidates: points over the floor, then pairs."""
    touches = _touches(t)
    # What rounding leaves of 0 (MuJoCo's is 1e-15 in f64): sine squared of parallel axes, m between segments that cross.
    out.line("constexpr real PARALLEL = sizeof(real) == 4 ? real(1e-10) : real(0);")
    out.line("constexpr real CROSSING = sizeof(real) == 4 ? real(1e-6) : real(1e-15);")
    for name, kind in (("body", "int"), ("radius", "real"), ("height", "real")):
        out.scalars(f"point_{name}", (getattr(p, name) for p in t.points), kind)
    out.scalars("point_round", (not p.axis.any() for p in t.points), "bool")
    out.vectors("point_centre", (p.centre for p in t.points))
    out.vectors("point_axis", (p.axis for p in t.points))
    out.scalars("segment_body", (s.body for s in t.segments), "int")
    out.scalars("segment_radius", (s.radius for s in t.segments))
    out.scalars("segment_length", (np.linalg.norm(s.half) for s in t.segments))
    for name in ("centre", "half", "side"):
        out.vectors(f"segment_{name}", (getattr(s, name) for s in t.segments))
    out.scalars("pair_first", (t.pairs[k].first for k, _ in touches), "int")
    out.scalars("pair_second", (t.pairs[k].second for k, _ in touches), "int")
    out.scalars("pair_which", (which for _, which in touches), "int")
    pairs = [t.pairs[k] for k, _ in touches]
    contacts: list[Contact] = [p.contact for p in t.points] + [p.contact for p in pairs]
    for name in ("friction", "margin", "regularisation"):
        out.scalars(f"contact_{name}", (getattr(c, name) for c in contacts))
    for name in ("stiffness", "damping", "lowest", "highest", "inverse_width"):
        out.scalars(f"contact_{name}", (getattr(c.impedance, name) for c in contacts))
    dofs = [_bits(t.bodies[p.body].chain) for p in t.points] + [_bits(p.dofs) for p in pairs]
    out.scalars("contact_dofs", dofs, "unsigned")
    minus = [_bits(d for d, sign in zip(p.dofs, p.signs, strict=True) if sign < 0) for p in pairs]
    out.scalars("contact_opposite", [0] * len(t.points) + minus, "unsigned")
    related = [{d, *t.ancestors[d]} for d in range(t.nv)]
    fills = [any(a not in related[b] and b not in related[a] for a in p.dofs for b in p.dofs) for p in pairs]
    out.scalars("contact_fills", [False] * len(t.points) + fills, "bool")
    first = [-1] * len(t.points) + [t.segments[p.first].place for p in pairs]
    second = [p.place for p in t.points] + [t.segments[p.second].place for p in pairs]
    out.scalars("contact_first_place", first, "int")
    out.scalars("contact_second_place", second, "int")


def _limits(out: _Writer, t: Tables) -> None:
    out.scalars("limit_qpos", (x.qpos for x in t.limits), "int")
    out.scalars("limit_dof", (x.dof for x in t.limits), "int")
    for name in ("low", "high", "margin", "inverse_weight"):
        out.scalars(f"limit_{name}", (getattr(x, name) for x in t.limits))
    for name in ("stiffness", "damping", "lowest", "highest", "inverse_width"):
        out.scalars(f"limit_{name}", (getattr(x.impedance, name) for x in t.limits))


def _readings(out: _Writer, t: Tables) -> None:
    """Places of the MjModel's bodies, and which rows of which fields are read."""
    names = [field.upper() for field in FIELDS]
    out.line(f"enum {{ {', '.join(names)} }};")
    readings = list(t.readings.values())
    rows = [row for reading in readings for row in reading.rows]
    out.define(READINGS=len(readings), READS_FORCES=any(r.field == "cfrc_ext" for r in readings))
    out.fixed("READING_FIELD", [list(FIELDS).index(r.field) for r in readings])
    out.fixed("READING_WIDTH", [FIELDS[r.field] for r in readings])
    out.fixed("READING_COUNT", [len(r.rows) for r in readings])
    out.fixed("READING_START", np.cumsum([0, *(len(r.rows) for r in readings)])[:-1].tolist())
    out.scalars("reading_row", rows, "int")
    out.scalars("place_body", (p.body for p in t.places), "int")
    out.scalars("place_root", (p.root for p in t.places), "int")
    out.scalars("place_mass", (p.mass for p in t.places))
    for name in ("position", "com"):
        out.vectors(f"place_{name}", (getattr(p, name) for p in t.places))
    out.symmetric("place_inertia", (p.inertia for p in t.places))
    out.matrices("place_rotation", (p.rotation for p in t.places))
    out.quats("place_quat", (p.quat for p in t.places))
    sizes = [len(r.rows) * FIELDS[r.field] for r in readings]
    out.line(f"#define READING_PARAMETERS {''.join(f', float* reading_{k}' for k in range(len(readings)))}")
    listed = ", ".join(f"reading_{k} + world * {size}" for k, size in enumerate(sizes))
    out.line(f"#define READING_ADDRESSES {listed}")


def _bits(numbers: Iterable[int]) -> int:
    return sum(1 << int(n) for n in numbers)
