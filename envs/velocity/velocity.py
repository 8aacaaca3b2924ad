"""Walk fast, but not too fast: Safety-Gymnasium's multi-agent velocity tasks as SafePO trains on them.

| task                        | robot        | agents x motors | a step costs above (m/s) |
|-----------------------------|--------------|-----------------|--------------------------|
| `velocity_ant_2x4`          | ant          | 2 x 4           | 2.522                    |
| `velocity_ant_4x2`          | ant          | 4 x 2           | 2.418                    |
| `velocity_half_cheetah_2x3` | half cheetah | 2 x 3           | 3.227                    |
| `velocity_half_cheetah_6x1` | half cheetah | 6 x 1           | 2.932                    |
| `velocity_hopper_3x1`       | hopper       | 3 x 1           | 0.9613                   |
| `velocity_walker2d_2x3`     | walker       | 2 x 3           | 1.641                    |
| `velocity_swimmer_2x1`      | swimmer      | 2 x 1           | 0.04891                  |
| `velocity_humanoid_9_8`     | humanoid     | 9 and 8         | 0.58                     |

Written from the facts of the public reference and checked against transitions recorded from it; `robots.py` holds what
tells the robots apart, `docs/tasks/velocity.md` what differs from SafePO.

Examples:
  >>> import jax, envs
  >>> env = envs.make("velocity_half_cheetah_2x3")
  >>> state = jax.jit(env.reset)(jax.random.key(0))
  >>> state = jax.jit(env.step)(state, jax.numpy.zeros((2, 3)))
  >>> state.obs.shape, state.cost.shape
  ((2, 19), (2, 1))
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
from ..blocks import Block, Blocks, agent_index, joints, length, motors
from ..errors import TaskError, one_of, typed
from ..physics import PhysicsState, Readout, kernels_of, make_engine
from . import VARIANTS, Partition
from .kinematics import make_kinematics
from .robots import ROBOTS, model

HORIZON = 1000  # control steps
COST_LIMIT = 25.0  # SafePO's bound on an episode's summed cost
FALL_LIMIT = 0.1  # of the second cost: falls per episode

TOO_FAST = (0.86, 0.16, 0.12, 1.0)  # what a picture shows of a costly step: the robot and its bar in red
BAR = {"free": (0.25, 0.62, 0.36, 1.0), "mark": (0.2, 0.22, 0.25, 1.0)}
BAR_LENGTH, BAR_HEIGHT = 0.8, 0.6  # m: the bar at the threshold, and how far above the robot's highest part it floats

_BODIES = slice(None)
_FORCES: Readout = {
    "cinert": ("cinert", _BODIES),
    "cvel": ("cvel", _BODIES),
    "qfrc_actuator": ("qfrc_actuator", _BODIES),
    "cfrc_ext": ("cfrc_ext", _BODIES),
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Carry:
    """The state between control steps.

    Attributes:
      physics: the engine's state.
      place: [3], [2] or [1] m, where the last step left what the next velocity is a difference of.
    """

    physics: PhysicsState
    place: jax.Array


class Velocity:
    """See the module; agents share reward and cost, and their observations differ in a one-hot index only.

    Args:
      variant: one of `envs.velocity.VARIANTS`.
      threshold: m/s, a faster step costs; the benchmark's if None.
      partition: the actuators of each agent, e.g. `((0, 1, 2), (3, 4, 5))`; the benchmark's if None.
      cost: `indicator` (1 above the threshold), or `excess` (how far above it, as a share of the threshold, at most 1).
      fall_cost: adds a second cost, 1 where the episode ends by the robot's rule of health; limit 0.1.
      observation: `zscore` (each vector standardised over its own entries, as SafePO does) or `raw` (for learners that
        keep running moments).
      physics: `auto`, `fused`, `mujoco`, `mjx` or `warp`; see `envs.physics`.
      threads: of `fused` and `mujoco`, which the devices of a process share; all usable CPUs if None.
    """

    shares_cost = True

    @typed
    def __init__(
        self,
        variant: str = "ant_2x4",
        *,
        threshold: float | None = None,
        partition: tuple[tuple[int, ...], ...] | None = None,
        cost: str = "indicator",
        fall_cost: bool = False,
        observation: str = "zscore",
        physics: str = "auto",
        threads: int | None = None,
    ):
        robot, benchmark_threshold, benchmark_partition = VARIANTS[one_of("variant", variant, VARIANTS)]
        self.robot, self.model = ROBOTS[robot], model(robot)
        self.threshold = benchmark_threshold if threshold is None else threshold
        if not self.threshold > 0:
            raise TaskError(f"threshold must be a speed above 0 m/s, not {threshold}")
        self._excess = one_of("cost", cost, ("indicator", "excess")) == "excess"
        self._standardise = one_of("observation", observation, ("zscore", "raw")) == "zscore"
        if fall_cost and self.robot.healthy is None:
            raise TaskError(f"fall_cost would always be 0: nothing ends an episode of the {robot}; leave it out")
        self._fall_cost = fall_cost
        partition = benchmark_partition if partition is None else _checked(partition, self.model.nu)
        self._agent, self._entry, mask = _motors(partition)
        self._build_engine(physics, threads)
        seen, names = (*joints(self.model, self.robot.unseen), *self._forces()), motors(self.model)
        self.declares = Declarations(
            observation=(*seen, agent_index(len(partition))),
            state=seen,
            actions=tuple(tuple(names[motor] for motor in agent) for agent in partition),
            picture=Scene(self._drawn, self.model, self.decorate),
            overflow="physics_overflow",
            kernels=functools.partial(kernels_of, self._engine),
        )
        self.spec = EnvSpec(
            name=f"velocity_{variant}",
            num_agents=len(partition),
            obs_dim=length(self.declares.observation),
            action_dim=mask.shape[1],
            state_dim=length(seen),
            num_costs=2 if fall_cost else 1,
            horizon=HORIZON,
            action_mask=mask,
            cost_limit=(COST_LIMIT, FALL_LIMIT) if fall_cost else COST_LIMIT,
        )

    def _build_engine(self, physics: str, threads: int | None) -> None:
        place: Readout = {"torso_xpos": {"torso_xpos": ("xpos", 1)}, "com": {"com": ("subtree_com", 1)}}.get(
            self.robot.place, {}
        )
        readout = {**place, **(_FORCES if self.robot.sees_forces else {})}
        self._engine = make_engine(
            self.model,
            substeps=self.robot.substeps,
            readout=readout,
            physics=physics,
            threads=threads,
        )
        self.engine = self._engine.name
        self._control_dt = self.robot.substeps * self.model.opt.timestep
        if self.robot.sees_forces:
            self._kinematics = make_kinematics(self.model)

    def _forces(self) -> Blocks:
        """What a robot that sees forces observes after its joints; the order is that of `_FORCES`."""
        bodies, every = self.model.nbody, f"of {self.model.nbody} bodies, the world among them"
        blocks = (
            Block("inertias", 10 * bodies, "kg m2, kg m, kg", f"cinert {every}"),
            Block("body velocities", 6 * bodies, "rad/s, m/s", f"cvel {every}"),
            Block("motor forces", self.model.nv, "N, N m", "qfrc_actuator of every degree of freedom"),
            Block("contact forces", 6 * bodies, "N m, N", f"cfrc_ext {every}"),
        )
        return blocks if self.robot.sees_forces else ()

    def reset(self, key: jax.Array) -> State:
        """The robot near its reference pose."""
        position_key, velocity_key = jax.random.split(key)
        start, noise = self._engine.start(), self.robot.noise
        uniform = jax.random.uniform(position_key, start.qpos.shape, start.qpos.dtype, -noise, noise)
        if self.robot.normal_velocity:
            qvel = noise * jax.random.normal(velocity_key, start.qvel.shape, start.qvel.dtype)
        else:
            qvel = jax.random.uniform(velocity_key, start.qvel.shape, start.qvel.dtype, -noise, noise)
        return self.restore(start.qpos + uniform, qvel)

    def step(self, state: State, action: jax.Array) -> State:
        """One control step with `action` [N, A]; the motors saturate at their ctrlrange, the control cost does not."""
        before: Carry = state.carry
        ctrl = jnp.asarray(action, before.place.dtype)[self._agent, self._entry]
        physics, out = self._engine.step(before.physics, ctrl)
        after = Carry(physics, self._get_place(physics, out))
        velocity = (after.place - before.place) / self._control_dt
        speed = self._get_speed(velocity)
        reward, parts = self._get_reward(velocity, ctrl)
        terminated = self._get_termination(physics)
        cost = self._get_cost(speed, terminated)
        obs, global_state = self._get_obs(physics, out)
        fallen = terminated.astype(speed.dtype)
        info = parts | {"speed": speed, "fallen": fallen, "x_position": after.place[0]}
        return State(obs, global_state, reward, cost, terminated, info | {"physics_overflow": out["overflow"]}, after)

    def restore(self, qpos: Any, qvel: Any, warmstart: Any = None, torso_xpos: Any = None, com: Any = None) -> State:
        """A State from MuJoCo's quantities, as if no transition had led to it.

        A humanoid's observation is then that of a reset: forces of the last step are no part of what is restored.

        Args:
          qpos: [nq] positions; a quaternion is normalised if it is not.
          qvel: [nv] velocities.
          warmstart: [nv] `qacc_warmstart`; zero if None.
          torso_xpos: [3], of the ant alone, where the last control step left the torso's `xpos`; that of qpos if
            None.
          com: [2], of the humanoid alone, where it left the centre of mass; that of qpos if None.
        """
        start = self._engine.start()
        dtype = start.qpos.dtype
        qpos, qvel = jnp.asarray(qpos, dtype), jnp.asarray(qvel, dtype)
        if self.model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
            # A unit quaternion is left alone to the last bit, so that `raw` and `restore` are inverses.
            norm = jnp.linalg.norm(qpos[3:7])
            qpos = qpos.at[3:7].set(jnp.where(jnp.abs(norm - 1.0) > 1e-5, qpos[3:7] / norm, qpos[3:7]))
        warmstart = start.warmstart if warmstart is None else jnp.asarray(warmstart, dtype)
        physics = PhysicsState(qpos, qvel, warmstart)
        out = self._at_rest(physics)
        place = {"torso_xpos": torso_xpos, "com": com}.get(self.robot.place)
        place = self._get_place(physics, out) if place is None else jnp.asarray(place, dtype)
        return self._initial_state(Carry(physics, place), out)

    def raw(self, state: State) -> dict[str, jax.Array]:
        """What `restore` takes."""
        carry: Carry = state.carry
        physics = carry.physics
        place = {} if self.robot.place == "qpos" else {self.robot.place: carry.place}
        return {"qpos": physics.qpos, "qvel": physics.qvel, "warmstart": physics.warmstart, **place}

    def decorate(self, scene: mujoco.MjvScene, raw: dict[str, np.ndarray], cost: float) -> None:
        """Shows how fast the robot is in a scene of `model`: a bar with a mark at the threshold; see `envs.base`.

        The robot and its bar are red while it is too fast. The floor follows by whole tiles, so that it never ends.
        """
        del cost  # which of several costs it is of does not show in a sum
        share = float(raw["speed"]) / self.threshold
        moving = [g for g in scene.geoms[: scene.ngeom] if g.category == mujoco.mjtCatBit.mjCAT_DYNAMIC]
        places = np.array([g.pos for g in moving])
        centre = places.mean(0)
        for geom in scene.geoms[: scene.ngeom]:
            if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
                geom.pos[:2] += 2 * np.round(centre[:2] / 2)
        for geom in moving if share > 1 else ():
            geom.rgba[:] = TOO_FAST
        left = np.array([centre[0] - BAR_LENGTH / 2, centre[1], places[:, 2].max() + BAR_HEIGHT])
        length = BAR_LENGTH * min(max(share, 0.01), 2.0)
        _add_box(scene, left + (length / 2, 0, 0), (length / 2, 0.03, 0.03), TOO_FAST if share > 1 else BAR["free"])
        _add_box(scene, left + (BAR_LENGTH, 0, 0), (0.01, 0.035, 0.07), BAR["mark"])

    def _drawn(self, state: State) -> dict[str, Any]:
        return {"qpos": state.carry.physics.qpos, "speed": state.info["speed"]}

    def _initial_state(self, carry: Carry, out: dict[str, jax.Array]) -> State:
        """A State that no transition led to."""
        obs, global_state = self._get_obs(carry.physics, out)
        zero = jnp.zeros((), carry.place.dtype)
        names = ("reward_forward", "reward_ctrl", "reward_survive", "speed", "fallen")
        info = {name: zero for name in names} | {"x_position": carry.place[0], "physics_overflow": zero}
        cost = jnp.zeros((self.spec.num_agents, self.spec.num_costs), zero.dtype)
        return State(obs, global_state, zero, cost, jnp.zeros((), bool), info, carry)

    def _at_rest(self, physics: PhysicsState) -> dict[str, jax.Array]:
        """What the readouts of a step are of a state that no step led to."""
        if not self.robot.sees_forces:
            return {"torso_xpos": physics.qpos[:3]}
        zeros = {"qfrc_actuator": jnp.zeros_like(physics.qvel)}
        zeros |= {"cfrc_ext": jnp.zeros((self.model.nbody, 6), physics.qvel.dtype)}
        return self._kinematics(physics.qpos, physics.qvel) | zeros

    def _get_place(self, physics: PhysicsState, out: dict[str, jax.Array]) -> jax.Array:
        if self.robot.place == "torso_xpos":
            return out["torso_xpos"]
        return (out["com"] if self.robot.place == "com" else physics.qpos)[: self.robot.axes]

    def _get_obs(self, physics: PhysicsState, out: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Observations [N, S + N] and the state [S] they all contain; agents differ in the one-hot index only."""
        bound = self.robot.velocity_bound
        parts = [physics.qpos[self.robot.unseen :], jnp.clip(physics.qvel, -bound, bound)]
        parts += [out[name].reshape(-1) for name in _FORCES] if self.robot.sees_forces else []
        seen = state = jnp.concatenate(parts)
        index = jnp.eye(self.spec.num_agents, dtype=state.dtype)
        if self._standardise:
            # The entries of all agents are the same but for their order, and so are their mean and their spread.
            entries = jnp.concatenate([state, index[0]])
            mean, spread = entries.mean(), entries.std()
            seen, index = (state - mean) / spread, (index - mean) / spread
            state = (state - state.mean()) / (state.std() + 1e-8)
        return jnp.concatenate([jnp.broadcast_to(seen, (len(index), *seen.shape)), index], axis=1), state

    def _get_speed(self, velocity: jax.Array) -> jax.Array:
        """[] m/s, what the threshold is for."""
        if self.robot.speed == "norm":
            return jnp.sqrt(jnp.sum(velocity[:2] ** 2))
        return velocity[0] if self.robot.speed == "signed" else jnp.abs(velocity[0])

    def _get_reward(self, velocity: jax.Array, ctrl: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Speed along +x less control cost, plus a constant for every step: [] and its three addends."""
        parts = {
            "reward_forward": self.robot.forward * velocity[0],
            "reward_ctrl": -self.robot.control * jnp.sum(ctrl**2),
            "reward_survive": jnp.full_like(velocity[0], self.robot.survival),
        }
        return jnp.sum(jnp.stack(list(parts.values()))), parts

    def _get_cost(self, speed: jax.Array, terminated: jax.Array) -> jax.Array:
        """[N, K]: too fast and, if asked for, fallen."""
        costs = [(speed > self.threshold).astype(speed.dtype)]
        if self._excess:
            costs = [jnp.clip(speed / self.threshold - 1.0, 0.0, 1.0)]
        costs += [terminated.astype(speed.dtype)] if self._fall_cost else []
        return jnp.broadcast_to(jnp.stack(costs), (self.spec.num_agents, len(costs)))

    def _get_termination(self, physics: PhysicsState) -> jax.Array:
        healthy = self.robot.healthy
        return jnp.zeros((), bool) if healthy is None else ~healthy(physics.qpos, physics.qvel)


def _checked(partition: Any, motors: int) -> Partition:
    """`partition`, or a TaskError: every actuator must belong to exactly one agent."""
    agents = [agent if isinstance(agent, list | tuple) else (agent,) for agent in partition]
    given = [motor for agent in agents for motor in agent]
    if not all(agents) or sorted(map(str, given)) != sorted(map(str, range(motors))):
        raise TaskError(
            f"partition must give each of the actuators 0 to {motors - 1} to one agent, and every agent at least one, "
            f"not {[list(agent) for agent in agents]}"
        )
    return tuple(tuple(int(motor) for motor in agent) for agent in agents)


def _motors(partition: Partition) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each actuator its agent [nu] and the entry of that agent's action [nu]; the action mask [N, A]."""
    mask = np.zeros((len(partition), max(map(len, partition))), np.float32)
    owner = {motor: (i, j) for i, agent in enumerate(partition) for j, motor in enumerate(agent)}
    agent, entry = np.array([owner[motor] for motor in sorted(owner)]).T
    mask[agent, entry] = 1.0
    return agent, entry, mask


def _add_box(scene: mujoco.MjvScene, place: np.ndarray, size: tuple[float, ...], colour: tuple[float, ...]) -> None:
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(
        geom, mujoco.mjtGeom.mjGEOM_BOX, np.array(size), place, np.eye(3).ravel(), np.array(colour, np.float32)
    )
    scene.ngeom += 1
