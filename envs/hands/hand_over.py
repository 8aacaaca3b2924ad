"""ShadowHandOver of Safe Multi-Agent Isaac Gym (Gu et al., 2023) in MuJoCo: tasks `hand_over_2x6` and its variants.

Two Shadow hands, palms up, fingertips 3 cm apart. An object starts over the knuckles of hand 0 and should come to a
goal over those of hand 1, a quarter of a metre away, so it must be thrown and caught. What costs is one motor of the
throwing hand's index finger: the cost is a function of the action alone, which only the next state contains.

| task                    | agents x parts of a hand    | action entries of agent 0 that cost | beyond |
|-------------------------|-----------------------------|-------------------------------------|--------|
| `hand_over_2x6`         | 2: one hand each            | 4 (FFJ1, the index's middle joint)  | 0.1    |
| `hand_over_4x3`         | 4: half a hand each         | 4                                   | 0.1    |
| `hand_over_safe_joint`  | as 2x6                      | 4                                   | 0.5    |
| `hand_over_safe_finger` | as 2x6                      | any of 2, 3, 4 (FFJ3, FFJ2, FFJ1)   | 0.5    |

Written from the facts of the public reference task; `docs/tasks/hand_over.md` lists what differs from Isaac Gym.

Examples:
  >>> import jax, envs
  >>> env = envs.make("hand_over_2x6")
  >>> state = jax.jit(env.reset)(jax.random.key(0))
  >>> state = jax.jit(env.step)(state, jax.numpy.zeros((2, 20)))
  >>> state.obs.shape, state.global_state.shape
  ((2, 211), (398,))
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ..base import Declarations, EnvSpec, Scene, State
from ..blocks import Block, Blocks, length, motors
from ..errors import TaskError, one_of, typed
from ..physics import PhysicsState, kernels_of, make_engine, resolve

MODEL = Path(__file__).parent / "hand_over.xml"
SUBSTEPS = 2  # integration steps of 1/120 s in a control step
HORIZON = 75  # control steps of 1/60 s
COST_LIMIT = 2.5  # the benchmark's bound on an episode's summed cost

HANDS, JOINTS, MOTORS = 2, 24, 20
HINGES = HANDS * JOINTS  # the first entries of qpos and qvel; then comes the object's free joint
FINGERS = ("ff", "mf", "rf", "lf", "th")
HALF_HAND = 8  # motors of wrist, first and middle finger, which are agent 0's (and 2's) of four

START = (0.0, -0.39, 0.54)  # m, the object's centre
GOAL = (0.0, -0.64, 0.54)
RESET_NOISE = 0.01  # m, half-width of the uniform noise on the object's start
RESET_SPREAD = 0.2  # share of the joints' ranges that they start in
FALLEN = 0.2  # m, height of the object's centre from which the episode ends

VELOCITY_SCALE, FORCE_SCALE = 0.2, 10.0  # of joint and spin velocities, of forces and torques in observations
OBS_BOUND = 5.0

HAND = (  # what a hand's own agents see of it; `_get_obs` has the same order
    Block("joint angles", JOINTS, "-", "place in the joint's range, -1 to 1"),
    Block("joint velocities", JOINTS, "5 rad/s"),
    Block("joint forces", JOINTS, "0.1 N m", "motor and constraints, without damping"),
    Block("fingertip frames", 13 * len(FINGERS), "m, -, m/s, rad/s", "place, quaternion (w last), velocity, spin"),
    Block("fingertip wrenches", 6 * len(FINGERS), "0.1 N, 0.1 N m", "force and torque on each, in its frame"),
    Block("last action", MOTORS, "-", "after clipping"),
)
SHARED = (  # what all agents see
    Block("object place", 3, "m"),
    Block("object orientation", 4, "-", "quaternion, w last"),
    Block("object velocity", 3, "m/s"),
    Block("object spin", 3, "5 rad/s", "world frame"),
    Block("goal place", 3, "m"),
    Block("goal orientation", 4, "-", "quaternion, w last"),
    Block("turn from the goal", 4, "-", "object orientation times inverse goal orientation, w last"),
)

# name -> number of agents, costly entries of the joint action, largest absolute value that is free
VARIANTS: dict[str, tuple[int, tuple[int, ...], float]] = {
    "2x6": (2, (4,), 0.1),
    "4x3": (4, (4,), 0.1),
    "safe_joint": (2, (4,), 0.5),
    "safe_finger": (2, (2, 3, 4), 0.5),
}

_GEOM = mujoco.mjtGeom
OBJECTS: dict[str, dict[str, Any]] = {
    "egg": {"type": _GEOM.mjGEOM_ELLIPSOID, "size": (0.03, 0.03, 0.04), "density": 500.0},
    "block": {"type": _GEOM.mjGEOM_BOX, "size": (0.025, 0.025, 0.025), "density": 567.0},
    "pen": {"type": _GEOM.mjGEOM_CAPSULE, "size": (0.008, 0.1, 0.0), "density": 500.0},
}
EGG_CAPSULE = {"type": _GEOM.mjGEOM_CAPSULE, "size": (0.03, 0.01, 0.0), "mass": 0.0, "group": 3}
FRICTION = (1.0, 0.005, 0.001)  # sliding, turning, rolling
SELF_CONTACTS = (
    *((name, "thdistal") for name in ("ffdistal", "ffmiddle", "ffproximal", "mfdistal", "mfproximal", "rfdistal")),
    *((name, "thdistal") for name in ("lfdistal", "palm_ff", "palm_mf", "palm_rf")),
    *(("ffdistal", "mfdistal"), ("mfdistal", "rfdistal"), ("rfdistal", "lfdistal"), ("mfdistal", "lfdistal")),
    *(("ffproximal", "mfproximal"), ("mfproximal", "rfproximal"), ("rfproximal", "lfproximal")),
    *(("rfmiddle", "lfdistal"), ("rfdistal", "lfmiddle"), ("rfmiddle", "lfmiddle")),
)
DRY_FRICTION = {"wrist": 0.005, "fingers": 0.001}  # N m

HAND_COLOURS = ((0.36, 0.48, 0.62, 1.0), (0.80, 0.62, 0.42, 1.0))
OBJECT_COLOUR = (0.97, 0.95, 0.88, 1.0)
GHOST_COLOUR = (0.35, 0.75, 0.45, 0.35)
COST_COLOUR = (0.90, 0.16, 0.12, 1.0)
CONSTRAINED = ("h0_ffproximal", "h0_ffmiddle", "h0_ffdistal")  # the geoms that turn red when it costs


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Carry:
    """The state between control steps.

    Attributes:
      physics: the engine's state.
      goal_quat: [4] w first, the orientation the object should take.
      last_action: [40] both hands' clamped actions of the last step, 0 after a reset.
      joint_force: [48] N m, what motors and constraints did to each joint in the last integration step.
      touch: [2, 5, 6] N and N m, force and torque on each fingertip in the last integration step, see `_wrenches`.
    """

    physics: PhysicsState
    goal_quat: jax.Array
    last_action: jax.Array
    joint_force: jax.Array
    touch: jax.Array


@functools.cache
def model(object: str = "egg", capsule: bool = False, full_hand: bool = False) -> mujoco.MjModel:
    """The compiled scene; engines copy it.

    Args:
      object: one of `OBJECTS`.
      capsule: the egg touches as a capsule; it looks and weighs the same.
      full_hand: with contacts inside a hand and dry friction in its joints.
    """
    spec = mujoco.MjSpec.from_file(str(MODEL))
    shape = {**OBJECTS[object], "friction": FRICTION, "rgba": OBJECT_COLOUR}
    touches = int(not (capsule and object == "egg"))
    spec.body("object").add_geom(name="object", contype=touches, conaffinity=touches, **shape)
    if not touches:
        spec.body("object").add_geom(friction=FRICTION, **EGG_CAPSULE)
    for hand, colour in enumerate(HAND_COLOURS):
        for geom in spec.geoms:
            if geom.name.startswith(f"h{hand}_"):
                geom.rgba = colour
        for first, second in SELF_CONTACTS if full_hand else ():
            spec.add_pair(geomname1=f"h{hand}_{first}", geomname2=f"h{hand}_{second}", condim=1)
    for joint in spec.joints if full_hand else ():
        if joint.name != "object":
            joint.frictionloss = DRY_FRICTION["wrist" if "WR" in joint.name else "fingers"]
    return spec.compile()


class HandOver:
    """See the module; agents share reward and cost, an agent observes its own hand, the object and the goal.

    Args:
      variant: one of `VARIANTS`.
      object: `egg`, `block` or `pen`.
      egg: its shape in contacts, `ellipsoid` or `capsule` (it looks and weighs the same); `auto` takes the ellipsoid
        but on `mjx`, where it takes twice the time and is 0.3 mm a step away from the other engines.
      full_hand: adds the 20 contacts inside each hand (fingers, thumb, palm) and the dry friction of its joints.
      physics: `auto`, `mujoco`, `mjx` or `warp`; see `envs.physics`.
      threads: of the `mujoco` engine, which the devices of a process share; all usable CPUs if None.
    """

    shares_cost = True

    @typed
    def __init__(
        self,
        variant: str = "2x6",
        *,
        object: str = "egg",
        egg: str = "auto",
        full_hand: bool = False,
        physics: str = "auto",
        threads: int | None = None,
    ):
        num_agents, self._costly, self._free = VARIANTS[one_of("variant", variant, VARIANTS)]
        one_of("egg", egg, ("auto", "ellipsoid", "capsule"))
        if one_of("object", object, OBJECTS) != "egg" and egg != "auto":
            raise TaskError(f"egg is the shape of an egg, but the object is a {object}; leave egg out")
        physics = resolve(physics, model(object, egg == "capsule", full_hand))
        capsule = egg == "capsule" or (egg == "auto" and physics == "mjx")
        self.model = model(object, capsule, full_hand)
        hinges = slice(0, HINGES)
        self._engine = make_engine(
            self.model,
            substeps=SUBSTEPS,
            readout={
                "motor": ("qfrc_actuator", hinges),
                "constraint": ("qfrc_constraint", hinges),
                "sensors": ("sensordata", slice(None)),
            },
            physics=physics,
            threads=threads,
        )
        self.engine = self._engine.name
        self._joint_range = self.model.jnt_range[:HINGES]  # [48, 2] rad
        self._motor_range = self.model.actuator_ctrlrange  # [40, 2] rad
        self._chains = _chains(self.model)
        mask = _action_mask(num_agents)
        self.declares = Declarations(
            observation=(*HAND, *SHARED),
            state=(*_of_hand(0), *_of_hand(1), *SHARED),
            actions=_motors(self.model, mask),
            picture=Scene(self.raw, self.model, self.decorate),
            overflow="physics_overflow",
            kernels=functools.partial(kernels_of, self._engine),
        )
        self.spec = EnvSpec(
            name=f"hand_over_{variant}",
            num_agents=num_agents,
            obs_dim=length(self.declares.observation),
            action_dim=mask.shape[1],
            state_dim=length(self.declares.state),
            num_costs=1,
            horizon=HORIZON,
            action_mask=mask,
            cost_limit=COST_LIMIT,
        )

    def reset(self, key: jax.Array) -> State:
        """The object over hand 0, turned at random; both hands in the same random pose, which may exceed its limits."""
        place_key, turn_key, pose_key, goal_key = jax.random.split(key, 4)
        start = self._engine.start()
        dtype = start.qpos.dtype

        def draw(key: jax.Array, size: int) -> jax.Array:
            return jax.random.uniform(key, (size,), dtype, -1.0, 1.0)

        low, high = self._joint_range[:JOINTS].T
        pose = RESET_SPREAD * (low + (high - low) * draw(pose_key, JOINTS))
        place = jnp.asarray(START, dtype) + RESET_NOISE * draw(place_key, 3)
        qpos = jnp.concatenate([pose, pose, place, _random_turn(draw(turn_key, 2))])
        return self.restore(qpos, start.qvel, _random_turn(draw(goal_key, 2)), jnp.zeros(HANDS * MOTORS, dtype))

    def step(self, state: State, action: jax.Array) -> State:
        """One control step of 1/60 s with `action` [N, A], clamped to [-1, 1]: the motors' targets in their ranges."""
        before: Carry = state.carry
        mask = self.spec.action_mask.astype(bool)
        joint_action = jnp.clip(jnp.asarray(action, before.last_action.dtype)[mask], -1.0, 1.0)  # agents in order
        low, high = self._motor_range.T
        physics, out = self._engine.step(before.physics, low + 0.5 * (joint_action + 1.0) * (high - low))
        tips = _fingertips(self._chains, physics)
        joint_force, touch = out["motor"] + out["constraint"], self._wrenches(out["sensors"], tips)
        carry = Carry(physics, before.goal_quat, joint_action, joint_force, touch)
        cost = self.cost_of(joint_action)
        outcome = self.reward_of(carry), cost, self.ends(physics)
        return self._state(carry, tips, *outcome, out["overflow"])

    def restore(
        self,
        qpos: Any,
        qvel: Any,
        goal_quat: Any,
        last_action: Any,
        warmstart: Any = None,
        joint_force: Any = None,
        touch: Any = None,
    ) -> State:
        """A State from MuJoCo's quantities, as if no transition had led to it.

        Args:
          qpos: [55] joint angles of hand 0 and hand 1 (24 each), the object's position and unit quaternion (w first).
          qvel: [54] joint velocities, the object's velocity (world frame) and spin (its own frame).
          goal_quat: [4] w first.
          last_action: [40].
          warmstart: [54] `qacc_warmstart`; joint_force: [48], touch: [2, 5, 6], see `Carry`. Zero if None.
        """
        start = self._engine.start()
        array = functools.partial(jnp.asarray, dtype=start.qpos.dtype)
        zeros = functools.partial(jnp.zeros, dtype=start.qpos.dtype)
        warmstart = start.warmstart if warmstart is None else array(warmstart)
        joint_force = zeros(HINGES) if joint_force is None else array(joint_force)
        touch = zeros((HANDS, len(FINGERS), 6)) if touch is None else array(touch)
        physics = PhysicsState(array(qpos), array(qvel), warmstart)
        carry = Carry(physics, array(goal_quat), array(last_action), joint_force, touch)
        cost = zeros((self.spec.num_agents, 1))
        outcome = zeros(()), cost, jnp.zeros((), bool)
        return self._state(carry, _fingertips(self._chains, physics), *outcome, zeros(()))

    def raw(self, state: State) -> dict[str, jax.Array]:
        """What `restore` takes."""
        carry: Carry = state.carry
        rest = {name: getattr(carry, name) for name in ("goal_quat", "last_action", "joint_force", "touch")}
        return {**vars(carry.physics), **rest}

    def decorate(self, scene: mujoco.MjvScene, raw: Mapping[str, np.ndarray], cost: float) -> None:
        """Adds the ghost of the goal to a scene made from `raw`, and reddens the index finger of hand 0 if it costs.

        Args:
          scene: already updated from an mjData of `model`.
          raw: what `raw` returned, as NumPy arrays; only the goal is read.
          cost: of one agent, for the step that led here.
        """
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.asarray(raw["goal_quat"], np.float64))
        geom = self.model.geom("object")
        ghost = scene.geoms[scene.ngeom]
        scene.ngeom += 1
        mujoco.mjv_initGeom(
            ghost, int(geom.type[0]), geom.size, np.array(GOAL), turn, np.array(GHOST_COLOUR, np.float32)
        )
        for drawn in scene.geoms[: scene.ngeom] if cost > 0 else ():
            is_geom = drawn.objtype == mujoco.mjtObj.mjOBJ_GEOM
            if is_geom and self.model.geom(drawn.objid).name in CONSTRAINED:
                drawn.rgba = np.array(COST_COLOUR, np.float32)

    def _state(
        self,
        carry: Carry,
        tips: jax.Array,
        reward: jax.Array,
        cost: jax.Array,
        terminated: jax.Array,
        overflow: jax.Array,
    ) -> State:
        obs, global_state = self._get_obs(carry, tips)
        distance, angle = _goal_errors(carry)
        info = {"distance": distance, "angle": angle, "physics_overflow": overflow}
        return State(obs, global_state, reward, cost, terminated, info, carry)

    def _get_obs(self, carry: Carry, tips: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Observations [N, 211] and the state [398]; an agent's has its own hand's part only.

        A hand [187]: joint positions in their ranges, velocities and forces [24 each], each fingertip's frame [13] and
        wrench [6], last action [20]. Then for all: object [13], and goal and how far the object is turned from it [11].
        """
        physics = carry.physics
        low, high = self._joint_range.T
        angles, speeds = physics.qpos[:HINGES], physics.qvel[:HINGES]
        parts = [
            (2.0 * angles - high - low) / (high - low),
            VELOCITY_SCALE * speeds,
            FORCE_SCALE * carry.joint_force,
            _isaac_frame(tips),
            FORCE_SCALE * carry.touch,
            carry.last_action,
        ]
        hands = jnp.concatenate([part.reshape(HANDS, -1) for part in parts], axis=1)
        place, turn = physics.qpos[HINGES : HINGES + 3], physics.qpos[HINGES + 3 :]
        spin = VELOCITY_SCALE * _rotate(turn, physics.qvel[HINGES + 3 :])
        thing = _isaac_frame(jnp.concatenate([place, turn, physics.qvel[HINGES : HINGES + 3], spin]))
        error = _multiply(turn, _conjugate(carry.goal_quat))
        goal = jnp.concatenate([jnp.asarray(GOAL, place.dtype), _xyzw(carry.goal_quat), _xyzw(error)])
        bounded = functools.partial(jnp.clip, min=-OBS_BOUND, max=OBS_BOUND)
        hands, shared = bounded(hands), bounded(jnp.concatenate([thing, goal]))
        own = jnp.repeat(hands, self.spec.num_agents // HANDS, axis=0)
        obs = jnp.concatenate([own, jnp.broadcast_to(shared, (len(own), *shared.shape))], axis=1)
        return obs, jnp.concatenate([hands.reshape(-1), shared])

    def _wrenches(self, sensors: jax.Array, tips: jax.Array) -> jax.Array:
        """Force and torque [2, 5, 6] on the distal links in their frames, from the sensors' [60] readings.

        A reading is what the middle link holds the distal one with. Its opposite less the weight, which gravity
        compensation carries, is what contacts do to the distal link, less its own inertia.
        """
        bodies = [[self.model.body(f"h{hand}_{name}distal").id for name in FINGERS] for hand in range(HANDS)]
        weight = self.model.body_mass[bodies][..., None] * self.model.opt.gravity  # N, [2, 5, 3]
        force = _rotate(_conjugate(tips[..., 3:7]), jnp.asarray(weight, sensors.dtype))
        torque = jnp.cross(jnp.asarray(self.model.body_ipos[bodies], sensors.dtype), force)
        return -(sensors.reshape(HANDS, len(FINGERS), 6) + jnp.concatenate([force, torque], axis=-1))

    def reward_of(self, carry: Carry) -> jax.Array:
        """[] in (0, 1]: exp(-10 d - 0.2 theta), the object being d (m) away from the goal and turned by theta (rad)."""
        distance, angle = _goal_errors(carry)
        return jnp.exp(-10.0 * distance - 0.2 * angle)

    def cost_of(self, joint_action: jax.Array) -> jax.Array:
        """[N, 1]: 1 where a costly entry of the clamped action [40] is beyond its bound, whatever the hands then do."""
        costly = (jnp.abs(joint_action[np.array(self._costly)]) > self._free).any()
        return jnp.full((self.spec.num_agents, 1), costly.astype(joint_action.dtype))

    def ends(self, physics: PhysicsState) -> jax.Array:
        """Whether the object fell, or the physics broke."""
        sound = jnp.isfinite(physics.qpos).all() & jnp.isfinite(physics.qvel).all()
        return ~(sound & (physics.qpos[HINGES + 2] > FALLEN))


def _of_hand(number: int) -> Blocks:
    return tuple(block._replace(name=f"hand {number} {block.name}") for block in HAND)


def _motors(model: mujoco.MjModel, mask: np.ndarray) -> tuple[tuple[str, ...], ...]:
    """Each agent's motors; agents fill the actuators in order."""
    names = iter(motors(model))
    return tuple(tuple(next(names) for _ in range(int(own))) for own in mask.sum(axis=1))


def _action_mask(num_agents: int) -> np.ndarray:
    """[N, A]: a hand's 20 motors are one agent's, or 8 and 12 are two agents'."""
    sizes = [MOTORS] * HANDS if num_agents == HANDS else [HALF_HAND, MOTORS - HALF_HAND] * HANDS
    return (np.arange(max(sizes)) < np.array(sizes)[:, None]).astype(np.float32)


def _random_turn(u: jax.Array) -> jax.Array:
    """The turn by pi u[1] about y, then pi u[0] about x, as a quaternion [4]."""
    half = 0.5 * jnp.pi * u
    cos, sin = jnp.cos(half), jnp.sin(half)
    zero = jnp.zeros_like(half[0])
    return _multiply(jnp.stack([cos[0], sin[0], zero, zero]), jnp.stack([cos[1], zero, sin[1], zero]))


def _goal_errors(carry: Carry) -> tuple[jax.Array, jax.Array]:
    """Distance (m) and angle (rad, 0 to pi) of the object from the goal."""
    qpos = carry.physics.qpos
    distance = jnp.linalg.norm(qpos[HINGES : HINGES + 3] - jnp.asarray(GOAL, qpos.dtype))
    error = _multiply(qpos[HINGES + 3 :], _conjugate(carry.goal_quat))
    return distance, 2.0 * jnp.arcsin(jnp.minimum(jnp.linalg.norm(error[1:]), 1.0))


# Quaternions [..., 4] have w first, as MuJoCo's.


def _multiply(p: jax.Array, q: jax.Array) -> jax.Array:
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    scalar = pw * qw - jnp.sum(pv * qv, axis=-1, keepdims=True)
    return jnp.concatenate([scalar, pw * qv + qw * pv + jnp.cross(pv, qv)], axis=-1)


def _conjugate(q: jax.Array) -> jax.Array:
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def _rotate(q: jax.Array, v: jax.Array) -> jax.Array:
    twice = 2.0 * jnp.cross(q[..., 1:], v)
    return v + q[..., :1] * twice + jnp.cross(q[..., 1:], twice)


def _xyzw(q: jax.Array) -> jax.Array:
    """As Isaac Gym orders it."""
    return jnp.roll(q, -1, axis=-1)


def _isaac_frame(frame: jax.Array) -> jax.Array:
    """A frame [..., 13] of position, quaternion, velocity and spin with the quaternion in Isaac Gym's order."""
    return jnp.concatenate([frame[..., :3], _xyzw(frame[..., 3:7]), frame[..., 7:]], axis=-1)


@dataclasses.dataclass(frozen=True)
class _Links:
    """Bodies one below the other, side by side for several hands or fingers: arrays [level, ...].

    offset, turn: of a body in its parent; axis: of its hinge in its own frame (0 if it has none); dof: the hinge's.
    """

    offset: np.ndarray
    turn: np.ndarray
    axis: np.ndarray
    dof: np.ndarray


def _chains(model: mujoco.MjModel) -> tuple[_Links, _Links]:
    """The bodies from the world to the palms [level, hand], and on to the fingertips [level, hand, finger], where
    shorter fingers begin with a body that stays where it is."""
    palms = [_ancestry(model, model.body(f"h{hand}_palm").id) for hand in range(HANDS)]
    tips = [
        [_ancestry(model, model.body(f"h{hand}_{name}distal").id)[len(palms[hand]) :] for name in FINGERS]
        for hand in range(HANDS)
    ]
    longest = max(len(tip) for hand in tips for tip in hand)
    padded = [[[0] * (longest - len(tip)) + tip for tip in hand] for hand in tips]  # the world has no offset
    return _links(model, np.moveaxis(np.array(palms), -1, 0)), _links(model, np.moveaxis(np.array(padded), -1, 0))


def _ancestry(model: mujoco.MjModel, body: int) -> list[int]:
    """The bodies from the world's child to `body`."""
    return [*_ancestry(model, int(model.body_parentid[body])), body] if body else []


def _links(model: mujoco.MjModel, bodies: np.ndarray) -> _Links:
    hinged, joint = model.body_jntnum[bodies] > 0, np.maximum(model.body_jntadr[bodies], 0)
    axis = np.where(hinged[..., None], model.jnt_axis[joint], 0.0)
    return _Links(model.body_pos[bodies], model.body_quat[bodies], axis, model.jnt_dofadr[joint])


_Frame = tuple[jax.Array, ...]  # place, quaternion, velocity and spin in the world


def _fingertips(chains: tuple[_Links, _Links], physics: PhysicsState) -> jax.Array:
    """Frames [2, 5, 13] of the distal links at their joints: position, quaternion, velocity and spin, world frame.

    Engines leave these a substep behind qpos; here they belong to it, also in a state that no step led to.
    """
    palms, fingers = chains
    nothing = jnp.zeros((HANDS, 3), physics.qpos.dtype)
    world = nothing, jnp.zeros((HANDS, 4), nothing.dtype).at[:, 0].set(1.0), nothing, nothing
    palm = (jnp.repeat(x[:, None], len(FINGERS), axis=1) for x in _descend(palms, physics, world))
    return jnp.concatenate(_descend(fingers, physics, tuple(palm)), axis=-1)


def _descend(links: _Links, physics: PhysicsState, base: _Frame) -> _Frame:
    """The last links' frames, from that of what the first are fixed to."""
    offset, rest, axis = (jnp.asarray(x, physics.qpos.dtype) for x in (links.offset, links.turn, links.axis))
    hinged = np.any(links.axis != 0, axis=-1)
    half = jnp.where(hinged, 0.5 * physics.qpos[links.dof], 0.0)[..., None]
    half_turned = _multiply(rest, jnp.concatenate([jnp.zeros_like(axis[..., :1]), axis], axis=-1))
    bent = jnp.cos(half) * rest + jnp.sin(half) * half_turned
    bending = physics.qvel[links.dof][..., None] * _rotate(rest, axis)

    def down(frame: _Frame, link: tuple[jax.Array, ...]) -> tuple[_Frame, None]:
        place, turn, velocity, spin = frame
        offset, bent, bending = link
        arm = _rotate(turn, offset)
        velocity = velocity + jnp.cross(spin, arm)
        return (place + arm, _multiply(turn, bent), velocity, spin + _rotate(turn, bending)), None

    return jax.lax.scan(down, base, (offset, bent, bending))[0]
