"""The engine `fused` against MuJoCo's C engine, its promises beyond numbers, and how it is compiled."""

from __future__ import annotations

import copy
import functools
import os
import pathlib
import stat
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import native, physics
from envs.ant import corridor, walls
from envs.errors import TaskError
from envs.physics.contract import PhysicsState
from envs.physics.fused import cpu
from envs.physics.fused import model as tables_of
from envs.physics.fused.header import header
from envs.physics.fused_engine import FusedEngine
from envs.velocity import robots
from native import compiled
from places import ROOT
from pmt_jax import tasks

pytestmark = compiled

# Every field that the engine reads out, of all bodies.
READOUT = {field: (field, slice(None)) for field in tables_of.FIELDS if field != "subtree_com"}
READOUT |= {"com": ("subtree_com", 1)}
CORRIDOR = "corridor"
FIRST = (CORRIDOR, "hopper", "swimmer", "humanoid")  # between them they have all that the others have
FULL = ("ant", "half_cheetah", "walker2d")
every_robot = pytest.mark.parametrize(
    "robot", [*FIRST, *(pytest.param(robot, marks=pytest.mark.full) for robot in FULL)]
)


def model_of(robot: str) -> tuple[mujoco.MjModel, int]:
    """A model and its substeps. C's solver goes on to the end, where it would stop at an improvement of 1e-8."""
    known = robot == CORRIDOR
    model = copy.copy(walls.model() if known else robots.model(robot))
    model.opt.tolerance, model.opt.ls_tolerance = 0.0, 1e-6
    return model, corridor.SUBSTEPS if known else robots.ROBOTS[robot].substeps


def split(model: mujoco.MjModel, rows: np.ndarray) -> tuple[PhysicsState, jax.Array]:
    """Rows [n, qpos qvel warm start ctrl] as a state and controls."""
    ends = np.cumsum([model.nq, model.nv, model.nv])
    qpos, qvel, warm, ctrl = (jnp.asarray(part) for part in np.split(rows, ends, axis=1))
    return PhysicsState(qpos, qvel, warm), ctrl


def by_c(model: mujoco.MjModel, rows: np.ndarray, substeps: int, readout=READOUT):
    """What MuJoCo makes of the rows: qpos, qvel, warm start and the readouts."""
    data, found = mujoco.MjData(model), []
    ends = np.cumsum([model.nq, model.nv, model.nv])
    for row in rows:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = np.split(row, ends)
        mujoco.mj_step(model, data, substeps)
        mujoco.mj_rnePostConstraint(model, data)
        out = {name: np.array(getattr(data, field)[index]) for name, (field, index) in readout.items()}
        found.append({"qpos": data.qpos.copy(), "qvel": data.qvel.copy(), "warm": data.qacc_warmstart.copy()} | out)
    return {name: np.stack([row[name] for row in found]) for name in found[0]}


def by_fused(model: mujoco.MjModel, rows: np.ndarray, substeps: int, readout=READOUT, **options):
    """The same by the engine, in double precision throughout."""
    with jax.enable_x64(True):
        step = jax.jit(jax.vmap(FusedEngine(model, substeps, readout, **options).step))
        state, out = step(*split(model, rows))
        found = {"qpos": state.qpos, "qvel": state.qvel, "warm": state.warmstart} | out
        return {name: np.asarray(value) for name, value in found.items()}


# -- states --


def visited(model: mujoco.MjModel, substeps: int, count: int) -> np.ndarray:
    """States along rollouts with random controls from near the reference pose."""
    rng, data, rows = np.random.default_rng(0), mujoco.MjData(model), []
    while len(rows) < count:
        mujoco.mj_resetData(model, data)
        data.qpos[:] += rng.uniform(-0.1, 0.1, model.nq)
        data.qvel[:] = 0.1 * rng.normal(size=model.nv)
        if model.jnt_type[0] == 0:
            data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        size = rng.choice([0.1, 0.5, 1.0]) * model.actuator_ctrlrange[:, 1]
        for k in range(40):
            data.ctrl[:] = rng.uniform(-1.2, 1.2, model.nu) * size
            if k % 4 == 3:
                rows.append(np.concatenate([data.qpos, data.qvel, data.qacc_warmstart, data.ctrl]))
            mujoco.mj_step(model, data, substeps)
    return np.array(rows[:count])


def anywhere(model: mujoco.MjModel, count: int, low: float, high: float) -> np.ndarray:
    """States in any attitude, `low` to `high` m over the floor (of a free root), joints up to 0.2 beyond limits."""
    rng = np.random.default_rng(1)
    rows = np.zeros((count, model.nq + 2 * model.nv + model.nu))
    rows[:, : model.nq] = model.qpos0
    for j in range(model.njnt):
        a, kind = model.jnt_qposadr[j], model.jnt_type[j]
        if kind == 0:
            quat = rng.normal(size=(count, 4))
            rows[:, a + 2] = rng.uniform(low, high, count)
            rows[:, a + 3 : a + 7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        elif model.jnt_limited[j]:
            rows[:, a] = rng.uniform(model.jnt_range[j, 0] - 0.2, model.jnt_range[j, 1] + 0.2, count)
        else:
            reach = 1.5 if kind == 3 else 0.5
            rows[:, a] += rng.uniform(-reach, reach if kind == 3 else 0.2, count)
    rows[:, model.nq : model.nq + model.nv] = 2 * rng.normal(size=(count, model.nv))
    if model.nu:
        rows[:, -model.nu :] = rng.uniform(-1, 1, (count, model.nu))
    return rows


def at_margins(model: mujoco.MjModel, count: int) -> np.ndarray:
    """States a tenth of a micrometre to either side of where the first contact with the floor appears."""
    rows, data, out = anywhere(model, count, 1.0, 1.0), mujoco.MjData(model), []
    height = 2 if model.jnt_type[0] == 0 else 1

    def touches(row: np.ndarray, z: float) -> bool:
        data.qpos[:] = row[: model.nq]
        data.qpos[height] = z
        mujoco.mj_forward(model, data)
        return any(model.geom_type[geom] == 0 for pair in data.contact.geom for geom in pair)

    for row in rows:
        low, high = -3.0, 6.0
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (middle, high) if touches(row, middle) else (low, middle)
        for z in (low - 1e-7, high + 1e-7):
            out.append(np.r_[row[:height], z, row[height + 1 :]])
    return np.array(out)


def states(robot: str, kind: str) -> np.ndarray:
    model, substeps = model_of(robot)
    if kind == "visited":
        return visited(model, substeps, 600)
    if kind == "margins":
        return at_margins(model, 100)
    low, high = {"random": (0.3, 1.5), "on the ground": (0.02, 0.3)}[kind]
    return anywhere(model, 300, low, high)


# -- numbers --


@functools.cache
def results(robot: str, kind: str):
    model, substeps = model_of(robot)
    rows = states(robot, kind)
    return by_fused(model, rows, substeps), by_c(model, rows, substeps)


def check(ours, theirs, tolerance: float, share: float) -> None:
    """All but a share of rows within the tolerance, relative to the largest number of the row if it is above 1.

    MuJoCo jumps where a contact is at its margin within rounding, and C's jumps are at other bits than ours.
    """
    for name, expected in theirs.items():
        error = np.abs(ours[name] - expected).reshape(len(expected), -1).max(1)
        size = np.maximum(1.0, np.abs(expected).reshape(len(expected), -1).max(1))
        worst = np.sort(error / size)[-int(share * len(error)) - 1]
        assert worst < tolerance, (name, worst)


KINDS = ("visited", "random", "on the ground", "margins")


@every_robot
@pytest.mark.parametrize("kind", KINDS)
def test_a_control_step_and_its_readouts_are_mujocos(robot, kind):
    if robot == "swimmer" and kind in ("on the ground", "margins"):
        pytest.skip("it touches nothing")
    ours, theirs = results(robot, kind)
    check(ours, theirs, 1e-9, 0.01)
    assert not ours["overflow"].any()


@pytest.mark.parametrize("robot", [CORRIDOR, *(pytest.param(x, marks=pytest.mark.full) for x in (*FIRST[1:], *FULL))])
def test_the_acceleration_is_mujocos(robot):
    """Of the very state: Euler's warm start after one substep."""
    model, substeps = model_of(robot)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for rows in (visited(model_of(robot)[0], substeps, 600), anywhere(model, 300, 0.05, 1.0)):
        ours, theirs = by_fused(model, rows, 1, {}), by_c(model, rows, 1, {})
        check({"warm": ours["warm"]}, {"warm": theirs["warm"]}, 1e-8, 0.01)


@pytest.mark.full
@pytest.mark.parametrize("robot", [*FIRST, *FULL])
def test_the_float_build_is_mujocos_within_its_rounding(robot):
    """The GPU computes with the same formulae in float."""
    model, substeps = model_of(robot)
    made = tables_of.tables(model, substeps, {})
    step = jax.jit(cpu.make_step(made, 0, "float"))
    for kind in ("visited", "random"):
        rows = states(robot, kind)
        state, ctrl = split(model, rows.astype(np.float32))
        qpos, qvel, *_ = step(state.qpos, state.qvel, state.warmstart, ctrl)
        theirs = by_c(model, rows.astype(np.float32).astype(np.float64), substeps, {})
        check({"qpos": qpos, "qvel": qvel}, {k: theirs[k] for k in ("qpos", "qvel")}, 5e-5, 0.02)


SMALL = {
    "a free ball": "<body><freejoint/><geom size='.1'/></body>",
    "a free box of welded parts, damped": """
        <body pos='0 0 .3'><freejoint/><geom size='.1'/>
          <body pos='.2 .1 0' euler='10 20 30'><geom type='capsule' size='.05 .2'/>
            <body pos='0 0 .3' euler='0 40 0'><joint name='h' axis='1 1 0' damping='2' stiffness='3' springref='20'/>
              <geom type='capsule' size='.04 .1'/></body></body></body>""",
    "two trees on the world": """
        <body pos='0 0 .4'><joint name='h' axis='0 1 0' damping='.1'/><geom type='capsule' size='.05 .2' pos='.2 0 0'/>
          <body pos='.4 0 0'><joint axis='0 1 1'/><geom type='capsule' size='.05 .2' pos='.2 0 0'/></body></body>
        <body pos='.5 .1 .5'><joint type='slide' axis='0 0 1'/><joint type='slide' axis='1 0 0'/>
          <geom type='capsule' size='.06 .3' euler='0 90 0'/></body>""",
    "parallel capsules": """
        <body pos='0 0 1'><joint type='slide' name='h' axis='0 0 1'/>
          <geom type='capsule' size='.1 .3' euler='0 90 0'/></body>
        <body pos='.1 0 1.19'><joint type='slide' axis='0 0 1'/>
          <geom type='capsule' size='.1 .2' euler='0 90 0'/></body>""",
    "nearly parallel capsules, one beyond the other's end": """
        <body pos='0 0 1'><joint type='slide' name='h' axis='0 0 1'/>
          <geom type='capsule' size='.1 .3' euler='0 90 0'/></body>
        <body pos='.4 0 1.19'><joint type='slide' axis='0 0 1'/>
          <geom type='capsule' size='.1 .2' euler='0 -89.999 0'/></body>""",
    "capsules that are parallel no more": """
        <body pos='0 0 1'><joint type='slide' name='h' axis='0 0 1'/>
          <geom type='capsule' size='.1 .3' euler='0 90 0'/></body>
        <body pos='.1 0 1.19'><joint type='slide' axis='0 0 1'/>
          <geom type='capsule' size='.1 .2' euler='0 90.01 0'/></body>""",
    "crossing capsules": """
        <body pos='0 0 1'><joint type='slide' name='h' axis='1 0 0'/><joint type='slide' axis='0 1 0'/>
          <geom type='capsule' size='.1 .3' euler='0 80 0'/></body>
        <body pos='0 0 1'><joint type='slide' axis='0 0 1'/>
          <geom type='capsule' size='.1 .2' euler='0 20 0'/></body>""",
    "spheres and a fixed capsule": """
        <geom type='capsule' size='.1 .3' pos='0 0 .5' euler='0 90 0' condim='1'/>
        <body pos='.1 .02 .68'><joint type='slide' name='h' axis='0 0 1'/><joint axis='0 1 0'/><geom size='.1'/></body>
        <body pos='.2 .05 .85'><joint type='slide' axis='0 0 1'/><joint type='slide' axis='1 0 0'/>
          <geom size='.1'/></body>""",
}


CONTACTS = dict(zip(list(SMALL)[3:], (2, 2, 1, 1, 2), strict=True))  # of the reference pose


@pytest.mark.parametrize("kind", SMALL)
@pytest.mark.parametrize("integrator", ["Euler", pytest.param("RK4", marks=pytest.mark.full)])
def test_small_models_step_as_in_mujoco(kind, integrator):
    motor = "<actuator><motor joint='h' gear='3'/></actuator>" if "'h'" in SMALL[kind] else ""
    floor = "<geom type='plane' size='5 5 1' margin='.01'/>"
    option = f"<option integrator='{integrator}' timestep='.005' tolerance='0'/>"
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}<worldbody>{floor}{SMALL[kind]}</worldbody>{motor}</mujoco>"
    )
    rng = np.random.default_rng(0)
    rows = np.zeros((60, model.nq + 2 * model.nv + model.nu))
    rows[:, : model.nq] = model.qpos0
    rows[::2, model.nq : model.nq + model.nv] = 0.3 * rng.normal(size=(30, model.nv))
    rows[:, model.nq + 2 * model.nv :] = rng.uniform(-1, 1, (60, model.nu))
    readout = {name: READOUT[name] for name in ("xpos", "xquat", "cfrc_ext", "cvel")}
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == CONTACTS.get(kind, data.ncon)
    check(by_fused(model, rows, 4, readout), by_c(model, rows, 4, readout), 1e-9, 0.02)


# -- promises --


def ants(count: int, seed: int = 0) -> tuple[PhysicsState, jax.Array]:
    rows = anywhere(walls.model(), count, 0.1, 1.0)
    order = np.random.default_rng(seed).permutation(count)
    return split(walls.model(), rows[order].astype(np.float32))


def engine(**options):
    readout = {"torso": ("xpos", 1), "forces": ("cfrc_ext", slice(None))}
    return physics.make_engine(walls.model(), substeps=5, readout=readout, physics="fused", **options)


def assert_same(a, b) -> None:
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_numbers_do_not_depend_on_threads_order_or_neighbours():
    state, ctrl = ants(37)
    lone = jax.jit(jax.vmap(engine(threads=1).step))(state, ctrl)
    for threads in (2, 5):
        assert_same(lone, jax.jit(jax.vmap(engine(threads=threads).step))(state, ctrl))
    step = jax.jit(jax.vmap(engine().step))
    order = np.random.default_rng(3).permutation(37)
    shuffled = step(*jax.tree.map(lambda x: x[order], (state, ctrl)))
    assert_same(jax.tree.map(lambda x: x[order], lone), shuffled)
    first = jax.tree.map(lambda x: x[:1], (state, ctrl))
    assert_same(jax.tree.map(lambda x: x[:1], lone), step(*first))


def test_a_robot_whose_contacts_couple_branches_does_not_depend_on_its_neighbours():
    model, substeps = model_of("humanoid")
    rows = np.concatenate([states("humanoid", "visited")[:100], states("humanoid", "on the ground")[:100]])
    order = np.random.default_rng(0).permutation(len(rows))
    ours, again = by_fused(model, rows, substeps), by_fused(model, rows[order], substeps)
    for name in ours:
        np.testing.assert_array_equal(ours[name][order], again[name])


def test_nested_vmap_unbatched_arguments_and_no_vmap_agree():
    state, ctrl = ants(6)
    step = engine().step
    flat = jax.jit(jax.vmap(step))(state, ctrl)
    nested = jax.jit(jax.vmap(jax.vmap(step)))(*jax.tree.map(lambda x: x.reshape(2, 3, -1), (state, ctrl)))
    assert_same(flat, jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), nested))
    shared = jax.jit(jax.vmap(step, in_axes=(0, None)))(state, ctrl[0])
    assert_same(shared, jax.jit(jax.vmap(step))(state, jnp.tile(ctrl[0], (6, 1))))
    assert_same(step(*jax.tree.map(lambda x: x[0], (state, ctrl))), jax.tree.map(lambda x: x[0], flat))
    none = jax.jit(jax.vmap(step))(*jax.tree.map(lambda x: x[:0], (state, ctrl)))
    assert none[0].qpos.shape == (0, 15)


def test_a_broken_world_stays_broken_and_leaves_its_neighbours_alone():
    state, ctrl = ants(24)
    step = jax.jit(jax.vmap(engine().step))
    healthy = step(state, ctrl)
    broken = PhysicsState(
        state.qpos.at[2, 4].set(jnp.nan),
        state.qvel.at[4].set(1e9).at[5, 0].set(3e38),
        state.warmstart.at[7].set(jnp.inf),
    )
    after, out = step(broken, ctrl.at[6, 0].set(jnp.nan))
    for row in (2, 6, 7):
        assert np.isnan(after.qpos[row]).all() and np.isnan(after.qvel[row]).all() and np.isnan(out["torso"][row]).all()
    for row in (4, 5):  # blows up on the way
        assert not (np.isfinite(after.qpos[row]).all() and np.abs(after.qpos[row]).max() < 1e3)
    kept = np.setdiff1d(np.arange(24), (2, 4, 5, 6, 7))
    assert_same(*(jax.tree.map(lambda x: x[kept], results) for results in ((after, out), healthy)))


def test_more_contacts_than_there_is_room_for_are_reported():
    rows = np.concatenate([anywhere(walls.model(), 40, 0.02, 0.2), anywhere(walls.model(), 40, 9.0, 9.5)])
    rows[:, 15:] = 0
    ours = by_fused(walls.model(), rows, 1, {}, contacts=2)["overflow"]
    data = mujoco.MjData(walls.model())
    for row, overflow in zip(rows, ours, strict=True):
        data.qpos[:] = row[:15]
        mujoco.mj_forward(walls.model(), data)
        assert overflow or data.ncon <= 2  # the integrator's later stages may have more
    assert ours[:40].any() and not ours[40:].any()


@pytest.mark.full
def test_episodes_of_random_policies_have_the_statistics_of_c():
    from scipy import stats

    from envs.vector import VectorEnv

    found = {}
    for name in ("mujoco", "fused"):
        vector = VectorEnv(envs.make("ant_2x4", physics=name), 64, horizon=60)

        def advance(carry, key, vector=vector):
            state, total, length, cost, alive = carry
            action = jax.random.uniform(key, (64, 2, 4), minval=-1.0, maxval=1.0)
            state, outcome = vector.step(state, action)
            total, length = total + alive * outcome.reward, length + alive
            cost = cost + alive * outcome.cost[:, 0, 0]
            return (state, total, length, cost, alive & ~outcome.terminated), None

        def episodes(key, vector=vector, advance=advance):
            zero = jnp.zeros(64)
            start = (vector.reset(key), zero, zero, zero, jnp.ones(64, bool))
            return jax.lax.scan(advance, start, jax.random.split(key, 60))[0][1:4]

        found[name] = jax.device_get(jax.jit(jax.vmap(episodes))(jax.random.split(jax.random.key(0), 4)))
    for ours, theirs in zip(found["fused"], found["mujoco"], strict=True):
        assert stats.ks_2samp(ours.ravel(), theirs.ravel()).pvalue > 0.01


# -- refusals --

FLOOR = "<geom type='plane' size='1 1 1'/>"
REFUSED = {
    "joint 'b' is a ball joint": "<body><joint name='b' type='ball'/><geom size='.1'/></body>",
    "dry friction": "<body><joint frictionloss='1'/><geom size='.1'/></body>",
    "gravity compensation": "<body gravcomp='1'><joint/><geom size='.1'/></body>",
    "free joint beside other trees": "<body><freejoint/><geom size='.1'/></body><body><joint/><geom size='.1'/></body>",
    "(plane and box)": FLOOR + "<body pos='0 0 1'><joint/><geom type='box' size='.1 .1 .1'/></body>",
    "condim 4": FLOOR + "<body pos='0 0 1'><joint/><geom size='.1' condim='4'/></body>",
    "not horizontal": "<geom type='plane' size='1 1 1' euler='9 0 0'/><body><joint/><geom size='.1'/></body>",
    "fixed to the world": "<geom size='.1'/><body pos='0 0 1'><freejoint/><geom size='.1'/></body>",
    "unusual solref or solimp": """<geom type='plane' size='1 1 1'/>
        <body pos='0 0 1'><joint/><geom size='.1' solimp='.9 .95 .001 .3 1'/></body>""",
}
OPTIONS = {
    "elliptic friction cones": "<option cone='elliptic'/>",
    "neither Euler nor RK4": "<option integrator='implicitfast'/>",
    "disable or enable flags": "<option><flag contact='disable'/></option>",
    "not Newton's": "<option solver='CG'/>",
    "wind": "<option density='1' wind='1 0 0'/>",
    "gravity is not along z": "<option gravity='1 0 -9'/>",
}
PARTS = {
    "tendons": "<tendon><fixed><joint joint='j' coef='1'/></fixed></tendon>",
    "equality constraints": "<equality><joint joint1='j'/></equality>",
    "is no plain motor": "<actuator><position joint='j'/></actuator>",
}
PLAIN = "<body><joint name='j'/><geom size='.1'/></body>"


def small(world: str = PLAIN, option: str = "", parts: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{world}</worldbody>{parts}</mujoco>")


@pytest.mark.parametrize(
    ("words", "model"),
    [
        *((words, {"option": option}) for words, option in OPTIONS.items()),
        *((words, {"parts": parts}) for words, parts in PARTS.items()),
    ],
)
def test_what_it_cannot_step_is_refused_by_name_and_left_to_mujoco(words, model):
    model = small(**model)
    with pytest.raises(TaskError) as refusal:
        physics.make_engine(model, substeps=1, readout={}, physics="fused")
    assert words in str(refusal.value) and "physics 'fused' cannot step this model" in str(refusal.value)
    assert physics.make_engine(model, substeps=1, readout={}).name == "mujoco"
    assert physics.advice(model) is None


def test_readouts_it_does_not_know_are_refused_by_name():
    for field, words in (("sensordata", "is sensordata"), ("cfrc_int", "is cfrc_int")):
        with pytest.raises(TaskError, match=words):
            physics.make_engine(small(), substeps=1, readout={"x": (field, 0)}, physics="fused")
    welded = small("<body><joint/><geom size='.1'/><body pos='1 0 0'><geom size='.1'/></body></body>")
    with pytest.raises(TaskError, match="centre of mass of a body without joints"):
        physics.make_engine(welded, substeps=1, readout={"x": ("subtree_com", 2)}, physics="fused")


def test_hands_and_solid_walls_take_mujoco():
    assert envs.make("hand_over_2x6").engine == "mujoco"
    assert envs.make("ant_2x4", walls="solid").engine == "mujoco"
    with pytest.raises(TaskError, match="physics 'fused' cannot step this model: it has tendons"):
        envs.make("hand_over_2x6", physics="fused")
    assert envs.make("ant_2x4", walls="costly").engine == envs.make("velocity_hopper_3x1").engine == "fused"


# -- compiling --


def script(folder: pathlib.Path, name: str, text: str) -> pathlib.Path:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)
    return path


SAYS_WHAT_IT_IS = 'if [ "$1" = --version ]; then echo "fake 1.0"; exit 0; fi\n'
FAILING = SAYS_WHAT_IT_IS + 'echo "model.h:1: error: no memory" >&2; exit 1'
GARBLING = SAYS_WHAT_IT_IS + 'while [ "$1" != -o ]; do shift; done; echo garbage > "$2"'


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """No compiler but those that a test puts into the folder it gets, an empty cache, nothing that failed before."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "cache").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(native.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(native, "_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(native, "_failures", {})
    return tmp_path / "bin"


def small_code(*bodies: str) -> native.Code:
    return cpu.code(header(tables_of.tables(small(*bodies), 1, {})))


def real_compiler() -> str:
    return next(native.compilers()).command[0]


def test_without_a_compiler_mujoco_steps_and_one_sentence_says_what_is_gained(fresh, cli):
    env = envs.make("ant_2x4")
    assert env.engine == "mujoco" and physics.resolve("auto") == "mujoco"
    assert "'fused' steps this model" in tasks.advice(env) and "found none (install g++" in tasks.advice(env)
    assert tasks.advice(envs.make("hand_over_2x6")) is None and tasks.advice(envs.make("lane")) is None
    with pytest.raises(TaskError, match=r"physics 'fused' needs a C\+\+ compiler; found none"):
        envs.make("ant_2x4", physics="fused")
    code, text, _ = cli("doctor")
    assert code == 0 and "needs a C++ compiler; found none" in text


@pytest.mark.parametrize("text", [FAILING, GARBLING], ids=["fails", "writes garbage"])
def test_compilers_that_do_not_work_end_in_mujoco_and_a_sentence(fresh, text):
    script(fresh, "c++", text)
    env = envs.make("ant_2x4")
    assert env.engine == "mujoco"
    assert "could not be compiled" in tasks.advice(env) and "c++" in tasks.advice(env)
    with pytest.raises(TaskError, match="physics 'fused' could not be compiled"):
        envs.make("ant_2x4", physics="fused")
    assert not list(native._folder().iterdir()), "it left something behind"


@pytest.mark.parametrize("text", [FAILING, GARBLING, "exit 1"], ids=["fails", "writes garbage", "is no compiler"])
def test_after_a_compiler_that_does_not_work_the_next_one_is_taken(fresh, text, monkeypatch):
    monkeypatch.undo()
    compiler = real_compiler()
    monkeypatch.setenv("CXX", str(script(fresh, "mine", text)))
    monkeypatch.setattr(native, "_folder", lambda: fresh.parent / "cache")
    lines = []
    with tasks.announcing(lines.append):
        path = native.library(small_code())
    assert path.exists() and lines[-1] == f"compiling the physics ({compiler}) ..."
    with tasks.announcing(lines.append):
        assert native.library(small_code()) == path
    assert lines[-1] != f"compiling the physics ({compiler}) ..." or len(lines) <= 2


def test_the_key_of_the_cache_has_all_that_the_library_depends_on(monkeypatch):
    compiler, code = next(native.compilers()), cpu.code("tables", "double")
    keys = [native._key(compiler, code), native._key(compiler, cpu.code("other tables", "double"))]
    keys += [native._key(compiler, cpu.code("tables", "float")), native._key(compiler._replace(version="2"), code)]
    monkeypatch.setattr(native, "cpu_flags", lambda: "of another CPU")
    keys.append(native._key(compiler, code))
    monkeypatch.setattr(jax.lib, "__version__", "0.0.1")
    keys.append(native._key(compiler, code))
    assert len(set(keys)) == len(keys)


def test_a_damaged_library_is_compiled_anew(monkeypatch, tmp_path):
    monkeypatch.setattr(native, "_folder", lambda: tmp_path)
    made = small_code("<body><joint/><geom size='.2'/></body>")
    path = native.library(made)
    path.write_bytes(b"half a libr")
    assert native.library(made) == path and path.stat().st_size > 1000


STEP = """
import jax, mujoco
from envs import physics
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><joint/><geom size='.1' pos='1 0 0'/></body></worldbody></mujoco>")
engine = physics.make_engine(model, substeps=1, readout={})
state, _ = jax.jit(engine.step)(engine.start(), jax.numpy.zeros(0))
print(engine.name, state.qpos)
"""


def started(**environment: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", textwrap.dedent(STEP)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=ROOT, env=os.environ | environment, **pipes)


def test_processes_that_compile_at_once_both_step(tmp_path):
    both = [started(XDG_CACHE_HOME=str(tmp_path)) for _ in range(2)]
    answers = [process.communicate(timeout=300) for process in both]
    assert all(out.startswith("fused") for out, _ in answers) and len({out for out, _ in answers}) == 1, answers
    folder = tmp_path / "pmt-jax" / "fused"
    assert [path.suffix for path in folder.iterdir() if path.name != "zig"] == [".so"]


def test_a_home_that_cannot_be_written_is_no_obstacle(tmp_path):
    (tmp_path / "file").touch()  # no folder can be made below it, not even by root
    out, error = started(XDG_CACHE_HOME=str(tmp_path / "file")).communicate(timeout=300)
    assert out.startswith("fused"), error
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
