"""Tables of a compiled MjModel that the fused step is generated from, and what it cannot step.

The step knows trees of slides, hinges and free joints; spheres, capsules and boxes that touch horizontal planes and one
another; pyramidal cones of all sizes, limits, springs, damping, fluid by inertia boxes; motors of joints and at sites;
Euler and RK4. Nothing here depends on the robot.

Bodies without joints are lumped into the moving body they are welded to. Moving body 0 is the base: the free root, if
all hangs on one, else the world. All places and axes below are in the frame of a moving body.

Formulas are those of MuJoCo 3.17's C sources: engine_core_constraint.c (`mj_makeImpedance`, `mj_diagApprox`),
engine_collision_driver.c (`mj_contactParam`, filters), engine_passive.c (`mj_inertiaBoxFluidModel`).
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

if TYPE_CHECKING:
    from ..contract import Readout

MOST_DOFS = 128
MOST_CONTACTS = 64  # of one world at a time, unless it can never have more

_MINVAL = 1e-15  # mjMINVAL
_MINIMP, _MAXIMP = 1e-4, 0.9999  # mjMINIMP, mjMAXIMP
_MINMU = 1e-5  # mjMINMU
CORNERS = 8  # of a box, and the most contacts of two boxes

_FREE, _BALL, _SLIDE, _HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{x}")) for x in ("FREE", "BALL", "SLIDE", "HINGE"))
_PLANE, _SPHERE, _CAPSULE, _BOX = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{x}")) for x in ("PLANE", "SPHERE", "CAPSULE", "BOX")
)
_AT_JOINT, _AT_SITE = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_SITE)
_EULER, _RK4 = int(mujoco.mjtIntegrator.mjINT_EULER), int(mujoco.mjtIntegrator.mjINT_RK4)
_Disable = mujoco.mjtDisableBit
# What these switch off is computed here in no other way: searches for islands and for colliding boxes.
_HARMLESS = _Disable.mjDSBL_AUTORESET | _Disable.mjDSBL_ISLAND | _Disable.mjDSBL_MIDPHASE | _Disable.mjDSBL_SENSOR
_HARMLESS |= _Disable.mjDSBL_NATIVECCD | _Disable.mjDSBL_MULTICCD

# Readouts by the field of mjData: numbers in a row.
FIELDS = {
    "xpos": 3,
    "xquat": 4,
    "xmat": 9,
    "xipos": 3,
    "subtree_com": 3,
    "cinert": 10,
    "cvel": 6,
    "cfrc_ext": 6,
    "qfrc_actuator": 1,
    "qacc": 1,
}
_OF_DOFS = ("qfrc_actuator", "qacc")  # fields with a row for a degree of freedom, not for a body


class Impedance(NamedTuple):
    """A constraint's reference acceleration and impedance, from solref and solimp (`mj_makeImpedance`).

    Attributes:
      stiffness: K, 1/s2. damping: B, 1/s. Of the reference acceleration -B v - K imp pos.
      lowest, highest: impedance at 0 and at the width.
      inverse_width: 1 / m (or 1 / rad).
    """

    stiffness: float
    damping: float
    lowest: float
    highest: float
    inverse_width: float


class Contact(NamedTuple):
    """Parameters of a contact between two geoms.

    Attributes:
      dims: 3, 4 or 6 directions: the normal and both tangents; spin about the normal; rolling about both tangents. The
        pyramid has two edges for each but the normal.
      friction: [5], mu of the directions after the normal; 0 of a frictionless contact, whose row is four equal edges
        of a quarter each.
      margin: m, a contact exists up to this distance.
      impedance: see `Impedance`.
      regularisation: R of each edge is this times (1 - imp) / imp.
    """

    dims: int
    friction: tuple[float, ...]
    margin: float
    impedance: Impedance
    regularisation: float


@dataclasses.dataclass(frozen=True)
class Body:
    """A moving body with all that is welded to it.

    Attributes:
      parent: moving body it hangs on; the base is its own.
      mass: kg. com: [3] m. inertia: [3, 3] kg m2 about com, in the body's axes. The world's are zero.
      subtree_mass: kg, with what hangs on it.
      chain: degrees of freedom that move it, ascending.
    """

    parent: int
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    subtree_mass: float
    chain: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Joint:
    """A slide, a hinge or a free joint, in the order of the tree.

    A base that is a free root has none: its frame is that of everything.

    A body's frame is its parent's, then for each of its joints: moved to `anchor` (a slide: moved on along `axis`),
    turned about `axis` (a hinge), turned by `rotation`, moved back by `position`. A free joint's frame is its qpos.

    Attributes:
      hinge: a hinge. free: a free joint; else a slide.
      shift: a slide along the floor that everything hangs on: only readouts of places depend on its qpos.
      body: moving body that it moves.
      qpos, dof: addresses; of the first of a free joint's.
      reference: qpos0.
      axis, anchor: [3] in the frame before it. position: [3] of the anchor in the frame behind it; 0 of a slide.
      rotation, quat: [3, 3] and [4], the fixed turn of the body against its parent; identity but of its first joint.
    """

    hinge: bool
    free: bool
    shift: bool
    body: int
    qpos: int
    dof: int
    reference: float
    axis: np.ndarray
    anchor: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    quat: np.ndarray


@dataclasses.dataclass(frozen=True)
class Place:
    """A body of the MjModel.

    Attributes:
      body: moving body it is welded to; -1 for the world where the base is a free root.
      root: moving body at the root of its tree, about whose centre of mass cinert, cvel and cfrc_ext are; -1: none.
      moves: it is that moving body itself.
      position, rotation, quat: [3], [3, 3], [4] in that body's frame.
      mass, com, inertia: kg, [3] m and [3, 3] kg m2 of this body alone, in that body's frame.
    """

    body: int
    root: int
    moves: bool
    position: np.ndarray
    rotation: np.ndarray
    quat: np.ndarray
    mass: float
    com: np.ndarray
    inertia: np.ndarray


@dataclasses.dataclass(frozen=True)
class FluidBox:
    """A body's inertia as a box in a fluid (`mj_inertiaBoxFluidModel`).

    Attributes:
      body: moving body. centre: [3] m. axes: [3, 3], columns are the box's axes. size: [3] m, full widths.
    """

    body: int
    centre: np.ndarray
    axes: np.ndarray
    size: np.ndarray


@dataclasses.dataclass(frozen=True)
class Point:
    """A sphere, an end of a capsule or a corner of a box, over a horizontal plane of the world.

    Attributes:
      body: moving body. place: body of the MjModel, for forces on it.
      corner: 1 to 8 of a box's corners, which follow one another; else 0.
      centre: [3] m.
      axis: [3], a capsule's, which the first tangent follows; m, from the middle of a corner's box; 0 of a sphere.
      radius: m. height: m, the plane's. contact: see `Contact`.
    """

    body: int
    place: int
    corner: int
    centre: np.ndarray
    axis: np.ndarray
    radius: float
    height: float
    contact: Contact


@dataclasses.dataclass(frozen=True)
class Segment:
    """A sphere or capsule that may touch others.

    Attributes:
      body: moving body. place: body of the MjModel, for forces on it.
      centre: [3] m. half: [3] m, from there to an end; 0 of a sphere. side: [3], the geom's x axis. radius: m.
    """

    body: int
    place: int
    centre: np.ndarray
    half: np.ndarray
    side: np.ndarray
    radius: float

    @property
    def extent(self) -> float:
        """m, from its middle to where it is furthest."""
        return self.radius + _length(self.half)


@dataclasses.dataclass(frozen=True)
class Block:
    """A box that segments or other boxes may touch.

    Attributes:
      body: moving body; -1 for the world where the base is a free root. place: body of the MjModel, for forces on it.
      axes: [3, 3], rows are the box's axes. offset: [3] m, its middle along them. size: [3] m, half widths.
      reach: m, from the base's origin to the box: further away no segment of a free root can touch it; else infinite.
    """

    body: int
    place: int
    axes: np.ndarray
    offset: np.ndarray
    size: np.ndarray
    reach: float

    @property
    def extent(self) -> float:
        """m, from its middle to a corner."""
        return _length(self.size)


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two segments, a box and a segment, or two boxes that may touch.

    Attributes:
      first, second: indices into `Tables.segments`, in MuJoCo's order: the normal points from the first to the second.
      blocks: how many are boxes: the first, or both, are indices into `Tables.blocks`.
      rooted: the free root's dofs are among `dofs`.
      dofs: degrees of freedom that move one of the two only, ascending.
      signs: 1 where a dof moves the second, -1 where it moves the first.
      contact: see `Contact`.
    """

    first: int
    second: int
    blocks: int
    rooted: bool
    dofs: tuple[int, ...]
    signs: tuple[int, ...]
    contact: Contact


class Limit(NamedTuple):
    """A joint's range.

    Attributes:
      qpos, dof: addresses. low, high, margin: rad or m. impedance: see `Impedance`.
      inverse_weight: R is this times (1 - imp) / imp.
    """

    qpos: int
    dof: int
    low: float
    high: float
    margin: float
    impedance: Impedance
    inverse_weight: float


@dataclasses.dataclass(frozen=True)
class Motor:
    """An actuator: a force along a joint or at a site.

    Attributes:
      dof: of its joint, or -1. gear: the joint's share of the force.
      qpos: of its joint, on whose place the force may depend; -1 of a site.
      body: moving body of its site, else 0. place: [3] m, the site's. push, turn: [3] each, per unit of the force, the
        force and the moment there; 0 of a joint.
      gain: times the control, clipped to low and high.
      bias: [3], added to it: a constant, times the joint's place, times the speed along `gear` or `push` and `turn`.
      weakest, strongest: what the sum is clipped to.
    """

    dof: int
    gear: float
    qpos: int
    body: int
    place: np.ndarray
    push: np.ndarray
    turn: np.ndarray
    gain: float
    low: float
    high: float
    bias: tuple[float, float, float]
    weakest: float
    strongest: float

    @property
    def plain(self) -> bool:
        """Whether its force depends on the control alone."""
        return self.dof >= 0 and not any(self.bias) and bool(np.isinf(self.weakest) and np.isinf(self.strongest))


class Reading(NamedTuple):
    """A readout: rows of a field of mjData, `FIELDS[field]` numbers each.

    Attributes:
      field: one of `FIELDS`. rows: indices into its first axis, in the order of the output. shape: of the readout.
    """

    field: str
    rows: tuple[int, ...]
    shape: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Tables:
    """All that the step is generated from.

    Attributes:
      nq, nv, nu, nbody: MuJoCo's sizes.
      substeps: integration steps in a control step. timestep: s. rk4: the integrator, else Euler with implicit damping.
      gravity: m/s2 downwards.
      improvement_scale: MuJoCo's scale of the solver's cost, 1 / (meaninertia nv).
      iterations, line_search: the solver's bounds.
      has_free: moving body 0 is a free root with dofs 0 to 5 (world axes, then the root's); else it is the world.
      bodies, joints, places: see their classes. Bodies and joints: parents first.
      boxes: of a fluid; empty without. density: kg/m3. viscosity: Pa s.
      forward: after the substeps, a forward pass at the new state, to which the readouts belong.
      points, segments, blocks, pairs, limits, motors: see their classes. Pairs: of segments, then those with a block,
        block by block, then of two blocks.
      directions: 3, or 6 if a contact has more than 3.
      ancestors: for each dof those before it on its chain, descending: M's pattern below the diagonal.
      fills: a pair's contact couples dofs that M does not.
      most_contacts: of one world at a time; one with more reports `overflow`.
      armature, damping, stiffness, spring: [nv]; the force of a spring is -stiffness (qpos - spring).
      qpos_of_dof: [nv], the address of a slide's or hinge's qpos.
      readings: name -> `Reading`, in the order of the output [width].
    """

    nq: int
    nv: int
    nu: int
    nbody: int
    substeps: int
    forward: bool
    timestep: float
    rk4: bool
    gravity: float
    improvement_scale: float
    iterations: int
    line_search: int
    has_free: bool
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    places: tuple[Place, ...]
    boxes: tuple[FluidBox, ...]
    density: float
    viscosity: float
    points: tuple[Point, ...]
    segments: tuple[Segment, ...]
    blocks: tuple[Block, ...]
    pairs: tuple[Pair, ...]
    limits: tuple[Limit, ...]
    motors: tuple[Motor, ...]
    directions: int
    ancestors: tuple[tuple[int, ...], ...]
    fills: bool
    most_contacts: int
    armature: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    spring: np.ndarray
    qpos_of_dof: np.ndarray
    readings: dict[str, Reading]

    @property
    def width(self) -> int:
        """Numbers in all readouts."""
        return sum(FIELDS[reading.field] * len(reading.rows) for reading in self.readings.values())

    @property
    def rooted(self) -> bool:
        """Whether every contact is moved by all the root's dofs."""
        return all(pair.rooted for pair in self.pairs)

    def reach(self, pair: Pair) -> float:
        """m, between the middles of two, or a segment's and a box: further apart they cannot touch."""
        first = 0.0 if pair.blocks == 1 else (self.blocks if pair.blocks else self.segments)[pair.first].extent
        second = (self.blocks if pair.blocks == 2 else self.segments)[pair.second].extent
        return pair.contact.margin + first + second


def tables(
    model: mujoco.MjModel, substeps: int, readout: Readout, contacts: int | None = None, forward: bool = False
) -> Tables:
    """The tables of a model without an `obstacle`; `contacts` of one world at a time, derived if None."""
    m = model
    tree = _Tree(m)
    points = tuple(_points(m, tree))
    segments, blocks, pairs = _pairs(m, tree)
    chains = [body.chain for body in tree.bodies]
    stiffness, spring, qpos_of_dof = _springs(m)
    fluid = bool(m.opt.density or m.opt.viscosity)
    return Tables(
        nq=m.nq,
        nv=m.nv,
        nu=m.nu,
        nbody=m.nbody,
        substeps=substeps,
        forward=forward,
        timestep=float(m.opt.timestep),
        rk4=int(m.opt.integrator) == _RK4,
        gravity=-float(m.opt.gravity[2]),
        improvement_scale=1.0 / (float(m.stat.meaninertia) * max(1, m.nv)),
        iterations=int(m.opt.iterations),
        line_search=min(12, int(m.opt.ls_iterations)),  # its tolerance is wider than MuJoCo's
        has_free=tree.has_free,
        bodies=tuple(tree.bodies),
        joints=tuple(tree.joints),
        places=tuple(tree.places),
        boxes=tuple(_boxes(m, tree)) if fluid else (),
        density=float(m.opt.density),
        viscosity=float(m.opt.viscosity),
        points=points,
        segments=segments,
        blocks=blocks,
        pairs=pairs,
        limits=tuple(_limits(m)),
        motors=tuple(_motors(m, tree)),
        directions=6 if any(x.contact.dims > 3 for x in (*points, *pairs)) else 3,
        ancestors=tuple(_ancestors(d, chains) for d in range(m.nv)),
        fills=any(_fills(pair.dofs, chains) for pair in pairs),
        most_contacts=contacts or max(1, min(MOST_CONTACTS, len(points) + sum(_most_of(pair) for pair in pairs))),
        armature=np.array(m.dof_armature),
        damping=np.array(m.dof_damping),
        stiffness=stiffness,
        spring=spring,
        qpos_of_dof=qpos_of_dof,
        readings={name: _reading(m, field, index) for name, (field, index) in readout.items()},
    )


def _most_of(pair: Pair) -> int:
    """Contacts that a pair has at a time."""
    return CORNERS if pair.blocks == 2 else 2


# -- the tree --


class _Tree:
    """Moving bodies, joints, and where the MjModel's bodies are."""

    def __init__(self, m: mujoco.MjModel):
        self._m = m
        self.has_free = _on_one_root(m)
        self.moving = [] if self.has_free else [0]  # bodies of the MjModel
        self.joints: list[Joint] = []
        self.places: list[Place] = []
        parents = self._parents = [] if self.has_free else [0]
        for b in range(m.nbody):
            self.places.append(self._place(b, parents))
        chains = self._chains(parents)
        masses = [self._lumped(k) for k in range(len(self.moving))]
        above = [self._above(k, parents) for k in range(len(self.moving))]
        self.bodies = [
            Body(parents[k], *masses[k], sum(masses[c][0] for c in range(len(masses)) if k in above[c]), chains[k])
            for k in range(len(self.moving))
        ]

    def _place(self, b: int, parents: list[int]) -> Place:
        """Where body `b` is. One with joints becomes a moving body."""
        m = self._m
        position, rotation, quat = np.zeros(3), np.eye(3), np.array([1.0, 0, 0, 0])
        moving = root = -1 if self.has_free else 0
        if b:
            above = self.places[m.body_parentid[b]]
            position = above.position + above.rotation @ m.body_pos[b]
            rotation, quat = above.rotation @ _matrix(m.body_quat[b]), _product(above.quat, m.body_quat[b])
            moving = above.body
        moves = bool(m.body_jntnum[b])
        if moves:
            if self.moving:
                self._hang(b, moving, position, rotation, quat)
            parents.append(max(moving, 0))
            moving = len(self.moving)
            self.moving.append(b)
            position, rotation, quat = np.zeros(3), np.eye(3), np.array([1.0, 0, 0, 0])
        if b:
            top = int(m.body_rootid[b])
            root = self.moving.index(top) if top in self.moving else -1
        turn = rotation @ _matrix(m.body_iquat[b])
        return Place(
            body=moving,
            root=root,
            moves=moves,
            position=position,
            rotation=rotation,
            quat=quat,
            mass=float(m.body_mass[b]),
            com=position + rotation @ m.body_ipos[b],
            inertia=turn @ np.diag(m.body_inertia[b]) @ turn.T,
        )

    def _hang(self, b: int, parent: int, position: np.ndarray, rotation: np.ndarray, quat: np.ndarray) -> None:
        """Adds the joints of body `b`, whose frame is at `position` of moving body `parent`."""
        m = self._m
        for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
            hinge, free = bool(m.jnt_type[j] == _HINGE), bool(m.jnt_type[j] == _FREE)
            if free:  # its qpos is all that counts
                position, rotation, quat = np.zeros(3), np.eye(3), np.array([1.0, 0, 0, 0])
            at = np.array(m.jnt_pos[j]) if hinge else np.zeros(3)
            axis = rotation @ m.jnt_axis[j]
            # Only the first bodies' first slides shift all that has mass; a static geom to touch would stay behind.
            alone = not self.has_free and parent == 0 and self._only_tree() and all(x.shift for x in self.joints)
            self.joints.append(
                Joint(
                    hinge=hinge,
                    free=free,
                    shift=bool(
                        not hinge and not free and alone and abs(axis[2]) < 1e-12 and (rotation == np.eye(3)).all()
                    ),
                    body=len(self.moving),
                    qpos=int(m.jnt_qposadr[j]),
                    dof=int(m.jnt_dofadr[j]),
                    reference=float(m.qpos0[m.jnt_qposadr[j]]),
                    axis=axis,
                    anchor=position + rotation @ at,
                    position=at,
                    rotation=rotation,
                    quat=quat,
                )
            )
            position, rotation, quat = np.zeros(3), np.eye(3), np.array([1.0, 0, 0, 0])

    def _only_tree(self) -> bool:
        m = self._m
        static = [g for g in range(m.ngeom) if m.body_weldid[m.geom_bodyid[g]] == 0]
        touch = any(m.geom_type[g] != _PLANE and (m.geom_contype[g] or m.geom_conaffinity[g]) for g in static)
        return m.ntree == 1 and not touch

    def _above(self, body: int, parents: list[int]) -> list[int]:
        """Moving bodies from `body` to the base."""
        found = [body]
        while found[-1]:
            found.append(parents[found[-1]])
        return found

    def _chains(self, parents: list[int]) -> list[tuple[int, ...]]:
        root = range(6 if self.has_free else 0)
        own = [[d for j in self.joints if j.body == k for d in dofs_of(j)] for k in range(len(self.moving))]
        return [
            tuple(sorted([*root, *(dof for a in self._above(k, parents) for dof in own[a])]))
            for k in range(len(self.moving))
        ]

    def furthest(self, body: int) -> float:
        """m, how far a moving body's origin can be from the base's; slides are endless."""
        own = [joint for above in self._above(body, self._parents) for joint in self.joints if joint.body == above]
        return sum(_length(j.anchor) + _length(j.position) if j.hinge else np.inf for j in own)

    def _lumped(self, body: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass, centre of mass and inertia of all that is welded to a moving body."""
        parts = [p for b, p in enumerate(self.places) if p.body == body and b and (body or self.has_free)]
        mass = sum(p.mass for p in parts)
        if not mass:
            return 0.0, np.zeros(3), np.zeros((3, 3))
        com = sum((p.mass * p.com for p in parts), np.zeros(3)) / mass
        inertia = sum((p.inertia + p.mass * _parallel(p.com - com) for p in parts), np.zeros((3, 3)))
        return mass, com, inertia


def dofs_of(joint: Joint) -> range:
    """The degrees of freedom of a joint."""
    return range(joint.dof, joint.dof + (6 if joint.free else 1))


def _on_one_root(m: mujoco.MjModel) -> bool:
    """Whether a free root carries all that moves, so that its frame can be the base's.

    Not if a motor acts at a site, which may be on the root, nor if two geoms may touch of which one is fixed and is
    neither a plane nor a box that spheres and capsules touch.
    """
    if not m.njnt or m.jnt_type[0] != _FREE or m.ntree > 1 or np.any(m.actuator_trntype != _AT_JOINT):
        return False
    for g, h in collisions(m):
        fixed = [m.body_weldid[m.geom_bodyid[x]] == 0 for x in (g, h)]
        if m.geom_type[g] != _PLANE and (fixed[0] or fixed[1] and (m.geom_type[h] != _BOX or m.geom_type[g] == _BOX)):
            return False
    return True


def _parallel(offset: np.ndarray) -> np.ndarray:
    """What an offset adds to the inertia [3, 3] of a unit mass."""
    return offset @ offset * np.eye(3) - np.outer(offset, offset)


def _ancestors(dof: int, chains: list[tuple[int, ...]]) -> tuple[int, ...]:
    chain = min((chain for chain in chains if dof in chain), key=len)
    return tuple(d for d in reversed(chain) if d < dof)


def _fills(dofs: tuple[int, ...], chains: list[tuple[int, ...]]) -> bool:
    """Whether two of the dofs are on no chain together."""
    return any(not any(a in chain and b in chain for chain in chains) for a, b in itertools.combinations(dofs, 2))


def _springs(m: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stiffness [nv] and reference [nv] of the joints' springs, and the address [nv] of each dof's qpos."""
    stiffness, spring, qpos = np.zeros(m.nv), np.zeros(m.nv), np.zeros(m.nv, int)
    for j in range(m.njnt):
        if m.jnt_type[j] in (_SLIDE, _HINGE):
            dof, address = m.jnt_dofadr[j], m.jnt_qposadr[j]
            stiffness[dof], spring[dof], qpos[dof] = m.jnt_stiffness[j], m.qpos_spring[address], address
    return stiffness, spring, qpos


def _boxes(m: mujoco.MjModel, tree: _Tree) -> Iterator[FluidBox]:
    for b, place in enumerate(tree.places):
        if place.body >= 0 and m.body_weldid[b] and m.body_mass[b] >= _MINVAL:
            x, y, z = m.body_inertia[b]
            squares = np.maximum(_MINVAL, [y + z - x, x + z - y, x + y - z]) / m.body_mass[b] * 6.0
            axes = place.rotation @ _matrix(m.body_iquat[b])
            yield FluidBox(place.body, place.com, axes, np.sqrt(squares))


def _limits(m: mujoco.MjModel) -> Iterator[Limit]:
    for j in range(m.njnt):
        if m.jnt_limited[j]:
            dof = int(m.jnt_dofadr[j])
            impedance = impedance_of(m, m.jnt_solref[j], m.jnt_solimp[j])
            low, high = map(float, m.jnt_range[j])
            margin, weight = float(m.jnt_margin[j]), float(m.dof_invweight0[dof])
            yield Limit(int(m.jnt_qposadr[j]), dof, low, high, margin, impedance, weight)


def _motors(m: mujoco.MjModel, tree: _Tree) -> Iterator[Motor]:
    for a in range(m.nu):
        low, high = map(float, m.actuator_ctrlrange[a]) if m.actuator_ctrllimited[a] else (-np.inf, np.inf)
        weakest, strongest = map(float, m.actuator_forcerange[a]) if m.actuator_forcelimited[a] else (-np.inf, np.inf)
        biased = m.actuator_biastype[a] == int(mujoco.mjtBias.mjBIAS_AFFINE)
        constant, of_place, of_speed = map(float, m.actuator_biasprm[a, :3] if biased else np.zeros(3))
        target, at_joint = int(m.actuator_trnid[a, 0]), m.actuator_trntype[a] == _AT_JOINT
        body, place, push, turn = 0, np.zeros(3), np.zeros(3), np.zeros(3)
        if not at_joint:
            on = tree.places[m.site_bodyid[target]]
            axes = on.rotation @ _matrix(m.site_quat[target])
            body, place = on.body, on.position + on.rotation @ m.site_pos[target]
            push, turn = axes @ m.actuator_gear[a, :3], axes @ m.actuator_gear[a, 3:]
        yield Motor(
            dof=int(m.jnt_dofadr[target]) if at_joint else -1,
            gear=float(m.actuator_gear[a, 0]) if at_joint else 0.0,
            qpos=int(m.jnt_qposadr[target]) if at_joint else -1,
            body=body,
            place=place,
            push=push,
            turn=turn,
            gain=float(m.actuator_gainprm[a, 0]),
            low=low,
            high=high,
            bias=(constant, of_place, of_speed),
            weakest=weakest,
            strongest=strongest,
        )


def _reading(m: mujoco.MjModel, field: str, index: object) -> Reading:
    rows = np.arange(m.nv if field in _OF_DOFS else m.nbody)[index]
    row = () if field in _OF_DOFS else (FIELDS[field],)
    return Reading(field, tuple(int(r) for r in rows.reshape(-1)), (*rows.shape, *row))


# -- contacts --


def impedance_of(m: mujoco.MjModel, solref: np.ndarray, solimp: np.ndarray) -> Impedance:
    """See `Impedance`; a time constant is at least two time steps (`refsafe`)."""
    lowest, highest = (min(max(float(x), _MINIMP), _MAXIMP) for x in solimp[:2])
    width = max(0.0, float(solimp[2]))
    if solref[0] > 0:
        time = max(float(solref[0]), 2.0 * float(m.opt.timestep))
        ratio = float(solref[1])
        stiffness = 1.0 / max(_MINVAL, highest**2 * time**2 * ratio**2)
        damping = 2.0 / max(_MINVAL, highest * time)
    else:
        stiffness, damping = -float(solref[0]) / highest**2, -float(solref[1]) / highest
    if width <= _MINVAL:
        lowest = highest = 0.5 * (lowest + highest)
    return Impedance(stiffness, damping, lowest, highest, 1.0 / width if width > _MINVAL else 0.0)


def contact_of(m: mujoco.MjModel, first: int, second: int) -> Contact:
    """Parameters of a contact of two geoms (`mj_contactParam`, `mj_diagApprox`)."""
    condim, friction, solref, solimp = _mixed(m, first, second)
    margin = float(m.geom_margin[first] + m.geom_margin[second])
    weight = float(sum(m.body_invweight0[m.geom_bodyid[g], 0] for g in (first, second)))
    impedance = impedance_of(m, solref, solimp)
    if condim == 1:
        return Contact(3, (0.0,) * 5, margin, impedance, 4.0 * weight)
    slide, spin, roll = np.maximum(friction, _MINMU).tolist()
    mu = (slide, slide, spin, roll, roll)[: condim - 1]
    regularisation = 2.0 * slide**2 * weight * (1.0 + slide**2)  # all edges have that of the first
    return Contact(condim, (*mu, *(0.0,) * (5 - len(mu))), margin, impedance, regularisation)


def _mixed(m: mujoco.MjModel, g: int, h: int) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """condim, friction [3] (sliding, spinning, rolling), solref and solimp of two geoms."""
    if m.geom_priority[g] != m.geom_priority[h]:
        geom = g if m.geom_priority[g] > m.geom_priority[h] else h
        return int(m.geom_condim[geom]), m.geom_friction[geom], m.geom_solref[geom], m.geom_solimp[geom]
    first, second = (float(m.geom_solmix[x]) for x in (g, h))
    if first >= _MINVAL and second >= _MINVAL:
        mix = first / (first + second)
    else:
        mix = 0.5 if first < _MINVAL and second < _MINVAL else float(first >= _MINVAL)
    solref = mix * m.geom_solref[g] + (1.0 - mix) * m.geom_solref[h]
    if not (m.geom_solref[g, 0] > 0 and m.geom_solref[h, 0] > 0):
        solref = np.minimum(m.geom_solref[g], m.geom_solref[h])
    solimp = mix * m.geom_solimp[g] + (1.0 - mix) * m.geom_solimp[h]
    condim = int(max(m.geom_condim[g], m.geom_condim[h]))
    return condim, np.maximum(m.geom_friction[g], m.geom_friction[h]), solref, solimp


def collisions(m: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Pairs of geoms that may touch, the lower type first, as `mj_collision` filters them."""
    excluded = {int(signature) for signature in m.exclude_signature}
    for g, h in itertools.combinations(range(m.ngeom), 2):
        if not (m.geom_contype[g] & m.geom_conaffinity[h] or m.geom_contype[h] & m.geom_conaffinity[g]):
            continue
        a, b = m.body_weldid[m.geom_bodyid[[g, h]]]
        parent_a, parent_b = m.body_weldid[m.body_parentid[[a, b]]]
        related = a and b and (parent_a == b or parent_b == a)
        low, high = sorted(int(m.geom_bodyid[x]) for x in (g, h))
        if a == b or related or (low << 16) + high in excluded:
            continue
        yield (g, h) if m.geom_type[g] <= m.geom_type[h] else (h, g)


def _points(m: mujoco.MjModel, tree: _Tree) -> Iterator[Point]:
    for plane, geom in collisions(m):
        if m.geom_type[plane] != _PLANE:
            continue
        height, contact = float(_in_world(m, tree, plane)[2]), contact_of(m, plane, geom)
        if m.geom_type[geom] == _BOX:
            yield from _corners(m, tree, geom, height, contact)
            continue
        segment = _segment(m, tree, geom)
        capsule = m.geom_type[geom] == _CAPSULE
        axis = segment.half / np.linalg.norm(segment.half) if capsule else np.zeros(3)
        for side in (1, -1) if capsule else (0,):
            centre = segment.centre + side * segment.half
            yield Point(segment.body, segment.place, 0, centre, axis, segment.radius, height, contact)


def _corners(m: mujoco.MjModel, tree: _Tree, geom: int, height: float, contact: Contact) -> Iterator[Point]:
    """A box over a plane, in the order of `mjc_PlaneBox`."""
    b = int(m.geom_bodyid[geom])
    place = tree.places[b]
    middle, axes = place.position + place.rotation @ m.geom_pos[geom], place.rotation @ _matrix(m.geom_quat[geom])
    for k in range(CORNERS):
        offset = axes @ (m.geom_size[geom] * [1 if k >> x & 1 else -1 for x in range(3)])
        yield Point(place.body, b, k + 1, middle + offset, offset, 0.0, height, contact)


def _pairs(m: mujoco.MjModel, tree: _Tree) -> tuple[tuple[Segment, ...], tuple[Block, ...], tuple[Pair, ...]]:
    found = [pair for pair in collisions(m) if m.geom_type[pair[0]] != _PLANE]
    boxes = sorted({geom for pair in found for geom in pair if m.geom_type[geom] == _BOX})
    # A box comes first, where MuJoCo has it second: a pyramid's edges are the same from either side.
    found = [pair[::-1] if pair[1] in boxes and pair[0] not in boxes else pair for pair in found]
    count = {pair: (pair[0] in boxes) + (pair[1] in boxes) for pair in found}
    found.sort(key=lambda pair: (count[pair], boxes.index(pair[0]) if count[pair] else -1))
    geoms = sorted({geom for pair in found for geom in pair if geom not in boxes})
    segments = tuple(_segment(m, tree, geom) for geom in geoms)
    touching = {box: [segments[geoms.index(g)] for b, g in found if b == box and g not in boxes] for box in boxes}
    blocks = tuple(_block(m, tree, box, touching[box]) for box in boxes)
    pairs = []
    for pair in found:
        first, second = ((boxes if geom in boxes else geoms).index(geom) for geom in pair)
        bodies = [tree.places[m.geom_bodyid[geom]].body for geom in pair]
        chains = [set(tree.bodies[body].chain) if body >= 0 else set() for body in bodies]
        dofs = tuple(sorted(chains[0] ^ chains[1]))
        signs = tuple(1 if dof in chains[1] else -1 for dof in dofs)
        pairs.append(Pair(first, second, count[pair], bodies[0] < 0, dofs, signs, contact_of(m, *pair)))
    return segments, blocks, tuple(pairs)


def _block(m: mujoco.MjModel, tree: _Tree, geom: int, segments: list[Segment]) -> Block:
    b = int(m.geom_bodyid[geom])
    place = tree.places[b]
    axes = (place.rotation @ _matrix(m.geom_quat[geom])).T
    centre = place.position + place.rotation @ m.geom_pos[geom]
    reach = np.inf
    if place.body < 0:
        margin = float(m.geom_margin[geom] + m.geom_margin.max())
        reach = margin + max(tree.furthest(s.body) + _length(s.centre) + _length(s.half) + s.radius for s in segments)
    return Block(place.body, b, axes, axes @ centre, np.array(m.geom_size[geom]), 1.0001 * reach)


def _length(vector: np.ndarray) -> float:
    return float(np.linalg.norm(vector))


def _segment(m: mujoco.MjModel, tree: _Tree, geom: int) -> Segment:
    b = int(m.geom_bodyid[geom])
    place = tree.places[b]
    axes = place.rotation @ _matrix(m.geom_quat[geom])
    half = m.geom_size[geom, 1] if m.geom_type[geom] == _CAPSULE else 0.0
    centre = place.position + place.rotation @ m.geom_pos[geom]
    return Segment(place.body, b, centre, axes[:, 2] * half, axes[:, 0], float(m.geom_size[geom, 0]))


def _in_world(m: mujoco.MjModel, tree: _Tree, geom: int) -> np.ndarray:
    """[3], where a geom of the world is."""
    place = tree.places[m.geom_bodyid[geom]]
    return place.position + place.rotation @ m.geom_pos[geom]


def _matrix(quat: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, float))
    return out.reshape(3, 3)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, np.asarray(a, float), np.asarray(b, float))
    return out


# -- what cannot be stepped --


def obstacle(model: mujoco.MjModel, readout: Readout | None = None) -> str | None:
    """Why the fused step cannot do a model and its readouts, as the rest of a sentence; None if it can."""
    found = next(
        itertools.chain(_refused(model), _refused_contacts(model), _refused_readouts(model, readout or {})), None
    )
    return None if found is None else f"cannot step this model: {found}"


def _refused(m: mujoco.MjModel) -> Iterator[str]:
    """What a model has that the step lacks, the contacts aside."""
    sizes = {
        "ntendon": "tendons",
        "neq": "equality constraints",
        "nmocap": "mocap bodies",
        "na": "actuators with activations",
        "nflex": "flexible bodies",
        "nplugin": "plugins",
        "npair": "contacts of explicit pairs",
        "nhistory": "delays",
    }
    yield from (f"it has {what}" for size, what in sizes.items() if getattr(m, size))
    arrays = {
        "dof_frictionloss": "dry friction in joints",
        "body_gravcomp": "gravity compensation",
        "dof_dampingpoly": "polynomial damping",
        "jnt_stiffnesspoly": "polynomial stiffness",
        "jnt_actfrclimited": "limits on the motors' force in a joint",
        "geom_gap": "contact gaps",
        "geom_adhesion": "adhesion",
        "geom_surfacevel": "moving surfaces",
    }
    yield from (f"it has {what}" for array, what in arrays.items() if np.any(getattr(m, array, 0)))
    yield from _refused_options(m)
    yield from _refused_joints(m)
    yield from _refused_motors(m)


def _refused_options(m: mujoco.MjModel) -> Iterator[str]:
    opt = m.opt
    if int(opt.disableflags) & ~int(_HARMLESS) or int(opt.enableflags) or opt.disableactuator:
        yield "it sets MuJoCo's disable or enable flags"
    if int(opt.cone) != int(mujoco.mjtCone.mjCONE_PYRAMIDAL) or opt.impratio != 1:
        yield "it has elliptic friction cones, or impratio is not 1"
    if int(opt.solver) != int(mujoco.mjtSolver.mjSOL_NEWTON) or opt.noslip_iterations:
        yield "its solver is not Newton's"
    if int(opt.integrator) not in (_EULER, _RK4):
        yield "its integrator is neither Euler nor RK4"
    if np.any(opt.gravity[:2]) or np.any(opt.wind):
        yield "its gravity is not along z, or wind blows"
    if (opt.density or opt.viscosity) and np.any(m.geom_fluid[:, 0]):
        yield "it has ellipsoids in a fluid"


def _refused_joints(m: mujoco.MjModel) -> Iterator[str]:
    if not 0 < m.nv <= MOST_DOFS:
        yield f"it has {m.nv} degrees of freedom, and the step takes 1 to {MOST_DOFS}"
    for j in range(m.njnt):
        kind = m.jnt_type[j]
        if kind == _BALL:
            yield f"joint '{m.joint(j).name}' is a ball joint"
        if kind == _FREE and m.jnt_stiffness[j]:
            yield "it has a free joint with a spring"
        impedance = (m.jnt_solref[j], m.jnt_solimp[j])
        if m.jnt_limited[j] and (not _plain(*impedance) or np.ptp(m.jnt_range[j]) <= 2 * m.jnt_margin[j]):
            yield f"joint '{m.joint(j).name}' has unusual limits (solref, solimp, or both active at once)"


def _plain(solref: np.ndarray, solimp: np.ndarray) -> bool:
    """Whether solref has one of its two formats, and solimp the default's shape."""
    return bool((solref[0] > 0) == (solref[1] > 0) and solimp[3] == 0.5 and solimp[4] == 2)


def _refused_motors(m: mujoco.MjModel) -> Iterator[str]:
    at_site = m.actuator_trntype == _AT_SITE
    plain = (m.actuator_trntype == _AT_JOINT) | at_site & (m.actuator_trnid[:, 1] < 0)
    plain &= m.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
    plain &= np.isin(m.actuator_biastype, [int(x) for x in (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)])
    special = np.zeros(m.nu, bool)
    for array in ("actuator_damping", "actuator_dampingpoly", "actuator_armature"):
        values = np.asarray(getattr(m, array, np.zeros(m.nu)))
        special = special | (values.reshape(m.nu, -1) != 0).any(1) if m.nu else special
    for a in range(m.nu):
        name = m.actuator(a).name or a
        if not plain[a] or special[a] or m.nactuator != m.nu:
            yield f"actuator '{name}' is no motor, position or speed servo of a joint or at a site"
        elif not at_site[a] and m.jnt_type[m.actuator_trnid[a, 0]] not in (_SLIDE, _HINGE):
            yield f"actuator '{name}' drives a free joint"


def _refused_contacts(m: mujoco.MjModel) -> Iterator[str]:
    solids = (_SPHERE, _CAPSULE, _BOX)
    for g, h in collisions(m):
        names = " and ".join(f"'{m.geom(x).name or x}'" for x in (g, h))
        types = [int(m.geom_type[x]) for x in (g, h)]
        plane = types[0] == _PLANE
        if not (plane or types[0] in solids) or types[1] not in solids:
            kinds = " and ".join(mujoco.mjtGeom(t).name.removeprefix("mjGEOM_").lower() for t in types)
            yield f"geoms {names} may touch ({kinds}); it knows spheres, capsules and boxes, on planes and each other"
        if plane and not (m.body_weldid[m.geom_bodyid[g]] == 0 and _upright(m, g)):
            yield f"plane {names.split(' and ')[0]} moves or is not horizontal"
        _, _, solref, solimp = _mixed(m, g, h)
        if not _plain(solref, solimp):
            yield f"geoms {names} touch with an unusual solref or solimp"


def _upright(m: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom of the world has its z axis upwards."""
    rotation, body = _matrix(m.geom_quat[geom]), m.geom_bodyid[geom]
    while body:
        rotation, body = _matrix(m.body_quat[body]) @ rotation, m.body_parentid[body]
    return bool(np.allclose(rotation[:, 2], [0, 0, 1], atol=1e-12))


def _refused_readouts(m: mujoco.MjModel, readout: Readout) -> Iterator[str]:
    for name, (field, index) in readout.items():
        if field not in FIELDS:
            yield f"readout '{name}' is {field}; it knows {', '.join(FIELDS)}"
            continue
        rows = [] if field in _OF_DOFS else _reading(m, field, index).rows
        if field == "subtree_com" and not all(m.body_jntnum[row] for row in rows):
            yield f"readout '{name}' is the centre of mass of a body without joints"
        if field in ("cinert", "cfrc_ext") and any(row and not m.body_weldid[row] for row in rows):
            yield f"readout '{name}' is {field} of a body that nothing moves"
