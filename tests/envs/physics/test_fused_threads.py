"""The step for GPUs (a warp a world), compiled for a CPU, against MuJoCo's C engine; and how its PTX is made."""

from __future__ import annotations

import copy
import functools

import mujoco
import numpy as np
import pytest

from envs.ant import corridor, walls
from envs.errors import TaskError
from envs.physics.fused import nvrtc, threads
from envs.physics.fused.model import FIELDS, Tables, obstacle, tables
from envs.velocity import robots
from threads_on_cpu import Rows, compiled, runner

READOUT = {field: (field, slice(None)) for field in FIELDS if field != "subtree_com"} | {"com": ("subtree_com", 1)}
FIRST = ("corridor", "hopper", "swimmer", "humanoid")  # between them they have all that the others have
FULL = ("ant", "half_cheetah", "walker2d")
every_robot = pytest.mark.parametrize("robot", [*FIRST, *(pytest.param(x, marks=pytest.mark.full) for x in FULL)])
States = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # qpos, qvel, warm start, ctrl


def exact(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose solver goes on to the end, where C would stop at an improvement of 1e-8."""
    model = copy.copy(model)
    model.opt.tolerance, model.opt.ls_tolerance = 0.0, 1e-6
    return model


def model_of(robot: str) -> tuple[mujoco.MjModel, int]:
    if robot == "corridor":
        return exact(walls.model()), corridor.SUBSTEPS
    return exact(robots.model(robot)), robots.ROBOTS[robot].substeps


@functools.cache
def made(robot: str) -> tuple[mujoco.MjModel, Tables]:
    model, substeps = model_of(robot)
    return model, tables(model, substeps, READOUT)


def by_c(model: mujoco.MjModel, made_of: Tables, states: States, substeps: int) -> Rows:
    """What MuJoCo makes of the states; no substeps: qacc."""
    data, rows = mujoco.MjData(model), []
    for qpos, qvel, warm, ctrl in zip(*states, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = qpos, qvel, warm, ctrl
        if substeps:
            mujoco.mj_step(model, data, substeps)
        else:
            mujoco.mj_forward(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        read = [np.asarray(getattr(data, r.field))[list(r.rows)].ravel() for r in made_of.readings.values()]
        warmstart = data.qacc_warmstart if substeps else data.qacc
        rows.append([data.qpos.copy(), data.qvel.copy(), warmstart.copy(), np.concatenate([np.zeros(0), *read])])
    return dict(zip(("qpos", "qvel", "warmstart", "read"), map(np.array, zip(*rows, strict=True)), strict=True))


def visited(model: mujoco.MjModel, substeps: int, count: int) -> States:
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
                rows.append([x.copy() for x in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl)])
            mujoco.mj_step(model, data, substeps)
    qpos, qvel, warm, ctrl = (np.array(x) for x in zip(*rows[:count], strict=True))
    return qpos, qvel, warm, ctrl


def anywhere(model: mujoco.MjModel, count: int, low: float = 0.05, high: float = 1.6) -> States:
    """States in any attitude, a free root `low` to `high` m over the floor, joints up to 0.2 beyond their limits."""
    rng = np.random.default_rng(1)
    qpos = np.tile(model.qpos0, (count, 1))
    for j in range(model.njnt):
        a, kind = model.jnt_qposadr[j], model.jnt_type[j]
        if kind == 0:
            quat = rng.normal(size=(count, 4))
            qpos[:, a + 2] = rng.uniform(low, high, count)
            qpos[:, a + 3 : a + 7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        elif model.jnt_limited[j]:
            qpos[:, a] = rng.uniform(model.jnt_range[j, 0] - 0.2, model.jnt_range[j, 1] + 0.2, count)
        else:
            qpos[:, a] += rng.uniform(-1.5, 1.5, count) if kind == 3 else rng.uniform(-0.5, 0.2, count)
    shape = (count, model.nv)
    return qpos, 2 * rng.normal(size=shape), np.zeros(shape), rng.uniform(-1.2, 1.2, (count, model.nu))


def on_margins(model: mujoco.MjModel, count: int) -> States:
    """States whose lowest point is 1e-7 m within or beyond its margin."""
    qpos, qvel, warm, ctrl = anywhere(model, count, 0.3, 0.3)
    up = next(
        int(model.jnt_qposadr[j]) for j in range(model.njnt) if model.jnt_type[j] == 0 or model.jnt_axis[j][2] == 1
    )
    up += 2 * (model.jnt_type[0] == 0)
    data = mujoco.MjData(model)
    for k, row in enumerate(qpos):
        row[up] -= 2.0  # far enough into the floor that all touches it
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        plane = [c.dist - c.includemargin for c in data.contact[: data.ncon] if c.geom[0] == 0]
        row[up] -= min(plane) + (1e-7 if k % 2 else -1e-7)
    return qpos, qvel, warm, ctrl


def error(found: np.ndarray, right: np.ndarray) -> np.ndarray:
    """[n], the largest in each row, relative to numbers above 1."""
    return (np.abs(found - right) / np.maximum(1.0, np.abs(right).max(axis=1, keepdims=True))).max(axis=1)


def check(model: mujoco.MjModel, made_of: Tables, states: States, loose: float = 0.97) -> None:
    """qacc, one control step and all readouts, in double precision. MuJoCo itself jumps at a margin: a few rows may."""
    run = runner(made_of, np.float64)
    right, found = by_c(model, made_of, states, 0), run(*states, whole=False)
    assert not found["overflow"].any()
    assert error(found["warmstart"], right["warmstart"]).max() < 1e-7
    assert np.median(error(found["warmstart"], right["warmstart"])) < 1e-12
    assert error(found["read"], right["read"]).max() < 1e-6
    right, found = by_c(model, made_of, states, made_of.substeps), run(*states)
    for name, tolerance in (("qpos", 1e-12), ("qvel", 1e-10), ("warmstart", 1e-8), ("read", 1e-8)):
        wrong = error(found[name], right[name])
        assert np.quantile(wrong, loose) < tolerance and wrong.max() < 1e-3, name


@compiled
@every_robot
def test_visited_states_step_as_in_c(robot):
    model, made_of = made(robot)
    check(model, made_of, visited(model, made_of.substeps, 100))


@compiled
@pytest.mark.full
@pytest.mark.parametrize("robot", [*FIRST, *FULL])
def test_six_hundred_visited_states_step_as_in_c(robot):
    model, made_of = made(robot)
    check(model, made_of, visited(model, made_of.substeps, 600))


@compiled
@every_robot
def test_any_attitude_and_violated_limits_step_as_in_c(robot):
    model, made_of = made(robot)
    check(model, made_of, anywhere(model, 60))


@compiled
@pytest.mark.parametrize("robot", ["corridor", "humanoid"])
def test_lying_on_the_floor_steps_as_in_c(robot):
    model, made_of = made(robot)
    states = anywhere(model, 20, 0.12, 0.12)
    assert by_c(model, made_of, states, 0)["read"].any()
    check(model, made_of, states, loose=0.8)


@compiled
@pytest.mark.parametrize("robot", ["corridor", "hopper"])
def test_contacts_on_their_margins_are_those_of_c(robot):
    model, made_of = made(robot)
    states, run = on_margins(model, 20), runner(made_of, np.float64)
    right, found = by_c(model, made_of, states, 0), run(*states, whole=False)
    assert error(found["warmstart"], right["warmstart"]).max() < 1e-7


@compiled
@every_robot
def test_single_precision_is_close(robot):
    model, made_of = made(robot)
    states = tuple(x.astype(np.float32).astype(float) for x in visited(model, made_of.substeps, 60))
    right, found = by_c(model, made_of, states, made_of.substeps), runner(made_of, np.float32)(*states)
    assert np.median(error(found["qpos"], right["qpos"])) < 1e-6
    assert np.quantile(error(found["qpos"], right["qpos"]), 0.95) < 2e-5
    assert np.quantile(error(found["qvel"], right["qvel"]), 0.95) < 1e-3


@compiled
def test_contacts_beyond_the_slots_are_reported():
    model, substeps = model_of("humanoid")
    made_of = tables(model, substeps, {}, contacts=2)
    low, high = anywhere(model, 8, 0.1, 0.1), anywhere(model, 8, 3.0, 3.0)
    qpos = high[0].copy()
    qpos[:, 7:] = model.qpos0[7:]
    run = runner(made_of, np.float64)
    assert run(*low)["overflow"].all() and not run(qpos, *high[1:])["overflow"].any()


# -- models that no task has --

FLOOR = "<geom type='plane' size='9 9 1'/>"
CROSSED = """<mujoco><option integrator='RK4'/><worldbody>{floor}<body pos='0 0 1'><freejoint/>
  <geom type='capsule' size='.1 .3'/><body pos='.5 0 0'><joint type='slide' axis='1 0 0'/>
  <geom type='sphere' size='.05' contype='0' conaffinity='0'/><body pos='-.5 0 0'><joint axis='1 0 0'/>
  <joint axis='0 1 0'/><geom type='capsule' size='.1 .25'/></body></body></body></worldbody></mujoco>"""
MIXED = """<mujoco><option integrator='{integrator}' density='{density}' viscosity='.1'/><worldbody>{floor}
  <body pos='0 0 .4' euler='10 20 30'><joint type='slide' axis='1 0 .2' damping='.3'/>
  <joint axis='0 1 1' pos='.1 0 0' stiffness='2' springref='20' armature='.02'/>
  <geom type='capsule' fromto='0 0 0 .3 0 0' size='.05' friction='.7'/><geom type='sphere' pos='0 .2 0' size='.07'/>
  <body pos='.3 0 0'><joint name='a' axis='0 1 0' range='-30 40' limited='true'/>
  <geom type='capsule' fromto='0 0 0 0 0 -.3' size='.04' condim='1'/>
  <body pos='0 0 -.1'><geom type='sphere' pos='.1 0 0' size='.06'/></body></body>
  <body pos='.1 .1 0'><joint axis='0 0 1' damping='1'/><joint name='b' axis='1 0 0'/>
  <geom type='capsule' fromto='0 0 0 0 .3 0' size='.04'/></body></body>
  <body pos='0 .6 .5'><joint name='c' axis='1 0 0'/><geom type='capsule' fromto='0 0 0 0 -.4 -.1' size='.05'/></body>
  </worldbody><actuator><motor joint='a' gear='3' ctrlrange='-1 1' ctrllimited='true'/><motor joint='b' gear='2'/>
  <motor joint='a' gear='-1'/></actuator></mujoco>"""


@compiled
@pytest.mark.parametrize(("slide", "turns", "contacts"), [(0.15, (0, 0), 2), (0.0, (0.4, 0), 1), (0.0, (0, 0.4), 1)])
def test_parallel_and_crossing_capsules_touch_as_in_c(slide, turns, contacts):
    """Parallel capsules touch twice; the axes of crossing ones leave no normal between them."""
    model = exact(mujoco.MjModel.from_xml_string(CROSSED.format(floor=FLOOR)))
    made_of = tables(model, 1, {"forces": ("cfrc_ext", slice(None))})
    data = mujoco.MjData(model)
    data.qpos[7:] = (slide, *turns)
    mujoco.mj_forward(model, data)
    assert data.ncon == contacts
    states = tuple(x[None] for x in (data.qpos, data.qvel, 0 * data.qvel, data.ctrl))
    right = by_c(model, made_of, states, 0)
    for dtype, tolerance in ((np.float64, 1e-9), (np.float32, 1e-3)):
        found = runner(made_of, dtype)(*states, whole=False)
        assert error(found["warmstart"], right["warmstart"]).max() < tolerance
        assert error(found["read"], right["read"]).max() < tolerance


@compiled
@pytest.mark.parametrize(("integrator", "density"), [("RK4", 0), ("Euler", 0), ("Euler", 1000)])
def test_trees_that_no_task_has_step_as_in_c(integrator, density):
    """Two trees that touch, bodies of several joints, welded bodies, springs, two motors on a joint, a fluid."""
    model = exact(mujoco.MjModel.from_xml_string(MIXED.format(floor=FLOOR, integrator=integrator, density=density)))
    assert obstacle(model) is None
    readout = {field: (field, slice(1, None)) for field in ("xpos", "xquat", "cvel", "cinert", "cfrc_ext")}
    made_of = tables(model, 3, readout)
    assert made_of.fills
    rng = np.random.default_rng(2)
    shape = (60, model.nv)
    ctrl = rng.uniform(-2, 2, (60, model.nu))
    check(model, made_of, (rng.uniform(-0.8, 0.8, shape), rng.normal(size=shape), np.zeros(shape), ctrl), loose=0.9)


def random_tree(seed: int) -> str:
    """MJCF of ten bodies with a joint each, on a free root or on the world, each on one of those before it."""
    rng = np.random.default_rng(seed)
    parents = [int(rng.integers(0, k)) for k in range(1, 10)]

    def body(k: int) -> str:
        axis, place, end = (" ".join(map(str, np.round(rng.normal(size=3), 2))) for _ in range(3))
        joint = f"<joint axis='{axis}' damping='.5' armature='.01'/>"
        joint = "<freejoint/>" if k == 0 and seed % 2 else joint
        geom = f"<geom type='capsule' fromto='0 0 0 {end}' size='.05' contype='1' conaffinity='0'/>"
        below = "".join(body(child) for child, parent in enumerate(parents, 1) if parent == k)
        return f"<body pos='{place if k else '0 0 2'}'>{joint}{geom}{below}</body>"

    return f"<mujoco><option integrator='RK4'/><worldbody>{FLOOR}{body(0)}</worldbody></mujoco>"


@compiled
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(k, marks=pytest.mark.full) for k in range(2, 12))])
def test_random_trees_step_as_in_c(seed):
    model = exact(mujoco.MjModel.from_xml_string(random_tree(seed)))
    made_of = tables(model, 2, {"velocity": ("cvel", slice(None))})
    states = anywhere(model, 30, 0.5, 2.0)
    check(model, made_of, states, loose=0.9)


# -- the order of elimination --


@pytest.mark.parametrize("robot", [*FIRST, *FULL])
def test_every_dof_is_eliminated_once_and_after_those_on_it(robot):
    plan = threads.schedule(made(robot)[1])
    order = [d for dofs in plan.rounds for d in dofs]
    assert sorted([*range(plan.trunk), *order]) == list(range(made(robot)[1].nv))
    for number, dofs in enumerate(plan.rounds):
        earlier = {d for before in plan.rounds[:number] for d in before}
        for d in dofs:
            assert {k for k, above in enumerate(made(robot)[1].ancestors) if d in above} <= earlier


def test_more_bodies_than_lanes_are_refused():
    chain = "<body pos='0 0 .1'><joint axis='0 1 0'/><geom type='sphere' size='.01'/>{}</body>"
    text = functools.reduce(lambda inner, _: chain.format(inner), range(32), "")
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    reason = threads.obstacle(tables(model, 1, {}))
    assert reason is not None and "33 moving bodies" in reason and "32" in reason


# -- PTX --

nvidia = pytest.mark.skipif(nvrtc.obstacle() is not None, reason="no NVRTC here")


@nvidia
def test_ptx_is_compiled_once_and_found_again(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = threads.source(made("swimmer")[1])
    ptx = nvrtc.step_ptx(source, "9.0")
    assert ".entry fused_step" in ptx and ".target sm_90" in ptx
    monkeypatch.setattr(nvrtc, "_compiled", lambda *_: pytest.fail("compiled again"))
    assert nvrtc.step_ptx(source, "9.0") == ptx
    with pytest.raises(BaseException, match="compiled again"):
        nvrtc.step_ptx(source, "8.0")
    (kept,) = (tmp_path / "pmt-jax" / "fused").iterdir()
    assert kept.suffix == ".ptx"


@nvidia
def test_a_home_that_cannot_be_written_is_no_obstacle(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.setattr(nvrtc, "_compiled", lambda *_: "ptx")
    assert nvrtc.step_ptx("source", "9.0") == "ptx"


@nvidia
def test_what_nvrtc_refuses_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(TaskError, match="refuses the step: .*error"):
        nvrtc.step_ptx("#define NV nonsense\n", "9.0")


def test_a_missing_nvrtc_says_what_to_install(monkeypatch):
    def missing(name: str, **_: object) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(nvrtc, "_folders", list)
    monkeypatch.setattr(nvrtc.ctypes, "CDLL", missing)
    nvrtc._library.cache_clear()
    try:
        reason = nvrtc.obstacle()
    finally:
        monkeypatch.undo()
        nvrtc._library.cache_clear()
    assert reason is not None and "jax[cuda13]" in reason


def test_ptx_of_a_newer_minor_version_is_marked_as_the_first():
    assert nvrtc._for_older_drivers("//\n.version 9.5\n.target sm_90\n") == "//\n.version 9.0\n.target sm_90\n"
