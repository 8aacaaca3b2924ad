"""The corridor ant against transitions recorded from the reference environment, and against its own rules."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import envs
from envs.ant import corridor, walls
from envs.errors import TaskError
from paths import DATA
from stepping import compiled

TOLERANCE = {"qpos": 5e-5, "qvel": 5e-3, "reward_contact": 1e-5, "reward": 2e-3, "torso_xpos": 5e-5}
# Here the ant stands inside a wall, which turns it at 1e-3 rad/s for the control step. Ours are drawn only.
WALL_OBS_TOLERANCE = 2e-3
OBS_TOLERANCE = 1e-4


@functools.cache
def recording(name: str) -> dict[str, np.ndarray]:
    with np.load(DATA / f"ant_reference_{name[4:]}.npz") as data:
        return dict(data)


@functools.cache
def stepper(physics: str):
    """One compiled program for both partitions: they differ in nothing but names and one-hot indices."""
    env = envs.make("ant_2x4", physics=physics)
    return env, jax.jit(jax.vmap(env.step))


def restored(env, rows):
    return jax.jit(jax.vmap(env.restore))(rows["qpos0"], rows["qvel0"], rows["warm0"], rows["torso_xpos0"])


def inside_wall(rows) -> np.ndarray:
    """Rows whose torso overlaps a wall, six boxes 20 m to either side of their centre."""
    x, y = rows["qpos0"][:, 0], rows["qpos0"][:, 1]
    along = np.abs(x[:, None] - np.array([0.0, 40.0, 80.0])).min(axis=1) < 17.4
    distance = np.abs(np.abs(np.asarray(corridor.off_centre(x, y))) - 5.0) * np.cos(np.pi / 6)
    return along & (distance < 0.9)


def worst(actual, expected) -> float:
    return float(np.abs(np.asarray(actual, np.float64) - expected).max())


@pytest.fixture(
    scope="session",
    # MJX compiles this ant for a minute; -m full has MJX with the hands.
    params=[
        "mujoco",
        pytest.param("fused", marks=(compiled, pytest.mark.full)),
        pytest.param("mjx", marks=pytest.mark.slow),
    ],
)
def replay(request):
    """Recording and our State after one control step from each of its rows."""
    rows = recording("ant_2x4")
    env, step = stepper(request.param)
    actions = rows["action"].reshape(-1, 2, 4).astype(np.float32)
    return request.param, rows, jax.block_until_ready(step(restored(env, rows), actions))


def check_replay(rows, after) -> None:
    physics = after.carry.physics
    assert worst(physics.qpos, rows["qpos1"]) < TOLERANCE["qpos"]
    assert worst(physics.qvel, rows["qvel1"]) < TOLERANCE["qvel"]
    assert worst(after.carry.torso_xpos, rows["torso_xpos1"]) < TOLERANCE["torso_xpos"]
    assert worst(after.reward, rows["reward"]) < TOLERANCE["reward"]
    for part in ("reward_forward", "reward_ctrl", "reward_contact"):
        assert worst(after.info[part], rows[part]) < TOLERANCE.get(part, TOLERANCE["reward"])
    for flag in ("cost_obj", "cost_done"):
        np.testing.assert_array_equal(after.info[flag], rows[flag])
    np.testing.assert_array_equal(after.cost[:, :, 0], np.broadcast_to(rows["cost"][:, None], after.cost.shape[:2]))
    np.testing.assert_array_equal(after.terminated, rows["done"])


def check_obs(rows, obs) -> None:
    kept = np.array([not case.startswith("branch x=60") for case in rows["case"]])
    wall = inside_wall(rows)
    error = np.abs(np.asarray(obs, np.float64) - rows["obs1"]).max(axis=(1, 2))
    assert error[kept & ~wall].max() < OBS_TOLERANCE
    assert error[kept & wall].max() < WALL_OBS_TOLERANCE


def test_reproduces_the_recorded_physics_reward_cost_and_termination(replay):
    _, rows, after = replay
    check_replay(rows, after)


def test_reproduces_the_recorded_observations(replay):
    _, rows, after = replay
    check_obs(rows, after.obs)


def test_float32_does_not_cost_the_solver_its_last_step(replay):
    """Where the cost is too coarse to show what the last Newton step gains, qvel would be off by 2e-4."""
    _, rows, after = replay
    rollouts = rows["part"] == "roll"
    assert worst(after.carry.physics.qvel[rollouts], rows["qvel1"][rollouts]) < 5e-5


def test_reproduces_the_recorded_4x2_on_the_c_engine():
    rows, env = recording("ant_4x2"), envs.make("ant_4x2", physics="mujoco")
    after = jax.jit(jax.vmap(env.step))(restored(env, rows), rows["action"].reshape(-1, 4, 2).astype(np.float32))
    check_replay(rows, after)
    check_obs(rows, after.obs)


def test_4x2_observations_on_mjx_from_its_2x4_states(replay):
    """Both partitions recorded the same physics, so 4x2's observations follow from 2x4's states."""
    _, _, after = replay
    rows, env = recording("ant_4x2"), envs.make("ant_4x2", physics="mujoco")
    np.testing.assert_array_equal(rows["qpos1"], recording("ant_2x4")["qpos1"])
    physics = after.carry.physics
    obs = jax.jit(jax.vmap(env.restore))(physics.qpos, physics.qvel).obs
    check_obs(rows, obs)


def test_walls_explain_the_rows_that_miss_the_tolerance():
    """With the six milligram boxes as free bodies, as in the original, those rows agree too."""
    rows = {k: v[inside_wall(recording("ant_2x4"))] for k, v in recording("ant_2x4").items()}
    spec = mujoco.MjSpec.from_file(str(walls.MODEL))
    for x, yaw in ((0, 30), (40, -30), (80, 30)):
        for y in (5, -5):
            half = np.radians(yaw) / 2
            body = spec.worldbody.add_body(pos=[x, y, 1], quat=[np.cos(half), 0, 0, np.sin(half)])
            body.add_freejoint()
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=[20, 0.01, 0.7], density=1e-6, contype=1, conaffinity=1, margin=0
            )
    model = spec.compile()
    data = mujoco.MjData(model)
    errors = []
    for i in range(len(rows["qpos0"])):
        mujoco.mj_resetData(model, data)
        data.qpos[:15], data.qvel[:14], data.ctrl[:] = rows["qpos0"][i], rows["qvel0"][i], rows["action"][i]
        data.qacc_warmstart[:14] = rows["warm0"][i]
        mujoco.mj_step(model, data, 5)
        errors.append(np.abs(data.qvel[:14] - rows["qvel1"][i]).max())
    assert len(errors) >= 10
    assert max(errors) < 5e-5


def test_model_is_the_original_ant():
    model = corridor.model()
    assert (model.nq, model.nv, model.nu, model.nbody) == (15, 14, 8, 14)
    np.testing.assert_allclose(model.body("torso").mass, 0.327249235, rtol=1e-8)
    np.testing.assert_allclose(model.body("aux_1").mass, 0.036476928, rtol=1e-7)
    np.testing.assert_allclose(model.body("aux_1").inertia, [4.585601e-4, 4.585601e-4, 1.167262e-4], rtol=1e-6)
    np.testing.assert_allclose(model.body("foot_3").mass, 0.064911379, rtol=1e-7)
    np.testing.assert_allclose(model.body("foot_3").inertia, [2.359040e-3, 2.359040e-3, 2.077164e-4], rtol=1e-6)
    np.testing.assert_allclose(model.body_mass.sum(), 0.8787, atol=5e-5)
    ant = model.geom_bodyid > 0
    assert (model.geom_margin[ant] == 0.01).all() and (model.geom_margin[~ant] == 0).all()  # margins add up
    assert (model.geom_conaffinity != 0).sum() == 1  # the floor alone: walls are drawn only
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 and model.opt.timestep == 0.01
    motors = [model.actuator(i).name for i in range(8)]
    assert motors == ["hip_4", "ankle_4", "hip_1", "ankle_1", "hip_2", "ankle_2", "hip_3", "ankle_3"]


@pytest.mark.parametrize(("name", "agents", "width"), [("ant_2x4", 2, 31), ("ant_4x2", 4, 33)])
def test_spec_and_observation(name, agents, width):
    env = envs.make(name, physics="mujoco")
    assert env.engine == "mujoco"
    state = jax.jit(env.reset)(jax.random.key(0))
    spec = env.spec
    assert (spec.name, spec.num_agents, spec.obs_dim, spec.action_dim) == (name, agents, width, 8 // agents)
    assert (spec.state_dim, spec.num_costs, spec.horizon, spec.cost_limit) == (29, 1, 1000, 10.0)
    assert state.obs.shape == (agents, width) and state.global_state.shape == (29,)
    np.testing.assert_allclose(state.obs.mean(axis=1), 0, atol=1e-6)
    np.testing.assert_allclose(state.obs.std(axis=1), 1, atol=1e-5)
    raw = jax.jit(envs.make(name, physics="mujoco", observation="raw").reset)(jax.random.key(0))
    np.testing.assert_array_equal(raw.obs[:, :29], np.broadcast_to(raw.global_state, (agents, 29)))
    np.testing.assert_array_equal(raw.obs[:, 29:], np.eye(agents))


@pytest.mark.full
def test_agents_drive_the_motors_in_order():
    """The effective partition: agents' actions concatenated, whatever the reference's table declares."""
    two, four = (envs.make(name, physics="mujoco") for name in ("ant_2x4", "ant_4x2"))
    action = jax.random.uniform(jax.random.key(1), (8,), minval=-1.5, maxval=1.5)
    start = two.reset(jax.random.key(0))
    a, b = two.step(start, action.reshape(2, 4)), four.step(four.restore(**two.raw(start)), action.reshape(4, 2))
    np.testing.assert_array_equal(a.carry.physics.qpos, b.carry.physics.qpos)
    np.testing.assert_allclose(a.info["reward_ctrl"], -0.5 * np.sum(np.asarray(action) ** 2), rtol=1e-6)


@pytest.mark.full
def test_free_partitions_drive_the_motors_that_they_name():
    two = envs.make("ant_2x4", physics="mujoco")
    free = envs.make("ant_2x4", physics="mujoco", partition="0,7,2,3,4,5|6,1")
    assert (free.spec.name, free.spec.action_dim, free.spec.action_mask.sum(1).tolist()) == ("ant_6_2", 6, [6, 2])
    assert envs.make("ant_2x4", physics="mujoco", partition="0,1|2,3|4,5|6,7").spec.name == "ant_4x2"
    assert envs.columns("ant_6_2") == envs.columns("ant_2x4") and not envs.columns("my_task")
    start, action = two.reset(jax.random.key(0)), jnp.linspace(-1, 1, 8)
    padded = jnp.stack([action[jnp.array([0, 7, 2, 3, 4, 5])], jnp.pad(action[jnp.array([6, 1])], (0, 4))])
    a, b = two.step(start, action.reshape(2, 4)), free.step(free.restore(**two.raw(start)), padded)
    np.testing.assert_array_equal(a.carry.physics.qpos, b.carry.physics.qpos)


def test_restore_is_the_inverse_of_raw():
    env, _ = stepper("mujoco")
    step = jax.jit(env.step)
    state = step(env.reset(jax.random.key(3)), jnp.full((2, 4), 0.3))
    again = env.restore(**env.raw(state))
    np.testing.assert_array_equal(again.obs, state.obs)
    assert jax.tree.structure(again) == jax.tree.structure(state)
    for ours, theirs in zip(
        jax.tree.leaves(step(state, jnp.ones((2, 4)))), jax.tree.leaves(step(again, jnp.ones((2, 4)))), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    scaled = env.restore(np.r_[0, 0, 0.75, 2, np.zeros(11)], np.zeros(14))
    np.testing.assert_array_equal(scaled.carry.physics.qpos[3:7], [1, 0, 0, 0])


def test_reset_and_step_have_one_structure_without_weak_types():
    env, _ = stepper("mujoco")
    start = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, start, jax.ShapeDtypeStruct((2, 4), jnp.float32))
    assert jax.tree.structure(start) == jax.tree.structure(after)
    for a, b in zip(jax.tree.leaves(start), jax.tree.leaves(after), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)
        assert not b.weak_type


def test_reset_draws_what_the_task_says():
    env, _ = stepper("mujoco")
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 4000))
    qpos, qvel = np.asarray(states.carry.physics.qpos), np.asarray(states.carry.physics.qvel)
    offset = qpos - corridor.model().qpos0
    free = [0, 1, 2, *range(7, 15)]
    assert 0.098 < np.abs(offset[:, free]).max() <= 0.1 + 1e-6
    np.testing.assert_allclose(offset[:, free].std(axis=0), 0.1 / np.sqrt(3), rtol=0.05)
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(qvel.std(axis=0), 0.1, rtol=0.06)


@pytest.mark.full
def test_standing_still_earns_993_and_costs_nothing():
    env, _ = stepper("mujoco")

    @jax.jit
    def episode(keys):
        def step(state, _):
            state = jax.vmap(env.step)(state, jnp.zeros((len(keys), 2, 4)))
            return state, (state.reward, state.info["reward_forward"], state.cost[:, 0, 0], state.terminated)

        return jax.lax.scan(step, jax.vmap(env.reset)(keys), None, length=1000)[1]

    reward, forward, cost, terminated = episode(jax.random.split(jax.random.key(0), 4))
    # The fall from the noisy start drifts by up to half a metre, which is worth 20 a metre.
    np.testing.assert_allclose((reward - forward).sum(axis=0), 993.5, atol=1.5)
    np.testing.assert_allclose(reward.sum(axis=0), 993, atol=15)
    assert not cost.any() and not terminated.any()


def plain_danger(x: float, y: float) -> bool:
    """The cost band of the benchmark, without JAX."""
    slope = np.tan(np.pi / 6)
    if x < 20:
        centre = x * slope
    elif 20 < x < 60:
        centre = (40 - x) * slope
    elif 60 < x < 100:
        centre = (x - 80) * slope
    else:
        centre = 20 * slope
    return 3.2 < abs(y - centre) < 6.8


@settings(max_examples=300, deadline=None)
@given(st.floats(-150, 150, width=32), st.floats(-30, 30, width=32))
@example(20.0, 20 * np.tan(np.pi / 6) + 5)
@example(60.0, 20 * np.tan(np.pi / 6) + 5)  # the quirk: at exactly 60 the centre line jumps up
@example(60.0, -20 * np.tan(np.pi / 6) + 5)
@example(100.0, 20 * np.tan(np.pi / 6) - 5)
@example(-40.0, -40 * np.tan(np.pi / 6) + 6.7)
def test_danger_band_matches_a_plain_oracle(x, y):
    off = abs(float(corridor.off_centre(np.float64(x), np.float64(y))))
    if min(abs(off - 3.2), abs(off - 6.8)) > 1e-4:  # float32 may round either way at the very edge
        assert bool(corridor.in_danger(np.float64(x), np.float64(y))) == plain_danger(x, y)


def test_centre_line_is_continuous_at_the_folds():
    for x in (20.0, 100.0):
        left, right = (float(corridor.off_centre(jnp.float32(x + dx), jnp.float32(0.0))) for dx in (-1e-3, 1e-3))
        assert abs(left - right) < 2e-3


@functools.cache
def walled(kind: str, physics: str = "mujoco"):
    env = envs.make("ant_2x4", physics=physics, walls=kind)
    return env, jax.jit(jax.vmap(env.step))


def centre(x: float) -> float:
    return -float(corridor.off_centre(np.float64(x), np.float64(0.0)))


@pytest.mark.parametrize(("kind", "costs"), [("reference", [0, 1, 1, 1, 1, 0]), ("costly", [0, 1, 1, 1, 1, 1])])
def test_an_ant_behind_a_wall_is_outside_and_behind_the_band_reference_walls_cost_nothing(kind, costs):
    env, step = walled(kind)
    rest = np.asarray(env.raw(jax.jit(env.reset)(jax.random.key(0)))["qpos"])
    qpos = np.stack([np.r_[30.0, centre(30.0) + off, rest[2:]] for off in (0.0, -4.5, 4.5, -5.5, 5.5, 9.0)])
    after = step(jax.jit(jax.vmap(env.restore))(qpos, np.zeros((6, 14))), jnp.zeros((6, 2, 4)))
    np.testing.assert_array_equal(after.info["outside"], [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(after.cost[:, 0, 0], costs)


@pytest.mark.parametrize("kind", [pytest.param("costly", marks=pytest.mark.full), "solid"])
def test_away_from_walls_every_kind_of_wall_is_the_reference(kind):
    """Equal to the last bit where no foot can touch a wall, and for costly walls everywhere but in the cost outside."""
    rows = recording("ant_2x4")
    actions = rows["action"].reshape(-1, 2, 4).astype(np.float32)
    (env, step), (_, reference) = walled(kind), walled("reference")
    expected, actual = reference(restored(env, rows), actions), step(restored(env, rows), actions)
    off = np.abs(np.asarray(corridor.off_centre(*rows["torso_xpos1"][:, :2].T)))
    free = np.ones_like(off, bool) if kind == "costly" else off < 3.0
    assert free.sum() > 600
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[free], b[free]), actual.carry, expected.carry)
    np.testing.assert_array_equal(actual.reward[free], expected.reward[free])
    costs = np.maximum(np.asarray(expected.cost[:, 0, 0]), off > 5) if kind == "costly" else expected.cost[:, 0, 0]
    np.testing.assert_array_equal(actual.cost[free, 0, 0], costs[free])


def thrown(env, speed: float):
    """Ants on every straight of the corridor that fly towards either wall."""
    rest = np.asarray(env.raw(jax.jit(env.reset)(jax.random.key(0)))["qpos"])
    places = [(x, side) for x in (-50.0, 5.0, 19.0, 40.0, 59.0, 75.0, 99.0, 130.0, 400.0) for side in (1, -1)]
    qpos = np.stack([np.r_[x, centre(x) + 2 * side, 0.5, rest[3:]] for x, side in places])
    qvel = np.zeros((len(places), 14))
    qvel[:, 1] = [side * speed for _, side in places]
    return jax.jit(jax.vmap(env.restore))(qpos, qvel)


@functools.cache
def flight(kind: str, steps: int = 30) -> list:
    """The states of thrown ants on the C engine. At 8 m/s they are faster than trained ants."""
    env, step = walled(kind)
    states = [thrown(env, speed=8.0)]
    for _ in range(steps):
        states.append(step(states[-1], jnp.zeros((len(states[0].reward), 2, 4))))
    return states


@pytest.mark.parametrize(
    ("kind", "furthest"), [pytest.param("costly", (5.5, 30), marks=pytest.mark.full), ("solid", (3.5, 4.9))]
)
def test_solid_walls_stop_an_ant_that_others_let_through(kind, furthest):
    """A torso of radius 0.25 touches a wall at 30 degrees 0.29 m (along y) before its centre would reach it."""
    places = np.stack([state.carry.torso_xpos[:, :2] for state in flight(kind)])
    off = np.abs(np.asarray(corridor.off_centre(places[..., 0], places[..., 1]))).max(axis=0)
    assert (furthest[0] < off).all() and (off < furthest[1]).all()


@pytest.mark.parametrize(
    ("engine", "most"),
    [
        pytest.param("fused", 5e-6, marks=(compiled, pytest.mark.full)),
        pytest.param("mjx", 1e-4, marks=pytest.mark.slow),  # which compiles for a minute
    ],
)
def test_solid_walls_stop_an_ant_on_other_engines_as_on_c(engine, most):
    env, step = walled("solid", engine)
    states = flight("solid")[:16]
    restore = jax.jit(lambda state: jax.vmap(env.restore)(**jax.vmap(env.raw)(state)))
    errors, touched = [], []
    for before, after, free in zip(states, states[1:], flight("costly")[1:], strict=False):
        ours = step(restore(before), jnp.zeros((len(before.reward), 2, 4)))
        errors.append(np.abs(ours.carry.physics.qpos - after.carry.physics.qpos).max(axis=1))
        touched.append(np.abs(after.carry.physics.qpos - free.carry.physics.qpos).max(axis=1) > 1e-3)
    errors, touched = np.concatenate(errors), np.concatenate(touched)
    assert touched.sum() > 50
    assert np.median(errors[touched]) < most and errors[~touched].max() < most


def test_solid_walls_leave_no_gap():
    """Points just outside the walls' lines are inside a box, points just inside are not, for 500 m either way."""
    model = walls.model("solid")
    boxes = [model.geom(i) for i in range(model.ngeom) if model.geom(i).name.startswith("wall")]
    x = np.r_[np.arange(-500, 500, 0.37), 20, 60, 100, 20 + 1e-6, 60 - 1e-6, 60 + 1e-6]
    x = x[x != 60]  # the reference's centre line jumps there
    line = -np.asarray(corridor.off_centre(x, np.zeros_like(x)))
    for side in (1, -1):
        for beyond, blocked in ((0.01, True), (-0.01, False)):
            points = np.stack([x, line + side * (5 + beyond), np.full_like(x, 0.3)], axis=1)
            inside = np.zeros(len(x), bool)
            for box in boxes:
                body, rotation = model.body(box.bodyid[0]), np.zeros(9)
                mujoco.mju_quat2Mat(rotation, body.quat)
                inside |= (np.abs((points - body.pos) @ rotation.reshape(3, 3)) <= box.size).all(axis=1)
            assert (inside == blocked).all()


@pytest.mark.full
def test_a_corridor_that_sways_costs_where_it_is_and_is_seen_there():
    """A quarter of a period after phase 0 the centre line is a metre aside; what is hidden is only the observation."""
    far = centre(5.0) + 2.7  # from a line that stands still: half a metre inside of the danger band
    qpos = np.array([5.0, far, 0.75, 1, 0, 0, 0, *np.zeros(8)])
    for quarter, costs in ((0.0, 0.0), (1.0, 0.0), (3.0, 1.0)):
        phase = quarter * np.pi / 2
        for sway in ("seen", "hidden"):
            env = swaying(sway)
            state = env.restore(qpos, np.zeros(14), phase=phase)
            line = np.sin(phase) if sway == "seen" else 0.0
            np.testing.assert_allclose(state.global_state[28], far - centre(5.0) - line, atol=1e-5)
            if sway == "seen":
                np.testing.assert_allclose(state.global_state[29], 0.2 * np.pi * np.cos(phase), atol=1e-6)
            after = jax.jit(env.step)(state, jnp.zeros((2, 4)))
            np.testing.assert_allclose(env.raw(after)["phase"], phase + 0.01 * np.pi, atol=1e-6)
            assert float(after.cost[0, 0]) == costs


@pytest.mark.full
def test_a_sway_moves_nothing_but_the_line():
    """The same ant and the same physics; two resets have two phases."""
    still, moving = envs.make("ant_2x4", physics="mujoco"), swaying("hidden")
    key, action = jax.random.key(3), jnp.full((2, 4), 0.3)
    start = [jax.jit(env.reset)(key) for env in (still, moving)]
    np.testing.assert_array_equal(start[0].obs, start[1].obs)
    after = [jax.jit(env.step)(state, action) for env, state in zip((still, moving), start, strict=True)]
    np.testing.assert_array_equal(after[0].obs, after[1].obs)
    np.testing.assert_array_equal(after[0].reward, after[1].reward)
    assert moving.raw(start[1])["phase"] != moving.raw(jax.jit(moving.reset)(jax.random.key(4)))["phase"]
    assert swaying("seen").spec.obs_dim == still.spec.obs_dim + 1


@functools.cache
def swaying(kind: str):
    return envs.make("ant_2x4", physics="mujoco", sway=kind, observation="raw" if kind == "seen" else "zscore")


def test_broken_physics_terminates_and_shows():
    env, _ = stepper("mujoco")
    state = env.step(env.reset(jax.random.key(0)), jnp.full((2, 4), jnp.nan))
    assert bool(state.terminated) and not np.isfinite(state.reward)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"physics": "mujco"}, "did you mean 'mujoco'"),
        ({"observation": "zscor"}, "did you mean 'zscore'"),
        ({"walls": "solids"}, "did you mean 'solid'"),
        ({"sway": "seen", "walls": "solid"}, "solid walls do not move"),
        ({"threads": 0}, "threads must be at least 1"),
        ({"partition": "0,1,2,3|4,5,6"}, "each of the actuators 0 to 7 once"),
        ({"phisics": "mjx"}, "did you mean 'physics'"),
    ],
)
def test_mistakes_get_one_sentence(options, said):
    with pytest.raises(TaskError, match=said):
        envs.make("ant_2x4", **{"physics": "mujoco", **options} if "phisics" not in options else options)
