"""The ant in the zig-zag corridor of Safe Multi-Agent MuJoCo (Gu et al., 2023): tasks `ant_2x4` and `ant_4x2`.

One ant of eight motors, shared out among 2 or 4 agents, runs along +x between two walls that zig-zag by 30 degrees.
Written from the facts of the public reference code and checked against transitions recorded from it. Where paper and
code differ, the task follows the code.

Examples:
  >>> import jax, envs
  >>> env = envs.make("ant_2x4")
  >>> state = jax.jit(env.reset)(jax.random.key(0))
  >>> state = jax.jit(env.step)(state, jax.numpy.zeros((2, 4)))
  >>> state.obs.shape, state.cost.shape
  ((2, 31), (2, 1))
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ..base import Declarations, EnvSpec, Scene, State
from ..blocks import Block, agent_index, joints, length, motors
from ..errors import TaskError, one_of, typed
from ..partition import evenly, parse
from ..physics import PhysicsState, kernels_of, make_engine
from .walls import DANGER, FOLDS, HALF_WIDTH, SLOPE, WALLS, model

SUBSTEPS = 5  # integration steps of 0.01 s in a control step
CONTROL_DT = 0.05  # s
HORIZON = 1000  # control steps
COST_LIMIT = 10.0  # the benchmark's bound on an episode's summed cost

RESET_POSITION_NOISE = 0.1  # half-width of the uniform noise on every component of qpos, quaternion included
RESET_VELOCITY_NOISE = 0.1  # standard deviation of the normal noise on qvel

CONTROL_COST = 0.5
CONTACT_COST = 0.5e-3
SURVIVAL = 1.0
HEIGHT = (0.2, 1.0)  # m, of the torso
LEAST_UPRIGHT = -0.7  # cosine of the torso's tilt, 134 degrees

PLACE = (
    Block("place along x", 1, "5 m"),
    Block("place off centre", 1, "m", "along y from the corridor's centre line"),
)

SWAY = ("none", "seen", "hidden")
SWAY_REACH = 1.0  # m along y, how far the corridor moves to either side
SWAY_RATE = 2.0 * np.pi / 10.0  # rad/s: a period in 10 s
LINE = Block("velocity of the centre line", 1, "m/s", "along y")

COSTLY_ANT = (0.86, 0.16, 0.12, 1.0)  # what a picture shows at the moment of cost: the ant in red,
COSTLY_BAND = 0.36  # and the danger bands less transparent


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Carry:
    """The state between control steps.

    Attributes:
      physics: the engine's state.
      torso_xpos: [3] m, where the integrator's last stage saw the torso; the next forward reward starts from it.
      phase: [] rad, of a corridor that sways; None of one that does not.
    """

    physics: PhysicsState
    torso_xpos: jax.Array
    phase: jax.Array | None = None


class AntCorridor:
    """See the module; agents share reward, cost and (up to their own index) observation.

    Args:
      num_agents: 2 (four motors each: the two legs in front, the two behind) or 4 (one leg each: legs 4, 1, 2, 3). The
        order is the one that the reference code effectively uses, not the one its partition table declares.
      partition: another division of the eight motors in place of `num_agents`, agents apart by `|`: `0,1,2,3,4,5|6,7`.
      physics: `auto`, `fused`, `mujoco`, `mjx` or `warp`; see `envs.physics`.
      observation: `zscore` (each vector standardised over its own entries, as the reference does) or `raw` (for
        learners that keep running moments).
      walls: `reference` (massless, so they do not block, and 1.8 m behind them nothing costs), `costly` (they do not
        block, but everything outside costs) or `solid` (they block torso and feet; no gaps).
      sway: `none`, or the corridor moves along y by 1 m x sin(phase), a period in 10 s from a random phase: danger that
        is not where it was. `seen`: observations measure the place from where the centre line is now, and hold its
        velocity. `hidden`: they measure it from where the line is on average.
      threads: of `fused` and `mujoco`, which the devices of a process share; all usable CPUs if None.
    """

    shares_cost = True

    @typed
    def __init__(
        self,
        num_agents: int = 2,
        *,
        partition: str = "",
        physics: str = "auto",
        observation: str = "zscore",
        walls: str = "reference",
        sway: str = "none",
        threads: int | None = None,
    ):
        one_of("num_agents", str(num_agents), ("2", "4"))
        self._standardise = one_of("observation", observation, ("zscore", "raw")) == "zscore"
        self.walls = one_of("walls", walls, WALLS)
        self.sway = one_of("sway", sway, SWAY)
        if sway != "none" and walls == "solid":
            raise TaskError(
                f"sway = {sway} moves the walls, and solid walls do not move; take walls = reference or costly"
            )
        torso = model().body("torso").id
        self._engine = make_engine(
            self.model,
            substeps=SUBSTEPS,
            readout={
                "torso_xpos": ("xpos", torso),
                "torso_xquat": ("xquat", torso),
                "contact_force": ("cfrc_ext", slice(model().nbody)),  # of the ant; solid walls are bodies too
            },
            physics=physics,
            threads=threads,
        )
        self.engine = self._engine.name
        count = self.model.nu
        self._partition = parse(partition, count) if partition else evenly(num_agents, count)
        num_agents, action_dim = self._partition.mask.shape
        seen = (*joints(self.model, unseen=2), *PLACE, *((LINE,) if sway == "seen" else ()))
        names = motors(self.model)
        self.declares = Declarations(
            observation=(*seen, agent_index(num_agents)),
            state=seen,
            actions=tuple(tuple(names[motor] for motor in group) for group in self._partition.groups),
            picture=Scene(self.raw, self.model, self.decorate),
            overflow="physics_overflow",
            kernels=functools.partial(kernels_of, self._engine),
        )
        self.spec = EnvSpec(
            name=f"ant_{self._partition.name}",
            num_agents=num_agents,
            obs_dim=length(self.declares.observation),
            action_dim=action_dim,
            state_dim=length(seen),
            num_costs=1,
            horizon=HORIZON,
            action_mask=self._partition.mask,
            cost_limit=COST_LIMIT,
        )

    def reset(self, key: jax.Array) -> State:
        """The ant near its reference pose at the corridor's start; the ankles begin outside their limits."""
        position_key, velocity_key = jax.random.split(key)
        start = self._engine.start()
        qpos = start.qpos + jax.random.uniform(
            position_key, start.qpos.shape, start.qpos.dtype, -RESET_POSITION_NOISE, RESET_POSITION_NOISE
        )
        qvel = RESET_VELOCITY_NOISE * jax.random.normal(velocity_key, start.qvel.shape, start.qvel.dtype)
        quaternion = qpos[3:7] / jnp.linalg.norm(qpos[3:7])
        phase = None
        if self.sway != "none":
            phase = jax.random.uniform(jax.random.fold_in(key, 2), (), qpos.dtype, 0.0, 2.0 * jnp.pi)
        physics = PhysicsState(qpos.at[3:7].set(quaternion), qvel, start.warmstart)
        return self._initial_state(Carry(physics, qpos[:3], phase))

    def step(self, state: State, action: jax.Array) -> State:
        """One control step of 0.05 s with `action` [N, A]; the motors saturate at 1, the control cost does not."""
        carry: Carry = state.carry
        ctrl = self._partition.join(jnp.asarray(action, carry.torso_xpos.dtype))
        after, out = self._engine.step(carry.physics, ctrl)
        reward, reward_parts = self._get_reward(carry.torso_xpos, out["torso_xpos"], ctrl, out["contact_force"])
        terminated = self._get_termination(after, out["torso_xquat"])
        phase = None if carry.phase is None else (carry.phase + SWAY_RATE * CONTROL_DT) % (2.0 * jnp.pi)
        place = _relative(out["torso_xpos"], phase)
        cost, cost_parts = self._get_cost(place, terminated)
        obs, global_state = self._get_obs(after, phase)
        info = reward_parts | cost_parts | _location(place) | {"physics_overflow": out["overflow"]}
        return State(obs, global_state, reward, cost, terminated, info, Carry(after, out["torso_xpos"], phase))

    def restore(self, qpos: Any, qvel: Any, warmstart: Any = None, torso_xpos: Any = None, phase: Any = None) -> State:
        """A State from MuJoCo's quantities.

        Args:
          qpos: [15] position, quaternion (w first; normalised if it is not), joint angles.
          qvel: [14] velocities.
          warmstart: [14] `qacc_warmstart`; zero if None.
          torso_xpos: [3] where the last control step left the torso's `xpos`; qpos[:3] if None.
          phase: [] rad, of a corridor that sways; 0 if None.
        """
        start = self._engine.start()
        dtype = start.qpos.dtype
        qpos, qvel = jnp.asarray(qpos, dtype), jnp.asarray(qvel, dtype)
        warmstart = start.warmstart if warmstart is None else jnp.asarray(warmstart, dtype)
        torso_xpos = qpos[:3] if torso_xpos is None else jnp.asarray(torso_xpos, dtype)
        # A unit quaternion is left alone to the last bit, so that `raw` and `restore` are inverses.
        norm = jnp.linalg.norm(qpos[3:7])
        quaternion = jnp.where(jnp.abs(norm - 1.0) > 1e-5, qpos[3:7] / norm, qpos[3:7])
        phase = None if self.sway == "none" else jnp.asarray(0.0 if phase is None else phase, dtype)
        return self._initial_state(
            Carry(PhysicsState(qpos.at[3:7].set(quaternion), qvel, warmstart), torso_xpos, phase)
        )

    def raw(self, state: State) -> dict[str, jax.Array]:
        """What `restore` takes."""
        carry: Carry = state.carry
        return {
            "qpos": carry.physics.qpos,
            "qvel": carry.physics.qvel,
            "warmstart": carry.physics.warmstart,
            "torso_xpos": carry.torso_xpos,
            **({} if carry.phase is None else {"phase": carry.phase}),
        }

    @property
    def model(self) -> mujoco.MjModel:
        """What pictures are drawn from; its geoms include the walls and the danger bands."""
        return model(self.walls)

    def decorate(self, scene: mujoco.MjvScene, raw: dict[str, np.ndarray], cost: float) -> None:
        """Shows the moment of cost in a scene of `model`: a red ant, and bands that glow; see `envs.base`.

        Walls and bands of a corridor that sways are drawn where they are.
        """
        aside = SWAY_REACH * np.sin(raw["phase"]) if self.sway != "none" else 0.0
        for geom in scene.geoms[: scene.ngeom]:
            moving = geom.category == mujoco.mjtCatBit.mjCAT_DYNAMIC
            name = "" if moving else self.model.geom(geom.objid).name
            if name.startswith(("danger", "wall")):
                geom.pos[1] += aside
            if cost > 0 and moving:
                geom.rgba[:] = COSTLY_ANT
            if cost > 0 and name.startswith("danger"):
                geom.rgba[3] = COSTLY_BAND

    def _initial_state(self, carry: Carry) -> State:
        """A State that no transition led to."""
        obs, global_state = self._get_obs(carry.physics, carry.phase)
        zero = jnp.zeros((), carry.torso_xpos.dtype)
        names = ("forward", "ctrl", "contact", "survive")
        info = {f"reward_{name}": zero for name in names} | {"cost_obj": zero, "cost_done": zero}
        info |= _location(_relative(carry.torso_xpos, carry.phase)) | {"physics_overflow": zero}
        cost = jnp.zeros((self.spec.num_agents, 1), zero.dtype)
        return State(obs, global_state, zero, cost, jnp.zeros((), bool), info, carry)

    def _get_obs(self, physics: PhysicsState, phase: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        """Observations [N, 29 + N] and the raw state [29] they all contain; agents differ in the one-hot index only.

        If a sway is seen, both have one more entry.
        """
        qpos, qvel = physics.qpos, physics.qvel
        shown = phase if self.sway == "seen" else None
        at = _relative(qpos, shown)
        place = [at[0] / 5.0, off_centre(at[0], at[1])]
        if shown is not None:
            place.append(SWAY_REACH * SWAY_RATE * jnp.cos(shown))
        raw = jnp.concatenate([qpos[2:], qvel, jnp.stack(place)])
        num_agents = self.spec.num_agents
        obs = jnp.concatenate(
            [jnp.broadcast_to(raw, (num_agents, *raw.shape)), jnp.eye(num_agents, dtype=raw.dtype)], axis=1
        )
        if self._standardise:
            obs = (obs - obs.mean(axis=1, keepdims=True)) / obs.std(axis=1, keepdims=True)
        return obs, raw

    def _get_reward(
        self, before: jax.Array, after: jax.Array, ctrl: jax.Array, contact_force: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Speed along +x (m/s) less control and contact cost, plus 1 for being there: [] and its four addends."""
        parts = {
            "reward_forward": (after[0] - before[0]) / CONTROL_DT,
            "reward_ctrl": -CONTROL_COST * jnp.sum(ctrl**2),
            "reward_contact": -CONTACT_COST * jnp.sum(jnp.clip(contact_force, -1.0, 1.0) ** 2),
            "reward_survive": jnp.full_like(after[0], SURVIVAL),
        }
        return jnp.sum(jnp.stack(list(parts.values()))), parts

    def _get_cost(self, torso: jax.Array, terminated: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """1 in danger, or where the ant terminates: [N, 1]."""
        danger = in_danger(torso[0], torso[1], self.walls).astype(torso.dtype)
        ended = terminated.astype(torso.dtype)
        cost = jnp.minimum(danger + ended, 1.0)
        return jnp.full((self.spec.num_agents, 1), cost), {"cost_obj": danger, "cost_done": ended}

    def _get_termination(self, physics: PhysicsState, torso_xquat: jax.Array) -> jax.Array:
        """Whether the ant left the range of heights, turned over, or the physics broke."""
        height = physics.qpos[2]
        upright = 1.0 - 2.0 * (torso_xquat[1] ** 2 + torso_xquat[2] ** 2)
        sound = jnp.isfinite(physics.qpos).all() & jnp.isfinite(physics.qvel).all()
        return ~(sound & (height >= HEIGHT[0]) & (height <= HEIGHT[1]) & (upright >= LEAST_UPRIGHT))


def off_centre(x: jax.Array, y: jax.Array) -> jax.Array:
    """Signed distance (m) along y from the corridor's centre line.

    At exactly x = 60 the reference code falls through to the straight part; that quirk is kept.
    """
    first, second, third = FOLDS
    straight = first * SLOPE
    centre = jnp.where(x < first, x * SLOPE, straight)
    centre = jnp.where((x > first) & (x < second), (2 * first - x) * SLOPE, centre)
    centre = jnp.where((x > second) & (x < third), (x - third + first) * SLOPE, centre)
    return y - centre


def _relative(place: jax.Array, phase: jax.Array | None) -> jax.Array:
    """A place [>= 2] m next to a corridor that sways, as the same place next to one that does not."""
    return place if phase is None else place.at[1].add(-SWAY_REACH * jnp.sin(phase))


def _location(torso: jax.Array) -> dict[str, jax.Array]:
    """How far the ant is along x (m), and 1 where it is outside."""
    outside = jnp.abs(off_centre(torso[0], torso[1])) > HALF_WIDTH
    return {"x_position": torso[0], "outside": outside.astype(torso.dtype)}


def in_danger(x: jax.Array, y: jax.Array, walls: str = "reference") -> jax.Array:
    """Whether a point costs: within 1.8 m (along y) of either wall, and further out where `walls` is not reference."""
    off = off_centre(x, y)
    if walls != "reference":
        return jnp.abs(off) > HALF_WIDTH - DANGER
    return jnp.minimum(jnp.abs(off - HALF_WIDTH), jnp.abs(off + HALF_WIDTH)) < DANGER
