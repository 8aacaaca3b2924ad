"""The tables of a model as C++ for the schedule "one warp a world": threads.h and threads_*.h.

The warp's lanes, 32 or 64, take the model's items (joints, bodies, dofs, entries of matrices, contacts), so what
differs between items is looked up by lane, and what is the same for all becomes a constant. The order in which M's
factor is computed is decided here: the trunk (dofs 0 to T - 1, one path) by all lanes alike, the branches on it in
rounds, each dof in the round after the last of those that hang on it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from .model import FIELDS, Contact, Impedance, Tables, dofs_of

THREADS = 32
MOST_LANES = 2 * THREADS  # a thread holds two of a wide model's
MOST_SLOTS = THREADS  # contacts of a world at a time, each a lane's
MOST_SEGMENTS, MOST_PAIRS = 512, 4096  # what a multiprocessor's memory has room for in each of its worlds
MOST_BYTES = 49_152  # of memory that a block's threads share, without asking for more

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
    sizes = {what: (size, MOST_LANES) for what, size in _items(tables).items()} | {
        "spheres and capsules that may touch others": (len(tables.segments), MOST_SEGMENTS),
        "pairs of geoms that may touch": (len(tables.pairs), MOST_PAIRS),
    }
    for what, (size, most) in sizes.items():
        if size > most:
            return f"cannot step this model: it has {size} {what}, and a warp takes {most}"
    needed = shared_bytes(tables)
    if needed > MOST_BYTES:
        return f"cannot step this model: a world of it takes {needed} bytes, and a warp's memory has {MOST_BYTES}"
    return None


def _items(t: Tables) -> dict[str, int]:
    """What has a lane for each."""
    return {
        "degrees of freedom": t.nv,
        "joints": len(t.joints),
        "actuators": t.nu,
        "moving bodies": len(t.bodies),
        "joints with limits": len(t.limits),
        "bodies in a fluid": len(t.boxes),
    }


def lanes(tables: Tables) -> int:
    """Of a world's warp: one a thread, or two."""
    return THREADS if max(_items(tables).values()) <= THREADS else MOST_LANES


def shared_bytes(t: Tables) -> int:
    """Of what the lanes of a world share: `World` in threads_smooth.h, to some 100 bytes."""
    trunk, more, slots = schedule(t).trunk, t.directions > 3, _slot_count(t)
    packed = trunk * (trunk + 3) // 2 + 4
    numbers = max(17 * (len(t.joints) + 1), 7 * t.nv, packed + 2 * t.nv + 4)
    numbers += t.nv * (_fours(_kept(t)[0]) + (t.nv + 1 | 1) + 7 + 14)
    numbers += 2 * t.nq + 9 + 35 * len(t.bodies) + 14 * len(t.boxes)
    numbers += slots * (_fours((8 if more else 4) * _most_columns(t)) + (24 if more else 12))
    numbers += 0 if _own_slots(t) else (13 + (t.nv > 32)) * slots + t.nv
    numbers += 2 * t.nu + (7 * (len(t.segments) + 1) + len(t.pairs) // 2 if t.pairs else 0)
    return 4 * numbers


def _fours(count: int) -> int:
    """As in threads_smooth.h."""
    fours = -(-count // 4)
    return 4 * (fours if fours % 2 else fours + 1)


def _kept(t: Tables) -> tuple[int, list[int]]:
    """How many columns of M are kept, and the first of each row: of wide models whole fours with the dof's tree."""
    if lanes(t) == THREADS:
        return t.nv, [0] * t.nv
    roots = [(d, *t.ancestors[d])[-1] for d in range(t.nv)]
    last = {root: d for d, root in enumerate(roots)}
    columns = max(-(-(last[root] + 1 - root // 4 * 4) // 4) * 4 for root in last)
    return columns, [min(root // 4 * 4, -(-t.nv // 4) * 4 - columns) for root in roots]


def _most_columns(t: Tables) -> int:
    """Of a contact's Jacobian."""
    return max([len(t.bodies[p.body].chain) for p in t.points] + [len(p.dofs) for p in t.pairs], default=1)


def _slot_count(t: Tables) -> int:
    """Contacts of a world at a time."""
    return max(1, len(t.points) if _own_slots(t) else min(MOST_SLOTS, t.most_contacts))


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
    """The file MODEL that threads.h includes."""
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
    """Lines of C++. What differs between items of a `record` lies together, so that a lane reads it at once."""

    def __init__(self) -> None:
        self._lines = ["// Tables of one model, written by threads.py.", "#pragma once"]
        self._columns: dict[str, dict[str, list[str]]] | None = None  # of the open record, by type
        self._waiting: list[str] = []  # functions of the open record's functions

    @contextlib.contextmanager
    def record(self, name: str) -> Iterator[None]:
        self._columns = {"real": {}, "unsigned": {}}
        yield
        for kind, columns in self._columns.items():
            if columns:
                table, width = f"{name.upper()}_{kind.upper()}_", -(-len(columns) // 4) * 4
                pad = ["0"] * (width - len(columns))
                rows = [", ".join([*row, *pad]) for row in zip(*columns.values(), strict=True)]
                places = ((k, *function.split()) for k, function in enumerate(columns))
                self._lines.append(f"TABLE({kind}) {table}[] = {{{', '.join(rows)}}};")
                self._lines += [
                    f"DEVICE {given} {function}(int i) {{ return {given}({table}[i * {width} + {k}]); }}"
                    for k, given, function in places
                ]
        self._columns = None
        self._lines += self._waiting
        self._waiting = []

    def _after(self, line: str) -> None:
        (self._lines if self._columns is None else self._waiting).append(line)

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
        self._lines.append(f"CONSTANT int {name}[] = {{{listed}}};")

    def scalars(self, name: str, values: Iterable[float], kind: str = "real") -> None:
        """A function of an item's index; a constant if all items agree."""
        values = list(values)
        shown = [_number(v) if kind == "real" else f"{int(v)}{'u' * (kind == 'unsigned')}" for v in values]
        if len(set(shown)) <= 1:
            self._lines.append(f"DEVICE {kind} {name}(int) {{ return {shown[0] if shown else 0}; }}")
            return
        if self._columns is not None:
            self._columns["real" if kind == "real" else "unsigned"][f"{kind} {name}"] = shown
            return
        self._lines.append(f"TABLE({kind}) {name.upper()}_[] = {{{', '.join(shown)}}};")
        self._lines.append(f"DEVICE {kind} {name}(int i) {{ return {name.upper()}_[i]; }}")

    def addresses(self, name: str, values: Sequence[int]) -> None:
        """A function of an item's index; a sum with it, where the addresses follow one another."""
        if all(value == values[0] + k for k, value in enumerate(values)):
            self._lines.append(f"DEVICE int {name}(int i) {{ return i + {values[0] if values else 0}; }}")
        else:
            self.scalars(name, values, "int")

    def sets(self, name: str, values: Sequence[int], bits: int) -> None:
        """Dofs, from two words where one has too few bits."""
        if bits <= 32:
            return self.scalars(name, values, "unsigned")
        self.scalars(f"{name}_low", (value & 0xFFFFFFFF for value in values), "unsigned")
        self.scalars(f"{name}_high", (value >> 32 for value in values), "unsigned")
        self._after(f"DEVICE Dofs {name}(int i) {{ return Dofs({name}_high(i)) << 32 | {name}_low(i); }}")

    def vectors(self, name: str, values: Iterable[np.ndarray]) -> None:
        rows = np.array(list(values), float).reshape(-1, 3)
        for k, part in enumerate("xyz"):
            self.scalars(f"{name}_{part}", rows[:, k])
        self._after(f"DEVICE Vec {name}(int i) {{ return {{{name}_x(i), {name}_y(i), {name}_z(i)}}; }}")

    def matrices(self, name: str, values: Iterable[np.ndarray]) -> None:
        rows = np.array(list(values), float).reshape(-1, 3, 3)
        for k, part in enumerate("abc"):
            self.vectors(f"{name}_{part}", rows[:, k])
        self._after(f"DEVICE Mat {name}(int i) {{ return {{{name}_a(i), {name}_b(i), {name}_c(i)}}; }}")

    def symmetric(self, name: str, values: Iterable[np.ndarray]) -> None:
        rows = np.array(list(values), float).reshape(-1, 3, 3)
        parts = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
        for part, (i, j) in parts.items():
            self.scalars(f"{name}_{part}", rows[:, i, j])
        listed = ", ".join(f"{name}_{part}(i)" for part in parts)
        self._after(f"DEVICE Sym {name}(int i) {{ return {{{listed}}}; }}")

    def quats(self, name: str, values: Iterable[np.ndarray]) -> None:
        rows = np.array(list(values), float).reshape(-1, 4)
        self.scalars(f"{name}_w", rows[:, 0])
        self.vectors(f"{name}_v", rows[:, 1:])


def _number(value: float) -> str:
    """A literal; what is beyond floats becomes the largest that is not."""
    return f"real({float(np.clip(value, -3e38, 3e38))!r})"


def _sizes(out: _Writer, t: Tables) -> None:
    out.line(f"typedef unsigned{' long long' * (t.nv > 32)} Dofs;  // a bit each")
    out.define(
        LANES=lanes(t),
        NQ=t.nq,
        NV=t.nv,
        NU=t.nu,
        SUBSTEPS=t.substeps,
        FORWARD=t.forward,
        RK4=t.rk4,
        FREE=t.has_free,
        BODIES=len(t.bodies),
        JOINTS=len(t.joints),
        POINTS=len(t.points),
        CORNER_POINTS=any(p.corner for p in t.points),
        PAIRS=len(t.pairs),
        BLOCK_PAIRS=sum(p.blocks == 1 for p in t.pairs),
        BOX_PAIRS=sum(p.blocks == 2 for p in t.pairs),
        DIRECTIONS=t.directions,
        SEGMENTS=len(t.segments),
        OWN_SLOTS=_own_slots(t),
        SLOTS=_slot_count(t),
        COLUMNS=_most_columns(t),
        LIMITS=len(t.limits),
        FLUID=bool(t.boxes),
        BOXES=len(t.boxes),
        FILLS=t.fills,
        DAMPED=bool(t.damping.any()),
        SPRINGS=bool(t.stiffness.any()),
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
    out.line("enum { HINGE, SLIDE, SHIFT, FREE_JOINT };")
    with out.record("joint"):
        out.vectors("joint_axis", (j.axis for j in t.joints))
        out.scalars("joint_reference", (j.reference for j in t.joints))
        out.vectors("joint_anchor", (j.anchor for j in t.joints))
        out.matrices("joint_rotation", (j.rotation for j in t.joints))
        out.vectors("joint_position", (j.position for j in t.joints))
        out.scalars("joint_kind", (0 if j.hinge else 3 if j.free else 2 if j.shift else 1 for j in t.joints), "int")
    out.addresses("joint_dof", [j.dof for j in t.joints])
    out.addresses("joint_qpos", [j.qpos for j in t.joints])
    out.quats("joint_quat", (j.quat for j in t.joints))
    out.define(
        ALL_HINGES=all(j.hinge for j in t.joints),
        FREE_JOINTS=any(j.free for j in t.joints),
        TURNED_JOINTS=any((j.rotation != np.eye(3)).any() for j in t.joints),
        OFFSET_JOINTS=any(j.position.any() for j in t.joints),
    )
    _chains(out, t)
    with out.record("body"):
        out.scalars("body_mass", (b.mass for b in t.bodies))
        out.vectors("body_com", (b.com for b in t.bodies))
        _inertias(out, t)
    out.scalars("body_subtree_mass", (b.subtree_mass for b in t.bodies))
    parents = {b.parent for k, b in enumerate(t.bodies) if k}
    dragged = {box.body for box in t.boxes}
    out.fixed("BODY_PARENT", [b.parent for b in t.bodies])
    out.fixed("BODY_CHANGES", [k in parents | dragged for k in range(len(t.bodies))])
    out.sets("body_dofs", [_bits(b.chain) for b in t.bodies], t.nv)
    owner = {dof: j.body for j in t.joints for dof in dofs_of(j)}
    with out.record("dof"):
        for name in ("armature", "damping", "stiffness", "spring"):
            out.scalars(f"dof_{name}", getattr(t, name))
        out.scalars("dof_body", (owner.get(d, 0) for d in range(t.nv)), "int")
    out.addresses("dof_qpos", t.qpos_of_dof.tolist())
    _motors(out, t)
    with out.record("box"):
        out.scalars("box_body", (b.body for b in t.boxes), "int")
        out.vectors("box_centre", (b.centre for b in t.boxes))
        out.vectors("box_size", (b.size for b in t.boxes))
        out.matrices("box_axes", (b.axes for b in t.boxes))
    out.fixed("BOX_BODY", [b.body for b in t.boxes])


def _motors(out: _Writer, t: Tables) -> None:
    servos = not all(m.plain for m in t.motors)
    out.define(SERVOS=servos)
    with out.record("motor"):
        for name in ("gain", "low", "high", "gear"):
            out.scalars(f"motor_{name}", (getattr(m, name) for m in t.motors))
        if servos:
            for name in ("weakest", "strongest"):
                out.scalars(f"motor_{name}", (getattr(m, name) for m in t.motors))
            for name in ("place", "push", "turn", "bias"):
                out.vectors(f"motor_{name}", (np.array(getattr(m, name)) for m in t.motors))
    for name in ("dof", "qpos", "body"):  # of its own table, as -1 is among them
        out.scalars(f"motor_{name}", (getattr(m, name) for m in t.motors), "int")


def _chains(out: _Writer, t: Tables) -> None:
    """Joints from the base to each body: twice the joint, and 1 where the body is its own."""
    chains = [_chain(t, body) for body in range(len(t.bodies))]
    links = [[2 * k + (t.joints[k].body == body) for k in chain] for body, chain in enumerate(chains)]
    depth = max(map(len, links))
    out.define(DEPTH=depth)
    out.scalars("chain_link", (x[k] if k < len(x) else -1 for k in range(depth) for x in links), "int")


def _inertias(out: _Writer, t: Tables) -> None:
    """Inertias, as e E + k u u' if all are so: fewer products turn them."""
    across, along, axes, even = [], [], [], True
    for body in t.bodies:
        values, vectors = np.linalg.eigh(body.inertia)
        pair, single = ([0, 1], 2) if values[1] - values[0] < values[2] - values[1] else ([1, 2], 0)
        across.append(values[pair].mean())
        along.append(values[single] - across[-1])
        axes.append(vectors[:, single])
        even = even and np.ptp(values[pair]) <= 1e-9 * max(1e-12, values[2])
    out.define(ROUND_BODIES=even)
    if even:
        out.scalars("body_across", across)
        out.scalars("body_along", along)
        out.vectors("body_round_axis", axes)
    else:
        out.symmetric("body_inertia", (b.inertia for b in t.bodies))


def _chain(t: Tables, body: int) -> list[int]:
    """Joints from the base to a body."""
    own = [k for k, joint in enumerate(t.joints) if joint.body == body]
    return [*_chain(t, t.bodies[body].parent), *own] if body else own


def _entries(out: _Writer, t: Tables) -> None:
    """Entries of M and H."""
    base = 6 if t.has_free else 0
    pairs = [(i, j) for i in range(base, t.nv) for j in (i, *t.ancestors[i]) if j >= base]
    columns, first = _kept(t)
    out.define(PAIR_ENTRIES=len(pairs), M_COLUMNS=columns)
    out.scalars("first_column", first, "int")
    out.line(f"#define OUTER_DOFS {((1 << t.nv) - 1) & ~((1 << base) - 1)}u")
    out.scalars("pair_entry", (i | j << 8 for i, j in pairs), "unsigned")
    # The base's block: the first moment h crosswise, then the inertia; mass and zeros never change.
    block = [(3, 1, 2, 1), (3, 2, 1, 0), (4, 0, 2, 0), (4, 2, 0, 1), (5, 0, 1, 1), (5, 1, 0, 0)]
    block += [(3, 3, 3, 0), (4, 4, 4, 0), (5, 5, 5, 0), (4, 3, 6, 0), (5, 3, 7, 0), (5, 4, 8, 0)]
    block = block if t.has_free else []
    out.define(BASE_ENTRIES=len(block))
    out.scalars("base_entry", (i | j << 8 | k << 16 | minus << 24 for i, j, k, minus in block), "unsigned")
    entries = [(i, j) for i in range(t.nv) for j in (i, *t.ancestors[i])]
    column = [len(above) for above in t.ancestors]  # in Jacobians of points
    out.define(ENTRIES=len(entries))
    out.scalars("hessian_entry", (i | j << 8 | column[i] << 16 | column[j] << 24 for i, j in entries), "unsigned")
    out.scalars("dof_column", column, "int")
    slots = [_slots(t, d) for d in range(t.nv)]
    out.scalars("dof_slots", slots, "unsigned")
    out.scalars("entry_slots", (slots[i] & slots[j] for i, j in entries), "unsigned")
    if t.fills:
        out.scalars("full_entry", (i | j << 8 for i in range(t.nv) for j in range(i + 1)), "unsigned")
    fills = [(i, j) for i in range(t.nv) for j in range(i) if j not in t.ancestors[i]]
    out.define(FILL_ENTRIES=len(fills))
    out.scalars("fill_entry", (i | j << 8 for i, j in fills), "unsigned")


def _own_slots(t: Tables) -> bool:
    """Whether each point that may touch has a slot of its own."""
    return not t.pairs and len(t.points) <= min(MOST_SLOTS, t.most_contacts)


def _slots(t: Tables, dof: int) -> int:
    """The contacts that a dof moves, where each point has a slot."""
    return _bits(k for k, p in enumerate(t.points) if dof in t.bodies[p.body].chain) if _own_slots(t) else 0


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
    out.scalars("round_start", [*starts, len(entries)], "int")
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


def _contacts(out: _Writer, t: Tables) -> None:
    """Candidates: points over the floor, then pairs."""
    # Of mjraw_CapsuleCapsule, the sine squared of axes that are parallel; of mjraw_SphereSphere, in m, what rounding
    # leaves of the distance between segments that cross.
    out.line("constexpr real PARALLEL = real(1e-8);")
    out.line("constexpr real CROSSING = sizeof(real) == 4 ? real(1e-6) : real(1e-15);")
    with out.record("point"):
        out.vectors("point_centre", (p.centre for p in t.points))
        out.scalars("point_radius", (p.radius for p in t.points))
        out.vectors("point_axis", (p.axis for p in t.points))
        out.scalars("point_height", (p.height for p in t.points))
        out.scalars("point_body", (p.body for p in t.points), "int")
        out.scalars("point_round", (p.corner or not p.axis.any() for p in t.points), "bool")
        out.scalars("point_corner", (p.corner for p in t.points), "int")
    with out.record("segment"):
        out.vectors("segment_centre", (s.centre for s in t.segments))
        out.scalars("segment_radius", (s.radius for s in t.segments))
        out.vectors("segment_half", (s.half for s in t.segments))
        out.scalars("segment_body", (s.body for s in t.segments), "int")
        out.vectors("segment_side", (s.side for s in t.segments))
    with out.record("block"):
        out.matrices("block_axes", (b.axes for b in t.blocks))
        out.vectors("block_offset", (b.offset for b in t.blocks))
        out.vectors("block_size", (b.size for b in t.blocks))
        out.scalars("block_body", (b.body for b in t.blocks), "int")
    out.scalars("pair_segments", (p.first | p.second << 16 for p in t.pairs), "unsigned")
    out.scalars("pair_far", (1.0001 * t.reach(p) ** 2 for p in t.pairs))
    contacts: list[Contact] = [p.contact for p in (*t.points, *t.pairs)]
    related = [{d, *t.ancestors[d]} for d in range(t.nv)]
    fills = [any(a not in related[b] and b not in related[a] for a in p.dofs for b in p.dofs) for p in t.pairs]
    dofs = [_bits(t.bodies[p.body].chain) for p in t.points] + [_bits(p.dofs) for p in t.pairs]
    minus = [_bits(d for d, sign in zip(p.dofs, p.signs, strict=True) if sign < 0) for p in t.pairs]
    with out.record("contact"):
        for name in ("margin", "regularisation"):
            out.scalars(f"contact_{name}", (getattr(c, name) for c in contacts))
        for k, name in {0: "friction", 2: "spin", 3: "roll"}.items():
            out.scalars(f"contact_{name}", (c.friction[k] for c in contacts))
        out.scalars("contact_dims", (c.dims for c in contacts), "int")
        for name in Impedance._fields:
            out.scalars(f"contact_{name}", (getattr(c.impedance, name) for c in contacts))
        out.sets("contact_dofs", dofs, t.nv)
        out.sets("contact_opposite", [0] * len(t.points) + minus, t.nv)
        out.scalars("contact_fills", [False] * len(t.points) + fills, "bool")
    first = [-1] * len(t.points) + [(t.blocks if p.blocks else t.segments)[p.first].place for p in t.pairs]
    second = [p.place for p in t.points]
    second += [(t.blocks if p.blocks == 2 else t.segments)[p.second].place for p in t.pairs]
    out.scalars("contact_first_place", first, "int")
    out.scalars("contact_second_place", second, "int")


def _limits(out: _Writer, t: Tables) -> None:
    with out.record("limit"):
        for name in ("low", "high", "margin", "inverse_weight"):
            out.scalars(f"limit_{name}", (getattr(x, name) for x in t.limits))
        for name in Impedance._fields:
            out.scalars(f"limit_{name}", (getattr(x.impedance, name) for x in t.limits))
        out.scalars("limit_dof", (x.dof for x in t.limits), "int")
        out.scalars("limit_qpos", (x.qpos for x in t.limits), "int")


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
