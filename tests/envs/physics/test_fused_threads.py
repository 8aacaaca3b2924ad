"""The step for GPUs (a warp a world), compiled for a CPU, against MuJoCo's C engine; and how its PTX is made."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import pytest

from envs.errors import TaskError
from envs.multi_goal import models as goals
from envs.physics.fused import nvrtc, threads
from envs.physics.fused.model import Tables, obstacle, tables
from stepping import (
    ROBOTS,
    Rows,
    answers,
    anywhere,
    by_c,
    by_robot,
    crowded,
    errors,
    exact,
    kinds,
    model_of,
    readout_of,
    states,
    sweep,
)
from threads_on_cpu import compiled, runner, world_bytes


@functools.cache
def made(robot: str) -> tuple[mujoco.MjModel, Tables]:
    model, substeps = model_of(robot)
    return model, tables(model, substeps, readout_of(model))


def by_threads(model: mujoco.MjModel, made_of: Tables, rows: np.ndarray, dtype: type = np.float64, **options) -> Rows:
    """What the step makes of rows [n, qpos qvel warm start ctrl], the readouts one after another as `read`."""
    return runner(made_of, dtype)(*np.split(rows, np.cumsum([model.nq, model.nv, model.nv]), axis=1), **options)


def flat(made_of: Tables, right: Rows) -> Rows:
    """C's rows, the readouts one after another as `read`."""
    count = len(right["qpos"])
    read = [right[name].reshape(count, -1) for name in made_of.readings]
    return {name: right[name] for name in ("qpos", "qvel", "warmstart")} | {
        "read": np.concatenate([np.zeros((count, 0)), *read], axis=1)
    }


def check(model: mujoco.MjModel, made_of: Tables, rows: np.ndarray, right: tuple[Rows, Rows], loose: float) -> None:
    """qacc, one control step and all readouts, in double precision. MuJoCo itself jumps at a margin: a few rows may.

    Args:
      right: by C, of the states' own acceleration and of the step. loose: the share of rows that must agree.
    """
    expected, found = flat(made_of, right[0]), by_threads(model, made_of, rows, whole=False)
    assert not found["overflow"].any()
    wrong = errors(found["warmstart"], expected["warmstart"])
    assert np.quantile(wrong, loose) < 1e-8 and wrong.max() < 1e-6 and np.median(wrong) < 1e-11
    assert errors(found["read"], expected["read"]).max() < 1e-5
    expected, found = flat(made_of, right[1]), by_threads(model, made_of, rows)
    for name, tolerance in (("qpos", 1e-12), ("qvel", 1e-10), ("warmstart", 1e-8), ("read", 1e-8)):
        wrong = errors(found[name], expected[name])
        assert np.quantile(wrong, loose) < tolerance and wrong.max() < 1e-2, name


@compiled
@pytest.mark.parametrize(("robot", "kind", "full"), sweep("hopper"))
def test_accelerations_steps_and_readouts_are_mujocos(robot, kind, full):
    right = answers(robot, kind, full, True), answers(robot, kind, full)
    check(*made(robot), states(robot, kind, full), right, 0.97 if kind == "visited" else 0.8)


@compiled
@pytest.mark.parametrize("robot", by_robot())
def test_single_precision_is_close(robot):
    model, made_of = made(robot)
    rows = states(robot, kinds(robot)[0]).astype(np.float32).astype(float)
    right, found = by_c(model, rows, made_of.substeps, {}), by_threads(model, made_of, rows, np.float32)
    assert np.median(errors(found["qpos"], right["qpos"])) < 1e-6
    assert np.quantile(errors(found["qpos"], right["qpos"]), 0.95) < 2e-5
    assert np.quantile(errors(found["qvel"], right["qvel"]), 0.95) < 1e-3


@pytest.mark.full
@compiled
def test_contacts_beyond_the_slots_are_reported():
    """With the floor, and with solid walls; slots of points alone are as many as the points."""
    model, substeps = model_of("walls")
    made_of = tables(model, substeps, {}, contacts=2)
    low, high, walls = anywhere(model, 8, 0.1, 0.1), anywhere(model, 8, 3.0, 3.0), states("walls", "walls")
    assert by_threads(model, made_of, low)["overflow"].all()
    assert by_threads(model, made_of, walls)["overflow"].any()
    assert not by_threads(model, made_of, high)["overflow"].any()


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


FORCES = {"forces": ("cfrc_ext", slice(None))}


@compiled
@pytest.mark.parametrize(("slide", "turns", "contacts"), [(0.15, (0, 0), 2), (0.0, (0.4, 0), 1), (0.0, (0, 0.4), 1)])
def test_parallel_and_crossing_capsules_touch_as_in_c(slide, turns, contacts):
    """Parallel capsules touch twice; the axes of crossing ones leave no normal between them."""
    model = exact(mujoco.MjModel.from_xml_string(CROSSED.format(floor=FLOOR)))
    made_of = tables(model, 1, FORCES)
    data = mujoco.MjData(model)
    data.qpos[7:] = (slide, *turns)
    mujoco.mj_forward(model, data)
    assert data.ncon == contacts
    row = np.concatenate([data.qpos, data.qvel, 0 * data.qvel, data.ctrl])[None]
    right = flat(made_of, by_c(model, row, 0, FORCES))
    for dtype, tolerance in ((np.float64, 1e-9), (np.float32, 1e-3)):
        found = by_threads(model, made_of, row, dtype, whole=False)
        assert errors(found["warmstart"], right["warmstart"]).max() < tolerance
        assert errors(found["read"], right["read"]).max() < tolerance


@compiled
@pytest.mark.parametrize(
    ("integrator", "density"), [("RK4", 0), *(pytest.param("Euler", x, marks=pytest.mark.full) for x in (0, 1000))]
)
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
    rows = np.concatenate([rng.uniform(-0.8, 0.8, shape), rng.normal(size=shape), np.zeros(shape), ctrl], axis=1)
    check(model, made_of, rows, tuple(by_c(model, rows, substeps, readout) for substeps in (0, 3)), 0.9)


def random_tree(seed: int, bodies: int = 10) -> str:
    """MJCF of bodies with a joint each, on a free root or on the world, each on one of those before it."""
    rng = np.random.default_rng(seed)
    parents = [int(rng.integers(0, k)) for k in range(1, bodies)]

    def body(k: int) -> str:
        axis, place, end = (" ".join(map(str, np.round(rng.normal(size=3), 2))) for _ in range(3))
        joint = f"<joint axis='{axis}' damping='.5' armature='.01'/>"
        joint = "<freejoint/>" if k == 0 and seed % 2 else joint
        geom = f"<geom type='capsule' fromto='0 0 0 {end}' size='.05' contype='1' conaffinity='0'/>"
        below = "".join(body(child) for child, parent in enumerate(parents, 1) if parent == k)
        return f"<body pos='{place if k else '0 0 2'}'>{joint}{geom}{below}</body>"

    return f"<mujoco><option integrator='RK4'/><worldbody>{FLOOR}{body(0)}</worldbody></mujoco>"


SEEDS = {1: (), **dict.fromkeys((0, 2, 3), pytest.mark.full), **dict.fromkeys(range(4, 12), pytest.mark.slow)}


@compiled
@pytest.mark.parametrize("seed", [pytest.param(seed, marks=marks) for seed, marks in SEEDS.items()])
def test_random_trees_step_as_in_c(seed):
    model = exact(mujoco.MjModel.from_xml_string(random_tree(seed)))
    readout = {"velocity": ("cvel", slice(None))}
    made_of, rows = tables(model, 2, readout), anywhere(model, 30, 0.5, 2.0)
    check(model, made_of, rows, tuple(by_c(model, rows, substeps, readout) for substeps in (0, 2)), 0.9)


@compiled
@pytest.mark.full
@pytest.mark.parametrize("seed", [0, 1])
def test_wide_random_trees_step_as_in_c(seed):
    """40 bodies, on the world and on a free root, in the air: more dofs, bodies, joints and limits than threads."""
    text = random_tree(seed, 40).replace("contype='1'", "contype='0'").replace("damping", "range='-20 20' damping")
    model = exact(mujoco.MjModel.from_xml_string(text))
    readout = {"velocity": ("cvel", slice(None))}
    made_of, rows = tables(model, 2, readout), anywhere(model, 30, 0.5, 2.0)
    assert (threads.obstacle(made_of), threads.lanes(made_of)) == (None, 64)
    check(model, made_of, rows, tuple(by_c(model, rows, substeps, readout) for substeps in (0, 2)), 0.9)


# -- boxes --

AT_A_BOX = """<mujoco><option timestep='.005'/><worldbody>
  <geom type='box' size='{size}' pos='1 2 3' euler='20 30 40' margin='.02'/>
  <body><freejoint/><geom type='capsule' size='.08 .3' mass='1'/><geom size='.1' pos='.9 0 0' mass='1'/></body>
  </worldbody></mujoco>"""
FORCES_OF_THE_FREE = {"forces": ("cfrc_ext", 1)}


def at_a_box(model: mujoco.MjModel, count: int) -> np.ndarray:
    """A capsule and a sphere in any attitude, and along the box's axes, at its faces, edges and corners and inside."""
    rng, size = np.random.default_rng(4), model.geom_size[0]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    turn, rows = data.geom_xmat[0].reshape(3, 3), np.zeros((count, 7 + 6 + 6))
    for k, row in enumerate(rows):
        place = rng.uniform(-1, 1, 3) * (size + 0.1)
        for axis in rng.choice(3, rng.integers(1, 4), replace=False):  # beside a face, an edge or a corner
            place[axis] = rng.choice([-1, 1]) * (size[axis] + rng.uniform(-0.1, 0.35))
        row[3:7] = rng.normal(size=4)
        if k % 10 == 0:
            mujoco.mju_mat2Quat(row[3:7], turn[:, rng.permutation(3)].ravel())
        row[3:7] /= np.linalg.norm(row[3:7])
        offset, ball = np.zeros(3), np.array([0.9, 0, 0])
        mujoco.mju_rotVecQuat(offset, ball, row[3:7])
        row[:3] = data.geom_xpos[0] + turn @ place - (k % 4 == 1) * offset  # every fourth: the sphere is there
    return rows


@compiled
@pytest.mark.parametrize(
    "size",
    [
        pytest.param(".5 .3 .2", marks=pytest.mark.full),
        *(pytest.param(x, marks=pytest.mark.slow) for x in (".1 .1 .1", "300 .5 .7")),
    ],
)
def test_capsules_and_spheres_touch_a_box_as_in_c(size):
    model = exact(mujoco.MjModel.from_xml_string(AT_A_BOX.format(size=size)))
    made_of, rows = tables(model, 1, FORCES_OF_THE_FREE), at_a_box(model, 1000)
    right = flat(made_of, by_c(model, rows, 0, FORCES_OF_THE_FREE))
    assert (np.abs(right["read"]).max(axis=1) > 0).mean() > 0.3
    found = by_threads(model, made_of, rows, whole=False)
    turned = np.arange(len(rows)) % 10 != 0  # along the box's axes an edge or end may be the nearest by rounding alone
    for name in ("warmstart", "read"):
        wrong = errors(found[name], right[name])
        assert wrong[turned].max() < 1e-6 and np.quantile(wrong[~turned], 0.9) < 1e-6
    single = by_threads(model, made_of, rows, np.float32, whole=False)
    assert np.quantile(errors(single["warmstart"], right["warmstart"])[turned], 0.97) < 2e-3


TWO_BOXES = """<mujoco><option timestep='.005'/><worldbody>
  <geom type='box' size='.5 .3 .2' pos='1 2 3' euler='20 30 40' margin='.02'/>
  <body><freejoint/><geom type='box' size='{size}' mass='1'/></body></worldbody></mujoco>"""


@compiled
@pytest.mark.parametrize(
    "size", [pytest.param(".4 .3 .2", marks=pytest.mark.full), pytest.param("2 .05 .1", marks=pytest.mark.slow)]
)
def test_boxes_touch_boxes_as_in_c(size):
    """Faces, edges and corners; every tenth pair has parallel axes, where the nearest is decided by rounding alone."""
    model = exact(mujoco.MjModel.from_xml_string(TWO_BOXES.format(size=size)))
    made_of, rows = tables(model, 1, FORCES_OF_THE_FREE), at_a_box(model, 1000)
    right = flat(made_of, by_c(model, rows, 0, FORCES_OF_THE_FREE))
    assert (np.abs(right["read"]).max(axis=1) > 0).mean() > 0.3
    found, turned = by_threads(model, made_of, rows, whole=False), np.arange(len(rows)) % 10 != 0
    for name in ("warmstart", "read"):
        wrong = errors(found[name], right[name])
        assert wrong[turned].max() < 1e-6 and np.quantile(wrong[~turned], 0.8) < 1e-6, name
    assert not found["overflow"].any()


@compiled
@pytest.mark.parametrize(
    ("robot", "vases"),
    [
        *(pytest.param(*x, marks=pytest.mark.full) for x in (("point", 2), ("ant", 0), ("ant", 1))),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in (("point", 0), ("point", 4), ("ant", 4))),
    ],
)
def test_robots_and_vases_that_touch_step_as_in_c(robot, vases):
    """Two robots among vases: several trees, boxes, all six directions of contacts, and a forward pass at the end."""
    model, rows = exact(goals.model(robot, 2, vases, 1.5)), crowded(robot, vases, 90)
    readout = {field: (field, slice(1, None)) for field in ("cfrc_ext", "xpos", "xquat", "cvel", "cinert")}
    readout["qacc"] = ("qacc", slice(None))
    made_of = tables(model, goals.SUBSTEPS, readout, forward=True)
    assert threads.obstacle(made_of) is None
    right = flat(made_of, by_c(model, rows, goals.SUBSTEPS, readout, forward=True))
    found = by_threads(model, made_of, rows)
    whole = found["overflow"].ravel() == 0  # four vases between two ants may touch at more places than there are slots
    assert (~whole).mean() <= (0.09 if (robot, vases) == ("ant", 4) else 0)
    for name, share in (("qpos", 0.95), ("qvel", 0.95), ("warmstart", 0.95), ("read", 0.9)):
        assert np.quantile(errors(found[name], right[name])[whole], share) < 1e-6, name
    single = by_threads(model, made_of, rows, np.float32)
    assert np.quantile(errors(single["qpos"], right["qpos"])[whole], 0.9) < 2e-5


@pytest.mark.parametrize(("vases", "lanes"), [(0, 32), (1, 64)])
def test_a_wide_model_has_two_lanes_a_thread(vases, lanes):
    made_of = tables(goals.model("ant", 2, vases, 1.5), 1, {}, forward=True)
    assert (threads.obstacle(made_of), threads.lanes(made_of)) == (None, lanes)


def test_more_dofs_than_lanes_are_refused():
    made_of = tables(goals.model("ant", 2, 7, 1.5), 1, {}, forward=True)
    assert "70 degrees of freedom, and a warp takes 64" in str(threads.obstacle(made_of))


# -- the order of elimination --


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_dof_is_eliminated_once_and_after_those_on_it(robot):
    plan = threads.schedule(made(robot)[1])
    order = [d for dofs in plan.rounds for d in dofs]
    assert sorted([*range(plan.trunk), *order]) == list(range(made(robot)[1].nv))
    for number, dofs in enumerate(plan.rounds):
        earlier = {d for before in plan.rounds[:number] for d in before}
        for d in dofs:
            assert {k for k, above in enumerate(made(robot)[1].ancestors) if d in above} <= earlier


def test_more_bodies_than_lanes_are_refused():
    chain = "<body pos='0 0 .1'><joint axis='0 1 0'/><geom size='.01' contype='0' conaffinity='0'/>{}</body>"
    text = functools.reduce(lambda inner, _: chain.format(inner), range(64), "")
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    reason = threads.obstacle(tables(model, 1, {}))
    assert reason is not None and "65 moving bodies" in reason and "64" in reason


@compiled
@pytest.mark.parametrize("robot", by_robot("hopper"))
def test_the_bytes_of_a_world_are_as_counted(robot):
    counted, right = threads.shared_bytes(made(robot)[1]), world_bytes(made(robot)[1])
    assert right <= counted < 1.08 * right


def test_more_bytes_than_a_block_has_are_refused():
    joints = "<joint axis='0 1 0'/><joint axis='1 0 0'/>"
    link = "<body pos='0 0 .2'>" + joints + "<geom type='capsule' size='.05 .1' condim='6'{}/>{}</body>"
    chains = ""
    for kind in (" contype='1' conaffinity='2'", " contype='2' conaffinity='1'"):
        chains += functools.reduce(lambda inner, _, kind=kind: link.format(kind, inner), range(8), "")
    made_of = tables(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{chains}</worldbody></mujoco>"), 1, {})
    assert made_of.nv == 32 and "bytes, and a warp's memory has 49152" in str(threads.obstacle(made_of))


@pytest.mark.full
def test_more_pairs_than_a_world_lists_are_refused():
    balls = "".join(f"<body pos='{k} 0 0'><joint/><geom size='.1'/></body>" for k in range(16))
    boxes = "".join(f"<geom type='box' size='.1 .1 .1' pos='{k} 9 0'/>" for k in range(260))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{balls}{boxes}</worldbody></mujoco>")
    reason = threads.obstacle(tables(model, 1, {}))
    assert reason is not None and f"{16 * 15 // 2 + 16 * 260} pairs of geoms" in reason and "4096" in reason


# -- PTX --

nvidia = pytest.mark.skipif(nvrtc.obstacle() is not None, reason="no NVRTC here")


@nvidia
def test_ptx_is_compiled_once_and_found_again(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = threads.source(made("swimmer")[1])
    ptx = nvrtc.step_ptx(source, "9.0")
    assert ".entry fused_step" in ptx and ".target sm_90" in ptx
    monkeypatch.setattr(nvrtc, "compiled", lambda *_: pytest.fail("compiled again"))
    assert nvrtc.step_ptx(source, "9.0") == ptx
    with pytest.raises(BaseException, match="compiled again"):
        nvrtc.step_ptx(source, "8.0")
    (kept,) = (tmp_path / "pmt-jax" / "fused").iterdir()
    assert kept.suffix == ".ptx"


@nvidia
@pytest.mark.parametrize(("robot", "vases"), [("point", 4), ("ant", 0)])
def test_ptx_of_boxes_and_several_trees_is_compiled(robot, vases, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made_of = tables(goals.model(robot, 2, vases, 1.5), goals.SUBSTEPS, {"qacc": ("qacc", slice(None))}, forward=True)
    assert ".entry fused_step" in nvrtc.step_ptx(threads.source(made_of), "9.0")


@nvidia
def test_a_home_that_cannot_be_written_is_no_obstacle(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.setattr(nvrtc, "compiled", lambda *_: "ptx")
    assert nvrtc.step_ptx("source", "9.0") == "ptx"


@nvidia
def test_what_nvrtc_refuses_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(TaskError, match="refuses the step: .*error"):
        nvrtc.step_ptx("#define NV nonsense\n", "9.0")


def test_a_missing_nvrtc_says_what_to_install(monkeypatch):
    def missing(name: str, **_: object) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(nvrtc, "folders", list)
    monkeypatch.setattr(nvrtc.ctypes, "CDLL", missing)
    nvrtc.library.cache_clear()
    try:
        reason = nvrtc.obstacle()
    finally:
        monkeypatch.undo()
        nvrtc.library.cache_clear()
    assert reason is not None and "jax[cuda13]" in reason


def test_ptx_of_a_newer_minor_version_is_marked_as_the_first():
    assert nvrtc.for_older_drivers("//\n.version 9.5\n.target sm_90\n") == "//\n.version 9.0\n.target sm_90\n"
