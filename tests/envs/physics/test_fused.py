"""The engine `fused` against MuJoCo's C engine, its promises beyond numbers, and how it is compiled."""

from __future__ import annotations

import concurrent.futures
import os
import pathlib
import shutil
import stat
import subprocess
import sys
import textwrap
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import native, physics
from envs.ant import walls
from envs.errors import TaskError
from envs.multi_goal import models as goals
from envs.physics.contract import PhysicsState
from envs.physics.fused import cpu
from envs.physics.fused import model as tables_of
from envs.physics.fused.header import header
from envs.physics.fused_engine import FusedEngine
from envs.velocity import robots
from paths import ROOT
from pmt_jax import tasks
from stepping import (
    answers,
    anywhere,
    assert_batches_agree,
    assert_same,
    by_c,
    by_robot,
    check,
    compiled,
    crowded,
    exact,
    kinds,
    model_of,
    readout_of,
    states,
    sweep,
)

pytestmark = compiled


def split(model: mujoco.MjModel, rows: np.ndarray) -> tuple[PhysicsState, jax.Array]:
    """Rows [n, qpos qvel warm start ctrl] as a state and controls."""
    ends = np.cumsum([model.nq, model.nv, model.nv])
    qpos, qvel, warm, ctrl = (jnp.asarray(part) for part in np.split(rows, ends, axis=1))
    return PhysicsState(qpos, qvel, warm), ctrl


def by_fused(model: mujoco.MjModel, rows: np.ndarray, substeps: int, readout: dict, **options):
    """What the engine makes of the rows, in double precision throughout."""
    with jax.enable_x64(True):
        step = jax.jit(jax.vmap(FusedEngine(model, substeps, readout, **options).step))
        state, out = step(*split(model, rows))
        found = {"qpos": state.qpos, "qvel": state.qvel, "warmstart": state.warmstart} | out
        return {name: np.asarray(value) for name, value in found.items()}


# -- numbers --


# By default one robot, for each compiles for seconds; the other schedule has another.
@pytest.mark.parametrize(("robot", "kind", "full"), sweep("walls"))
def test_a_control_step_and_its_readouts_are_mujocos(robot, kind, full, monkeypatch):
    if full:  # as users compile it, with all optimisations
        monkeypatch.setenv("CXX", os.environ.get("CXX", "").removesuffix(" -O1"))
    model, substeps = model_of(robot)
    ours = by_fused(model, states(robot, kind, full), substeps, readout_of(model))
    check(ours, answers(robot, kind, full), 1e-9, 0.01 if full else 0.05)
    assert not ours["overflow"].any()


@pytest.mark.parametrize("robot", by_robot(full=("humanoid",)))
def test_the_acceleration_is_mujocos(robot):
    """Of the very state: Euler's warm start after one substep. (By default `test_fused_threads` has it.)"""
    model, _ = model_of(robot)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for kind in kinds(robot):
        rows = states(robot, kind, True)
        ours, theirs = by_fused(model, rows, 1, {}), by_c(model, rows, 1, {})
        check({"warmstart": ours["warmstart"]}, {"warmstart": theirs["warmstart"]}, 1e-8, 0.01)


@pytest.mark.parametrize("robot", by_robot(full=("walls",)))
def test_the_float_build_is_mujocos_within_its_rounding(robot):
    """The GPU computes with the same formulae in float."""
    model, substeps = model_of(robot)
    made = tables_of.tables(model, substeps, {})
    step = jax.jit(cpu.make_step(made, 0, "float"))
    for kind in [kind for kind in kinds(robot) if "margins" not in kind][:2]:  # there rounding decides
        rows = states(robot, kind, True).astype(np.float32)
        state, ctrl = split(model, rows)
        qpos, qvel, *_ = step(state.qpos, state.qvel, state.warmstart, ctrl)
        theirs = by_c(model, rows.astype(np.float64), substeps, {})
        share = 0.05 if kind == "walls" else 0.02  # deep in a wall, and 130 m from the origin
        check({"qpos": qpos, "qvel": qvel}, {k: theirs[k] for k in ("qpos", "qvel")}, 5e-5, share)


@pytest.mark.parametrize(
    ("robot", "vases"),
    [
        *(pytest.param("point", count, marks=pytest.mark.slow) for count in (0, 1, 10)),
        *(pytest.param(*x, marks=pytest.mark.full) for x in (("point", 2), ("ant", 4))),
        *(pytest.param("ant", count, marks=pytest.mark.slow) for count in (0, 1)),
    ],
)
def test_robots_and_vases_that_touch_step_as_in_c(robot, vases):
    """Two robots among vases: several trees, boxes, all six directions of contacts, and a forward pass at the end."""
    model, rows = exact(goals.model(robot, 2, vases, 1.5)), crowded(robot, vases, 90)
    readout = {
        "qacc": ("qacc", slice(None)),
        "forces": ("cfrc_ext", slice(1, None)),
        "motors": ("qfrc_actuator", slice(None)),
    }
    theirs = by_c(model, rows, 0, readout, forward=True)
    assert (np.abs(theirs["forces"]).max((1, 2)) > 0).mean() > 0.3
    theirs |= {"warmstart": rows[:, -model.nv - model.nu : len(rows[0]) - model.nu]}
    found = by_fused(model, rows, 0, readout, forward=True)
    # Arrows lie at one height. Where they overlap least upwards, rounding decides which of them is pushed up.
    check(found, {"forces": theirs.pop("forces")}, 1e-8, 0.1)
    check(found, theirs, 1e-8, 0.02)
    ours = by_fused(model, rows, goals.SUBSTEPS, readout, forward=True)
    theirs = by_c(model, rows, goals.SUBSTEPS, readout, forward=True)
    check(ours, {"forces": theirs.pop("forces")}, 1e-6, 0.1)
    check(ours, theirs, 1e-6, 0.05)
    assert not ours["overflow"].any()
    order = np.random.default_rng(0).permutation(len(rows))
    mixed = rows[order]  # with other neighbours, some of them broken
    mixed[::9, 1] = np.nan
    again, whole = by_fused(model, mixed, goals.SUBSTEPS, readout, forward=True), np.isfinite(mixed).all(axis=1)
    for name in ours:
        np.testing.assert_array_equal(ours[name][order][whole], again[name][whole])


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
    "a capsule that crosses a fixed box": """
        <geom type='box' size='.2 .1 .3' pos='0 0 .5' euler='0 0 10' condim='1'/>
        <body pos='.05 .02 .87'><joint type='slide' name='h' axis='0 0 1'/><joint axis='1 0 0'/><joint axis='0 1 0'/>
          <geom type='capsule' size='.08 .4' euler='88 0 0'/></body>""",
    "spheres on and in a box that moves": """
        <body pos='0 0 1'><joint type='slide' axis='0 0 1'/><joint name='h' axis='0 1 0' stiffness='9' damping='.1'/>
          <geom type='box' size='.4 .3 .1' contype='2' conaffinity='2'/></body>
        <body pos='.1 0 1.19'><joint type='slide' axis='0 0 1'/><joint axis='0 1 0'/>
          <geom size='.1' contype='3' conaffinity='3'/></body>
        <body pos='-.2 0 1.05'><joint type='slide' axis='0 0 1'/>
          <geom size='.1' contype='3' conaffinity='3'/></body>""",
    "a free box on a chain of spheres": """
        <body pos='0 0 .3'><freejoint/><geom type='box' size='.1 .2 .05' contype='2' conaffinity='2'/>
          <body pos='.1 0 .2'><joint name='h' axis='1 0 0'/><geom size='.04' contype='1' conaffinity='1'/>
            <body pos='-.05 .1 0'><joint axis='0 1 0'/>
              <geom type='capsule' size='.03 .1' pos='0 0 -.08' contype='3' conaffinity='3'/></body></body></body>""",
    "boxes on the floor, on one another and on a fixed box": """
        <geom type='box' size='.2 .2 .1' pos='0 0 .1'/>
        <body pos='.15 .03 .299' euler='0 0 20'><freejoint/><geom type='box' size='.1 .12 .1' condim='6'/></body>
        <body pos='.6 0 .0995' euler='0 0 30'><freejoint/><geom type='box' size='.1 .1 .1'/></body>
        <body pos='.65 .02 .2985'><freejoint/><geom type='box' size='.1 .1 .1' condim='4'/></body>""",
    "free roots, contacts of all sizes, a fixed ball and servos": """
        <geom size='.1' pos='0 0 .1'/>
        <body pos='.195 0 .1' euler='10 20 30'><freejoint/><geom size='.1' condim='6' friction='.8 .02 .01'/></body>
        <body pos='.388 0 .1'><freejoint/><geom type='capsule' size='.1 .1' euler='80 0 0' condim='4'/></body>
        <body pos='.54 0 .2'><joint name='h' axis='0 1 0' stiffness='1'/><geom type='capsule' size='.06 .1' condim='1'/>
          <body pos='0 0 .2'><joint name='i' type='slide' axis='0 1 1' damping='.1'/>
            <geom type='box' size='.1 .05 .04'/><site name='s' pos='.1 .05 0' euler='10 20 30'/></body></body>""",
}
SERVOS = """<position joint='h' kp='2' kv='.1' forcerange='-1 1'/><velocity joint='i' kv='.3' gear='2'/>
    <general site='s' gear='1 .5 -.3 .2 .1 .4' biastype='affine' biasprm='.1 0 -.2' ctrlrange='-1 1'
      forcerange='-.6 .6'/>"""


CONTACTS = dict(zip(list(SMALL)[3:], (2, 2, 1, 1, 2, 2, 2, 1, 14, 5), strict=True))  # of the reference pose


THIN_SMALL = (10,)  # the default tests of the other schedule have most of the rest


@pytest.mark.parametrize(
    ("integrator", "kind"),
    [
        *(pytest.param("Euler", x, marks=() if k in THIN_SMALL else pytest.mark.full) for k, x in enumerate(SMALL)),
        *(pytest.param("RK4", x, marks=pytest.mark.slow) for x in SMALL),  # which the robots have
    ],
)
def test_small_models_step_as_in_mujoco(integrator, kind):
    motor = "<motor joint='h' gear='3'/>" if "'h'" in SMALL[kind] else ""
    motors = f"<actuator>{SERVOS if 'servos' in kind else motor}</actuator>"
    floor = "<geom type='plane' size='5 5 1' margin='.01'/>"
    option = f"<option integrator='{integrator}' timestep='.005' tolerance='0'/>"
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}<worldbody>{floor}{SMALL[kind]}</worldbody>{motors}</mujoco>"
    )
    rng = np.random.default_rng(0)
    rows = np.zeros((60, model.nq + 2 * model.nv + model.nu))
    rows[:, : model.nq] = model.qpos0
    rows[::2, model.nq : model.nq + model.nv] = 0.3 * rng.normal(size=(30, model.nv))
    rows[:, model.nq + 2 * model.nv :] = rng.uniform(-1, 1, (60, model.nu))
    readout = {name: readout_of(model)[name] for name in ("xpos", "xquat", "cfrc_ext", "cvel")}
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
    """The corridor's, with what it reads: it is compiled once for all tests."""
    readout = {"torso": ("xpos", 1), "attitude": ("xquat", 1), "forces": ("cfrc_ext", slice(None))}
    return physics.make_engine(walls.model(), substeps=5, readout=readout, physics="fused", **options)


@pytest.mark.full
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


@pytest.mark.parametrize(
    ("robot", "others"),
    [("walls", ("walls",)), pytest.param("humanoid", ("visited", "on the ground"), marks=pytest.mark.full)],
)
def test_no_world_depends_on_its_neighbours(robot, others):
    """Of robots whose contacts couple branches, and that touch walls: their neighbours may have other contacts."""
    model, substeps = model_of(robot)
    rows = np.concatenate([states(robot, kind)[:70] for kind in others])
    order = np.random.default_rng(0).permutation(len(rows))
    mixed = rows[order]
    mixed[::9, 1] = np.nan
    ours, again = (by_fused(model, given, substeps, readout_of(model)) for given in (rows, mixed))
    whole = np.isfinite(mixed).all(axis=1)
    for name in ours:
        np.testing.assert_array_equal(ours[name][order][whole], again[name][whole])
    assert np.isnan(again["qpos"][~whole]).all()


@pytest.mark.full
def test_single_precision_outside_costs_half_a_micrometre():
    """Numbers inside are double, whatever the arrays are."""
    rows = states("corridor", "visited").astype(np.float32)
    state, ctrl = split(walls.model(), rows)
    assert state.qpos.dtype == jnp.float32
    after, _ = jax.jit(jax.vmap(engine().step))(state, ctrl)
    right = by_c(model_of("corridor")[0], rows.astype(float), 5, {})
    assert np.abs(after.qpos - right["qpos"]).max() < 5e-7


def test_calls_at_once_do_not_wait_for_one_another():
    """XLA's pool has no more threads than CPUs, and each call takes as many as it gets."""
    state, ctrl = ants(64)
    step = jax.jit(jax.vmap(engine().step))
    expected = step(state, ctrl)
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        for found in pool.map(lambda _: jax.block_until_ready(step(state, ctrl)), range(24)):
            assert_same(expected, found)


def test_nested_vmap_unbatched_arguments_and_no_vmap_agree():
    state, ctrl = ants(6)
    step = engine().step
    assert_batches_agree(step, state, ctrl)
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


CROWDED = """<mujoco><worldbody><geom type='plane' size='9 9 1'/><geom type='box' size='.1 .1 .1' pos='.3 0 .1'/>
  <body pos='0 0 .1'><joint type='slide' axis='0 0 1'/><geom size='.1'/></body>
  <body pos='.3 0 .3'><joint type='slide' axis='0 0 1'/><geom size='.1'/><geom size='.1' pos='9 0 -.2'/></body>
  <body pos='.3 0 .5'><joint type='slide' axis='0 0 1'/><geom size='.1'/></body></worldbody></mujoco>"""


@pytest.mark.full
def test_more_contacts_than_there_is_room_for_are_reported():
    """With the floor, with a box, and with one another."""
    model = mujoco.MjModel.from_xml_string(CROWDED)
    rows = np.zeros((60, model.nq + 2 * model.nv))
    rows[:, :3] = np.random.default_rng(0).uniform(-0.05, 0.02, (60, 3))
    rows[40:, :3] = (1, 2, 3)  # above all, and apart
    ours = by_fused(model, rows, 1, {}, contacts=2)["overflow"]
    data, counts = mujoco.MjData(model), []
    for row in rows:
        data.qpos[:] = row[:3]
        mujoco.mj_forward(model, data)
        counts.append(data.ncon)
    np.testing.assert_array_equal(ours, np.array(counts) > 2)
    assert 10 < ours.sum() < 40 and max(counts) == 4


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
STIFF = "<joint armature='1'/>"
REFUSED = {
    "joint 'b' is a ball joint": "<body><joint name='b' type='ball'/><geom size='.1'/></body>",
    "dry friction": "<body><joint frictionloss='1'/><geom size='.1'/></body>",
    "gravity compensation": "<body gravcomp='1'><joint/><geom size='.1'/></body>",
    "free joint with a spring": "<body><joint type='free' stiffness='1'/><geom size='.1'/></body>",
    "(plane and cylinder)": FLOOR + "<body pos='0 0 1'><joint/><geom type='cylinder' size='.1 .1'/></body>",
    "130 degrees of freedom": 26 * f"<body>{5 * STIFF}<geom size='.1' contype='0'/></body>",
    "not horizontal": "<geom type='plane' size='1 1 1' euler='9 0 0'/><body><joint/><geom size='.1'/></body>",
    "(ellipsoid and box)": """<geom type='box' size='1 1 1'/>
        <body><joint/><geom type='ellipsoid' size='.1 .2 .3'/></body>""",
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
    "is no motor, position or speed servo": "<actuator><general joint='j' gaintype='affine'/></actuator>",
    "'at' is no motor, position or speed servo": "<actuator><general name='at' site='s' refsite='r'/></actuator>",
}
PLAIN = "<site name='r'/><body><joint name='j'/><geom size='.1'/><site name='s'/></body>"


def small(world: str = PLAIN, option: str = "", parts: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{world}</worldbody>{parts}</mujoco>")


@pytest.mark.parametrize(
    ("words", "model"),
    [
        *((words, {"world": world}) for words, world in REFUSED.items()),
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


def test_robots_take_fused_and_hands_and_large_crowds_take_mujoco():
    assert envs.make("hand_over_2x6").engine == "mujoco"
    with pytest.raises(TaskError, match="physics 'fused' cannot step this model: it has tendons"):
        envs.make("hand_over_2x6", physics="fused")
    for kind in walls.WALLS:
        assert physics.resolve("auto", walls.model(kind), {"torso": ("xpos", 1)}) == "fused"
    assert physics.resolve("auto", robots.model("hopper")) == "fused"
    for robot, number, vases, engine in (("point", 8, 4, "fused"), ("ant", 2, 10, "fused"), ("ant", 8, 4, "mujoco")):
        assert physics.resolve("auto", goals.model(robot, number, vases, 2.0), forward=True) == engine


# -- compiling --


def script(folder: pathlib.Path, name: str, text: str) -> pathlib.Path:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)
    return path


SAYS_WHAT_IT_IS = 'if [ "$1" = --version ]; then echo "fake 1.0"; exit 0; fi\n'
FAILING = SAYS_WHAT_IT_IS + 'echo "model.h:1: error: no memory" >&2; exit 1'
HANGING = SAYS_WHAT_IT_IS + "exec /bin/sleep 60"
COPYING = 'while [ "$1" != -o ]; do shift; done; /bin/cp {} "$2"'
GARBLING = SAYS_WHAT_IT_IS + 'while [ "$1" != -o ]; do shift; done; echo garbage > "$2"'


@pytest.fixture(scope="module")
def small_library() -> pathlib.Path:
    """What a compiler makes of `small()`."""
    return native.library(small_code())


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """No compiler but those that a test puts into the folder it gets, an empty cache, nothing that failed before."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "cache").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(native.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(native, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(native, "failures", {})
    return tmp_path / "bin"


def small_code(*bodies: str) -> native.Code:
    return cpu.code(header(tables_of.tables(small(*bodies), 1, {})))


def test_without_a_compiler_mujoco_steps_and_one_sentence_says_what_is_gained(fresh, cli, quick_doctor):
    env = envs.make("ant_2x4")
    assert env.engine == "mujoco" and physics.resolve("auto") == "mujoco"
    assert "'fused' steps this model" in tasks.advice(env) and "found none (install g++" in tasks.advice(env)
    assert tasks.advice(envs.make("hand_over_2x6")) is None and tasks.advice(envs.make("lane")) is None
    with pytest.raises(TaskError, match=r"physics 'fused' needs a C\+\+ compiler; found none"):
        envs.make("ant_2x4", physics="fused")
    code, text, _ = cli("doctor")
    assert code == 0 and "needs a C++ compiler; found none" in text


def test_compilers_are_asked_in_the_order_of_the_readme(fresh, monkeypatch):
    for name in ("clang++", "g++", "c++", "mine"):
        script(fresh, name, "echo fake 1.0")
    monkeypatch.setenv("CXX", str(fresh / "mine") + " -pipe")
    (fresh.parent / "ziglang").mkdir()
    script(fresh.parent / "ziglang", "zig", 'if [ "$2" = --version ]; then echo "clang of zig"; fi')
    place = types.SimpleNamespace(submodule_search_locations=[str(fresh.parent / "ziglang")])
    monkeypatch.setattr(native.importlib.util, "find_spec", lambda name: place)
    found = [[pathlib.Path(compiler.command[0]).name, *compiler.command[1:]] for compiler in native.compilers()]
    assert found == [["mine", "-pipe"], ["c++"], ["g++"], ["clang++"], ["zig", "c++"]]
    assert [compiler.version for compiler in native.compilers()] == 4 * ["fake 1.0"] + ["clang of zig"]


@pytest.mark.full
def test_flags_of_the_chosen_compiler_have_the_last_word(small_library, fresh, monkeypatch):
    told = fresh.parent / "told"
    says = 'case "$*" in *--version) echo "fake 1.0"; exit 0;; esac\n'
    mine = script(fresh, "mine", says + f'echo "$@" > {told}\n' + COPYING.format(small_library))
    monkeypatch.setenv("CXX", f"{mine} -O1")
    native.library(small_code())
    words = told.read_text().split()
    assert words.index("-O3") < words.index("-O1")


@pytest.mark.parametrize("text", [FAILING, GARBLING, HANGING], ids=["fails", "writes garbage", "hangs"])
def test_compilers_that_do_not_work_end_in_mujoco_and_a_sentence(fresh, text, monkeypatch):
    monkeypatch.setattr(native, "PATIENCE", 60.0 if text != HANGING else 0.2)
    script(fresh, "c++", text)
    env = envs.make("ant_2x4")
    assert env.engine == "mujoco"
    assert "could not be compiled" in tasks.advice(env) and "c++" in tasks.advice(env)
    with pytest.raises(TaskError, match="physics 'fused' could not be compiled"):
        envs.make("ant_2x4", physics="fused")
    assert not list(native.cache_folder().iterdir()), "it left something behind"


@pytest.mark.parametrize("text", [FAILING, GARBLING, "exit 1"], ids=["fails", "writes garbage", "is no compiler"])
def test_after_a_compiler_that_does_not_work_the_next_one_is_taken(small_library, fresh, text, monkeypatch):
    monkeypatch.setenv("CXX", str(script(fresh, "mine", text)))
    compiler = script(fresh, "c++", SAYS_WHAT_IT_IS + COPYING.format(small_library))
    lines, said = [], f"compiling the physics ({compiler}) ..."
    with tasks.announcing(lines.append):
        path = native.library(small_code())
    assert path.exists() and lines[-1] == said
    with tasks.announcing(lines.append):
        assert native.library(small_code()) == path
    assert lines.count(said) == 1


def test_the_key_of_the_cache_has_all_that_the_library_depends_on(monkeypatch):
    compiler, code = next(native.compilers()), cpu.code("tables", "double")
    keys = [native.key_of(compiler, code), native.key_of(compiler, cpu.code("other tables", "double"))]
    keys += [native.key_of(compiler, cpu.code("tables", "float")), native.key_of(compiler._replace(version="2"), code)]
    monkeypatch.setattr(native, "cpu_flags", lambda: "of another CPU")
    keys.append(native.key_of(compiler, code))
    monkeypatch.setattr(native, "installed_version", lambda name: f"{name} 0.0.1")
    keys.append(native.key_of(compiler, code))
    assert len(set(keys)) == len(keys)


def test_a_library_of_another_cpu_is_not_taken(small_library, fresh, monkeypatch, tmp_path):
    """As where a home is shared by machines: each finds its own."""
    made = small_code()
    script(fresh, "c++", SAYS_WHAT_IT_IS + COPYING.format(small_library) + f"; echo >> {tmp_path}/count")
    found = []
    for flags in ("avx2", "avx512f", "avx2"):
        monkeypatch.setattr(native, "cpu_flags", lambda flags=flags: flags)
        found.append(native.library(made))
    assert found[0] == found[2] != found[1] and (tmp_path / "count").read_text() == "\n\n"


@pytest.mark.full
@pytest.mark.parametrize("robot", ["walls", "humanoid"])
def test_it_compiles_for_aarch64(robot, tmp_path):
    """By a cross compiler, or by zig, where there is one; nothing here can run it."""
    cross = shutil.which("aarch64-linux-gnu-g++")
    zig = next((c.command for c in native.compilers() if c.command[-1] == "c++" and "zig" in c.command[0]), None)
    if not cross and not zig:
        pytest.skip("no compiler for aarch64 here")
    model, substeps = model_of(robot)
    (tmp_path / "model.h").write_text(header(tables_of.tables(model, substeps, readout_of(model))))
    chosen = [cross] if cross else [*zig, "-target", "aarch64-linux-gnu", "-nostdlib++"]
    paths = [
        "-isystem",
        jax.ffi.include_dir(),
        f"-I{tmp_path}",
        f"-I{cpu.HERE}",
        f"-I{native.HEADER.parent}",
        str(cpu.HERE / "lanes.cpp"),
    ]
    out = tmp_path / "step.so"
    command = [*chosen, *native.FLAGS, "-DREAL=double", '-DMODEL="model.h"', *paths, "-o", str(out)]
    subprocess.run(command, check=True, env=os.environ | {"ZIG_GLOBAL_CACHE_DIR": str(tmp_path / "zig")})
    machine = int.from_bytes(out.read_bytes()[18:20], "little")
    assert machine == 183  # EM_AARCH64


def test_a_damaged_library_is_compiled_anew(monkeypatch, tmp_path):
    monkeypatch.setattr(native, "cache_folder", lambda: tmp_path)
    made = small_code("<body><joint/><geom size='.2'/></body>")
    path = tmp_path / f"fused_{native.key_of(next(native.compilers()), made)}.so"
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


@pytest.mark.full
def test_processes_that_compile_at_once_both_step(tmp_path):
    both = [started(XDG_CACHE_HOME=str(tmp_path)) for _ in range(2)]
    answers = [process.communicate(timeout=300) for process in both]
    assert all(out.startswith("fused") for out, _ in answers) and len({out for out, _ in answers}) == 1, answers
    folder = tmp_path / "pmt-jax" / "fused"
    assert [path.suffix for path in folder.iterdir() if path.name != "zig"] == [".so"]


@pytest.mark.full
def test_a_home_that_cannot_be_written_is_no_obstacle(tmp_path):
    (tmp_path / "file").touch()  # no folder can be made below it, not even by root
    out, error = started(XDG_CACHE_HOME=str(tmp_path / "file")).communicate(timeout=300)
    assert out.startswith("fused"), error
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
