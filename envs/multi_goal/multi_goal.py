"""Robots that walk to goals of their own among hazards and vases: Safety-Gymnasium's MultiGoal tasks, as SafePO trains.

| task                 | robots | world                                         |
|----------------------|--------|-----------------------------------------------|
| `multi_goal_point_0` | points | nothing but the goals                         |
| `multi_goal_point_1` | points | 8 hazards to walk through, a vase that is free |
| `multi_goal_point_2` | points | 10 hazards, 10 vases that must not move       |
| `multi_goal_ant_0`   | ants   | as point_0                                    |
| `multi_goal_ant_1`   | ants   | as point_1                                    |
| `multi_goal_ant_2`   | ants   | as point_2                                    |

Written from the facts of the public reference and checked against transitions recorded from it. Rewards, costs and
goals differ by agent. `docs/tasks/multi_goal.md` says what is odd in the reference, and what `wiring = own` changes.

Examples:
  >>> import jax, envs
  >>> env = envs.make("multi_goal_point_1", physics="mujoco")
  >>> state = jax.jit(env.reset)(jax.random.key(0))
  >>> state = jax.jit(env.step)(state, jax.numpy.zeros((2, 2)))
  >>> state.obs.shape, state.cost.shape
  ((2, 154), (2, 1))
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
from ..blocks import Block, Blocks, agent_index, length
from ..errors import TaskError, at_least, one_of, typed
from ..physics import PhysicsState, kernels_of, make_engine
from . import LEVELS, VARIANTS
from .baselines import policies
from .groups import groups_of, touched_robots, touched_vases
from .kinematics import pose
from .models import MOST_ROBOTS, ROBOTS, SUBSTEPS, model
from .places import AGENT, GOAL, GOAL_TRIES, HAZARD, VASE, layout, place_one, plan
from .scene import decorate
from .sensing import SENSORS, lidar, sensors
from .vases import Vases

HORIZON = 1000  # control steps
COST_LIMIT = 25.0  # SafePO's bound on an agent's summed cost in an episode, of each kind

REACHED = 0.3  # m to its goal, at which an agent has reached it
IN_HAZARD = 0.2  # m to a hazard's centre
MOVES = 1e-4  # m/s, a vase's speed that costs
KINDS = ("hazards", "vases_contact", "vases_velocity", "contact_other")  # of cost, in `info`

ANT_HEIGHT, VASE_HEIGHT = 0.18, 0.1 - 4e-5  # m, at the start
JOINT_NOISE = 0.1  # rad, half the width of the uniform noise on an ant's joints
_ANKLES = np.array([1, -1, -1, 1]) * np.pi / 2  # rad


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Carry:
    """The state between control steps.

    Attributes:
      physics: all robots, then all vases.
      goals: [N, 2] m; hazards: [H, 2] m.
      vase_owner: [V] int32, the agent whose group touched a vase last.
      key: for new goals.
      crowded: [] things of the layout that found no room; counted in the next step.
    """

    physics: PhysicsState
    goals: jax.Array
    hazards: jax.Array
    vase_owner: jax.Array
    key: jax.Array
    crowded: jax.Array


class MultiGoal:
    """See the module; rewards, costs and goals differ by agent, and `reward` is their mean over agents.

    Args:
      variant: one of `envs.multi_goal.VARIANTS`.
      wiring: `reference` (agent 0 drives the thrust of both points and agent 1 turns both, both agents observe
        everything, and one ant's front leg pays for agent 1) or `own` (each agent drives its own robot, observes from
        it, also the others by a lidar, and pays for its own contacts).
      groups: the geoms that count for contacts, `reference` or `whole` (all of the agent's own robot); None is
        `reference` with that wiring, else `whole`.
      num_agents: robots, 2 to 8; more than 2 with `own` only.
      hazards: how many, at levels 1 and 2; the level's if None.
      vases: how many, at levels 1 and 2; the level's if None. They cost at level 2.
      size: m, half the side of the square in which everything is placed; if None the level's, or with more agents as
        much larger as leaves each the same area.
      lidar_bins: of each lidar.
      lidar_range: m, from where on a lidar shows nothing.
      cost: `sum` (1 in a step with any kind of cost) or `kinds` (a cost and a limit of its own for hazards, vases and
        robots that touch).
      observation: `zscore` (each vector standardised over its own entries, as SafePO does) or `raw` (for learners that
        keep running moments).
      vase_slots: vases that a step simulates: those that move and the nearest to a robot. The others stay as they are.
      physics: `auto`, `fused`, `mujoco` or `mjx`; see `envs.physics`.
      threads: of `fused` and `mujoco`, which the devices of a process share; all usable CPUs if None.
    """

    @typed
    def __init__(
        self,
        variant: str = "point_1",
        *,
        wiring: str = "reference",
        groups: str | None = None,
        num_agents: int = 2,
        hazards: int | None = None,
        vases: int | None = None,
        size: float | None = None,
        lidar_bins: int = 16,
        lidar_range: float = 3.0,
        cost: str = "sum",
        observation: str = "zscore",
        vase_slots: int = 4,
        physics: str = "auto",
        threads: int | None = None,
    ):
        self.robot, self.level = VARIANTS[one_of("variant", variant, VARIANTS)]
        self.own = one_of("wiring", wiring, ("reference", "own")) == "own"
        groups = groups or ("whole" if self.own else "reference")
        self._whole = one_of("groups", groups, ("reference", "whole")) == "whole" or self.robot == "point"
        self._by_kind = one_of("cost", cost, ("sum", "kinds")) == "kinds"
        self._standardise = one_of("observation", observation, ("zscore", "raw")) == "zscore"
        self._bins, self._range = int(at_least("lidar_bins", lidar_bins, 3)), lidar_range
        self.num_agents = _checked_agents(num_agents, self.own, self._whole)
        self._build_world(hazards, vases, size, vase_slots)
        if not lidar_range > 0:
            raise TaskError(f"lidar_range must be a length above 0 m, not {lidar_range}")
        if self._by_kind and not self.charges:
            raise TaskError("cost = kinds has no kinds at level 0, where nothing costs; take level 1 or 2")
        self._build_engines(physics, threads)
        self._build_spec(variant)

    def _build_world(self, hazards: int | None, vases: int | None, size: float | None, slots: int) -> None:
        level = LEVELS[self.level]
        self.charges = level.charges
        if self.level == 0 and (hazards or vases):
            raise TaskError("level 0 has neither hazards nor vases; take level 1 or 2, whose numbers can be chosen")
        count = {"hazards": hazards, "vases": vases}
        chosen = {name: getattr(level, name) if x is None else int(at_least(name, x, 0)) for name, x in count.items()}
        self.num_hazards = chosen["hazards"]
        self.size = level.size * (self.num_agents / 2) ** 0.5 if size is None else size
        if not self.size > AGENT:
            raise TaskError(f"size must be more than {AGENT} m, the room that a robot needs, not {size}")
        kind, robots = ROBOTS[self.robot], self.num_agents
        slots = min(int(at_least("vase_slots", slots, 1)), chosen["vases"])
        self._kind = kind
        self.vases = Vases(robots * kind.nq, robots * kind.nv, chosen["vases"], slots, kind.reach)
        self._plan = plan(robots, self.num_hazards, chosen["vases"], reference=not self.own)

    def _build_engines(self, physics: str, threads: int | None) -> None:
        self.model = model(self.robot, self.num_agents, self.vases.count, self.size)
        stepped = model(self.robot, self.num_agents, self.vases.slots, self.size)
        readout = {"qacc": ("qacc", slice(self.vases.nv))}
        self._stepped = stepped, readout, True
        make = functools.partial(make_engine, stepped, readout=readout, forward=True, physics=physics, threads=threads)
        self._engine, self._at_rest = make(substeps=SUBSTEPS), make(substeps=0)
        self.engine = self._engine.name

    def _build_spec(self, variant: str) -> None:
        agents = range(self.num_agents)
        blocks = self._blocks()
        state = tuple(Block(f"robot {i} {b.name}", *b[1:]) for i in agents for b in blocks)
        observation = blocks if self.own else state
        motors = self._kind.motors
        if self.robot == "point" and not self.own:
            actions = tuple(tuple(f"{motor} of robot {i}" for i in agents) for motor in motors)
        else:
            actions = tuple(tuple(f"{motor} of robot {i}" for motor in motors) for i in agents)
        self.declares = Declarations(
            observation=(*observation, agent_index(self.num_agents)),
            state=state,
            actions=actions,
            picture=Scene(self._drawn, self.model, self.decorate),
            baselines=policies(self),
            overflow="physics_overflow",
            kernels=functools.partial(kernels_of, self._engine, self._at_rest),
            stepped=self._stepped,
        )
        num_costs = len(self.charges) if self._by_kind else 1
        self.spec = EnvSpec(
            name=f"multi_goal_{variant}",
            num_agents=self.num_agents,
            obs_dim=length(self.declares.observation),
            action_dim=len(actions[0]),
            state_dim=length(state),
            num_costs=num_costs,
            horizon=HORIZON,
            action_mask=np.ones((self.num_agents, len(actions[0])), np.float32),
            cost_limit=(COST_LIMIT,) * num_costs if num_costs > 1 else COST_LIMIT,
        )

    def _blocks(self) -> Blocks:
        """What one robot senses."""
        goals = ["own goal", "other goals"] if self.own else [f"goal {j}" for j in range(self.num_agents)]
        things = goals + (["hazards", "vases"] if self.level else []) + (["other robots"] if self.own else [])
        seen = tuple(Block(f"lidar of {x}", self._bins, "-", "1 near, 0 far, anticlockwise from ahead") for x in things)
        return (*SENSORS[self.robot], *seen)

    def reset(self, key: jax.Array) -> State:
        """A new layout, everything at rest."""
        layout_key, heading_key, joint_key, key = jax.random.split(key, 4)
        start = self._at_rest.start()
        dtype, agents, vases = start.qpos.dtype, self.num_agents, self.vases.count
        places, crowded = layout(layout_key, self._plan, self.size, dtype)
        robots, goals, hazards, vase_places = jnp.split(places, np.cumsum([agents, agents, self.num_hazards]).tolist())
        headings = jax.random.uniform(heading_key, (agents + vases,), dtype, 0.0, 2 * jnp.pi)
        if self.robot == "point":
            qpos = jnp.concatenate([robots, headings[:agents, None]], axis=1)
        else:
            noise = jax.random.uniform(joint_key, (4, 2), dtype, -JOINT_NOISE, JOINT_NOISE)  # the same for all ants
            joints = (noise + jnp.asarray(np.stack([np.zeros(4), _ANKLES], 1), dtype)).ravel()
            roots = jax.vmap(_upright, (0, 0, None))(robots, headings[:agents], ANT_HEIGHT)
            qpos = jnp.concatenate([roots, jnp.broadcast_to(joints, (agents, 8))], axis=1)
        boxes = jax.vmap(_upright, (0, 0, None))(vase_places, headings[agents:], VASE_HEIGHT)
        still = jnp.zeros(self.vases.nv + 6 * vases, dtype)
        physics = PhysicsState(jnp.concatenate([qpos.ravel(), boxes.ravel()]), still, still)
        owner = jnp.zeros(vases, jnp.int32)
        return self._initial_state(Carry(physics, goals, hazards, owner, key, crowded.astype(dtype)))

    def step(self, state: State, action: jax.Array) -> State:
        """One control step with `action` [N, A], clipped to [-1, 1]: 0.02 s of a point, 0.1 s of an ant."""
        before: Carry = state.carry
        ctrl = self._ctrl(jnp.clip(jnp.asarray(action, before.goals.dtype), -1.0, 1.0))
        physics, out, left_out = self._advance(self._engine, before.physics, ctrl)
        distance = self._distances(physics, before.goals)
        reached = distance <= REACHED
        reward = self._distances(before.physics, before.goals) - distance + reached
        costs, owner = self._get_costs(physics, before)
        key, goal_key = jax.random.split(before.key)
        goals, misplaced = self._new_goals(goal_key, before, physics, reached)
        after = Carry(physics, goals, before.hazards, owner, key, jnp.zeros_like(before.crowded))
        obs, global_state = self.observe(after, out["qacc"])
        faults = {
            "physics_overflow": out["overflow"],
            "vases_left_out": left_out,
            "misplaced": before.crowded + misplaced,
        }
        info = self._get_info(reward, reached, costs) | faults
        return State(obs, global_state, reward.mean(), self._get_cost(costs), self.ends(physics), info, after)

    def restore(
        self,
        qpos: Any,
        qvel: Any,
        goals: Any,
        warmstart: Any = None,
        hazards: Any = None,
        vase_owner: Any = None,
        key: Any = None,
        crowded: Any = 0,
    ) -> State:
        """A State from MuJoCo's quantities, as if no transition had led to it; motors are at rest for what it observes.

        Args:
          qpos: [nq] of robots, then vases; a point's counts from the world's origin. Quaternions are normalised if they
            are not.
          qvel: [nv] velocities.
          goals: [N, 2] m.
          warmstart: [nv] `qacc_warmstart`; zero if None.
          hazards: [H, 2] m; needed if the task has any.
          vase_owner: [V] agents; 0 if None.
          key: for new goals, a key or its data; that of seed 0 if None.
          crowded: things of the layout that found no room, which the next step counts.

        Raises:
          TaskError: the hazards are missing, or as many as the task does not have.
        """
        dtype = self._at_rest.start().qpos.dtype
        qpos, qvel = jnp.asarray(qpos, dtype), jnp.asarray(qvel, dtype)
        hazards = jnp.zeros((0, 2), dtype) if hazards is None else jnp.asarray(hazards, dtype)
        if hazards.shape != (self.num_hazards, 2):
            raise TaskError(f"hazards must have shape ({self.num_hazards}, 2), not {hazards.shape}")
        warmstart = jnp.zeros_like(qvel) if warmstart is None else jnp.asarray(warmstart, dtype)
        count = self.vases.count
        owner = jnp.zeros(count, jnp.int32) if vase_owner is None else jnp.asarray(vase_owner, jnp.int32)
        key = jax.random.key(0) if key is None else jnp.asarray(key)
        if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
            key = jax.random.wrap_key_data(key)
        physics = PhysicsState(self._with_unit_quaternions(qpos), qvel, warmstart)
        goals, crowded = jnp.asarray(goals, dtype), jnp.asarray(crowded, dtype)
        return self._initial_state(Carry(physics, goals, hazards, owner, key, crowded))

    def raw(self, state: State) -> dict[str, jax.Array]:
        """What `restore` takes."""
        carry: Carry = state.carry
        physics = carry.physics
        return {
            "qpos": physics.qpos,
            "qvel": physics.qvel,
            "goals": carry.goals,
            "warmstart": physics.warmstart,
            **({"hazards": carry.hazards} if self.level else {}),
            "vase_owner": carry.vase_owner,
            "key": jax.random.key_data(carry.key),
            "crowded": carry.crowded,
        }

    def decorate(self, scene: mujoco.MjvScene, raw: dict[str, np.ndarray], cost: float) -> None:
        """Shows goals, hazards and lidars in a scene of `model`, and robots that pay in red; see `envs.base`."""
        del cost  # whose it is shows in `raw`
        decorate(scene, raw)

    def _drawn(self, state: State) -> dict[str, Any]:
        carry: Carry = state.carry
        costs = [jnp.stack([state.info[f"cost_{kind}_{i}"] for kind in KINDS]).max() for i in range(self.num_agents)]
        bodies, _ = self._bodies(carry.physics)
        return {
            "qpos": carry.physics.qpos,
            "goals": carry.goals,
            "hazards": carry.hazards,
            "robots": bodies.place,
            "headings": jnp.arctan2(bodies.rotation[:, 1, 0], bodies.rotation[:, 0, 0]),
            "paying": jnp.stack(costs),
            "hazard_lidar": self._lidar(bodies, carry.hazards),
            "goal_lidar": self._lidar_of_own(bodies, carry.goals),
            "vase_lidar": self._lidar(bodies, self.vases.qpos(carry.physics)[:, :2]),
        }

    def _initial_state(self, carry: Carry) -> State:
        """A State that no transition led to."""
        _, out, _ = self._advance(self._at_rest, carry.physics, jnp.zeros(self.model.nu))
        obs, global_state = self.observe(carry, out["qacc"])
        nothing = jnp.zeros(self.num_agents, carry.goals.dtype)
        info = self._get_info(nothing, nothing, dict.fromkeys(KINDS, nothing))
        zero = jnp.zeros((), nothing.dtype)
        info |= dict.fromkeys(("physics_overflow", "vases_left_out", "misplaced"), zero)
        cost = jnp.zeros((self.num_agents, self.spec.num_costs), nothing.dtype)
        return State(obs, global_state, zero, cost, jnp.zeros((), bool), info, carry)

    def _ctrl(self, action: jax.Array) -> jax.Array:
        """[nu] in the model's order, robot by robot; the reference hands the points' motors out by their kind."""
        return (action.T if self.robot == "point" and not self.own else action).ravel()

    def _advance(
        self, engine: Any, physics: PhysicsState, ctrl: jax.Array
    ) -> tuple[PhysicsState, dict[str, jax.Array], jax.Array]:
        """A step of an engine: the state, the readouts, and how many vases [] had no slot though they may move."""
        if self.vases.count == self.vases.slots:
            return *engine.step(physics, ctrl), jnp.zeros((), physics.qpos.dtype)
        chosen, left_out = self.vases.choose(physics, self._robots(physics.qpos)[:, :2])
        after, out = engine.step(self.vases.take(physics, chosen), ctrl)
        return self.vases.put(physics, chosen, after), out, left_out

    def _robots(self, qpos: jax.Array) -> jax.Array:
        """[N, nq of one]."""
        return qpos[: self.vases.nq].reshape(self.num_agents, -1)

    def _distances(self, physics: PhysicsState, goals: jax.Array) -> jax.Array:
        """[N] m, of the robots to their goals."""
        return jnp.sqrt(jnp.sum((self._robots(physics.qpos)[:, :2] - goals) ** 2, axis=1))

    def _bodies(self, physics: PhysicsState) -> tuple[Any, jax.Array]:
        """The robots' poses with a leading [N], and their qpos."""
        robots = self._robots(physics.qpos)
        return jax.vmap(functools.partial(pose, self.robot))(robots), robots

    def _lidar(self, bodies: Any, points: jax.Array) -> jax.Array:
        """[N, bins] of points [P, 2], the same for all robots."""
        return jax.vmap(lambda body: lidar(points, body, self._bins, self._range))(bodies)

    def _lidar_of_own(self, bodies: Any, points: jax.Array) -> jax.Array:
        """[N, bins] of points [N, 2], for each robot its own alone."""
        return jax.vmap(lambda body, point: lidar(point[None], body, self._bins, self._range))(bodies, points)

    def _lidar_of_others(self, bodies: Any, points: jax.Array) -> jax.Array:
        """[N, bins] of points [N, 2], for each robot without its own."""
        agents = range(self.num_agents)
        others = jnp.asarray([[j for j in agents if j != i] for i in agents])
        return jax.vmap(lambda body, seen: lidar(points[seen], body, self._bins, self._range))(bodies, others)

    def observe(self, carry: Carry, qacc: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Observations [N, O] and the state [S]: the blocks of all robots."""
        agents = self.num_agents
        bodies, robots = self._bodies(carry.physics)
        sense = functools.partial(sensors, self.robot, self._kind.site)
        qvel, qacc = (x[: self.vases.nv].reshape(agents, -1) for x in (carry.physics.qvel, qacc))
        parts = [jax.vmap(sense)(robots, qvel, qacc)]
        if self.own:
            parts += [self._lidar_of_own(bodies, carry.goals), self._lidar_of_others(bodies, carry.goals)]
        else:
            parts += [self._lidar(bodies, goal[None]) for goal in carry.goals]
        if self.level:
            parts += [self._lidar(bodies, x) for x in (carry.hazards, self.vases.qpos(carry.physics)[:, :2])]
        if self.own:
            parts.append(self._lidar_of_others(bodies, robots[:, :2]))
        blocks = jnp.concatenate(parts, axis=1)
        state = blocks.ravel()
        seen = blocks if self.own else jnp.broadcast_to(state, (agents, state.size))
        obs = jnp.concatenate([seen, jnp.eye(agents, dtype=state.dtype)], axis=1)
        if self._standardise:
            obs = (obs - obs.mean(1, keepdims=True)) / obs.std(1, keepdims=True)
            state = (state - state.mean()) / (state.std() + 1e-8)
        return obs, state

    def _get_costs(self, physics: PhysicsState, before: Carry) -> tuple[dict[str, jax.Array], jax.Array]:
        """The four kinds of cost, each [N] 0 or 1, and the vases' owners [V] after the step."""
        robots = self._robots(physics.qpos)
        found: dict[str, jax.Array] = {kind: jnp.zeros(self.num_agents, bool) for kind in KINDS}
        owner = before.vase_owner
        if "hazards" in self.charges and self.num_hazards:
            apart = jnp.sqrt(jnp.sum((robots[:, None, :2] - before.hazards) ** 2, axis=2))
            found["hazards"] = (apart < IN_HAZARD).any(1)
        groups = groups_of(self.robot, robots, self._whole)
        if "vases" in self.charges:
            touched = touched_vases(groups, self.vases.qpos(physics))
            moves = jnp.sqrt(jnp.sum(self.vases.qvel(physics)[:, :3] ** 2, axis=1)) >= MOVES
            velocity = []
            for agent in range(self.num_agents):  # in this order: a moving vase that two touch may cost both
                owner = jnp.where(touched[agent], agent, owner)
                velocity.append((moves & (owner == agent)).any())
            found |= {"vases_contact": touched.any(1), "vases_velocity": jnp.stack(velocity)}
        if "robots" in self.charges and self._whole:  # the reference's two groups of ants are parts of one ant
            found["contact_other"] = touched_robots(groups)
        return {kind: x.astype(physics.qpos.dtype) for kind, x in found.items()}, owner

    def _get_cost(self, costs: dict[str, jax.Array]) -> jax.Array:
        """[N, K]."""
        kinds = _merged(costs)
        if self._by_kind:
            return jnp.stack([kinds[name] for name in self.charges], axis=1)
        return jnp.stack(list(kinds.values()), axis=1).max(1, keepdims=True)

    def _get_info(self, reward: jax.Array, reached: jax.Array, costs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        dtype = reward.dtype
        each = {"reward": reward, "reached": reached.astype(dtype)} | {f"cost_{kind}": x for kind, x in costs.items()}
        info = {f"{name}_{i}": x[i] for name, x in each.items() for i in range(self.num_agents)}
        return info | {"reached": each["reached"].mean()} | {name: x.mean() for name, x in _merged(costs).items()}

    def ends(self, physics: PhysicsState) -> jax.Array:
        """[] bool, whether an ant lies on its back; points never end an episode."""
        if self._kind.least_height is None:
            return jnp.zeros((), bool)
        return (self._robots(physics.qpos)[:, 2] <= self._kind.least_height).any()

    def _new_goals(
        self, key: jax.Array, before: Carry, physics: PhysicsState, reached: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The goals [N, 2], of which those that were reached are elsewhere, and how many [] of these found no room."""
        goals = before.goals
        checked = self.num_agents if self.own else 1  # the reference never checks robot 1
        robots, vases = self._robots(physics.qpos)[:checked, :2], self.vases.qpos(physics)[:, :2]
        still = jnp.concatenate([robots, before.hazards, vases])
        apart = np.array([AGENT] * checked + [HAZARD] * self.num_hazards + [VASE] * self.vases.count)
        gaps = jnp.asarray(GOAL + np.concatenate([[GOAL] * (self.num_agents + 1), apart]), goals.dtype)
        half, misplaced = jnp.asarray(self.size - GOAL, goals.dtype), jnp.zeros((), goals.dtype)
        for i in range(self.num_agents):
            # Its old place is among the goals; twice, as the new place of a goal that moved is, too.
            others = jnp.concatenate([before.goals[i][None], goals, still])
            place, kept = place_one(
                jax.random.fold_in(key, i), half, others, gaps, GOAL_TRIES, start=(goals[i], ~reached[i])
            )
            goals, misplaced = goals.at[i].set(place), misplaced + ~kept
        return goals, misplaced

    def _with_unit_quaternions(self, qpos: jax.Array) -> jax.Array:
        """`qpos` with quaternions normalised; unit ones are left alone to the last bit, so that `raw` is inverted."""
        nq = self._kind.nq
        starts = [i * nq + 3 for i in range(self.num_agents) if self.robot == "ant"]
        starts += [self.vases.nq + 7 * v + 3 for v in range(self.vases.count)]
        if not starts:
            return qpos
        entries = jnp.asarray(starts)[:, None] + jnp.arange(4)
        quats = qpos[entries]
        norm = jnp.sqrt(jnp.sum(quats**2, axis=1, keepdims=True))
        return qpos.at[entries].set(jnp.where(jnp.abs(norm - 1.0) > 1e-5, quats / norm, quats))


def _checked_agents(num_agents: int, own: bool, whole: bool) -> int:
    if not 2 <= num_agents <= MOST_ROBOTS:
        raise TaskError(f"num_agents must be 2 to {MOST_ROBOTS}, not {num_agents}")
    if num_agents > 2 and not own:
        raise TaskError(f"wiring = reference has 2 agents, not {num_agents}; take wiring = own")
    if own and not whole:
        raise TaskError("groups = reference cuts up one ant, which wiring = own cannot mean; leave groups out")
    return int(num_agents)


def _merged(costs: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """[N] each, by what a step costs for: the two kinds of vases are one."""
    vases = jnp.maximum(costs["vases_contact"], costs["vases_velocity"])
    return {"hazards": costs["hazards"], "vases": vases, "robots": costs["contact_other"]}


def _upright(place: jax.Array, heading: jax.Array, height: float) -> jax.Array:
    """[7] of a free joint."""
    zero = jnp.zeros_like(heading)
    return jnp.stack([*place, zero + height, jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)])
