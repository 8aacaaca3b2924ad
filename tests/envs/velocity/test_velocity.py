"""The velocity tasks against transitions recorded from Safety-Gymnasium and SafePO, and against their own rules."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.errors import TaskError
from envs.vector import VectorEnv
from envs.velocity import VARIANTS, robots
from paths import DATA
from stepping import compiled

NAMES = [f"velocity_{variant}" for variant in VARIANTS]
PLACES = ("torso_xpos", "com")  # what `restore` takes next to qpos, of the robots that have it
# engine -> largest error of qpos, qvel, reward, obs; share of rows that may be over
PLAIN = {"observation": "raw", "physics": "mujoco"}  # an engine that has nothing to compile
TOLERANCES = {"mujoco": (2e-5, 5e-4, 5e-4, 1e-3, 0.002), "mjx": (5e-5, 5e-3, 1e-3, 2e-3, 0.01)}
TOLERANCES["fused"] = TOLERANCES["warp"] = TOLERANCES["mujoco"]
EDGE = 1e-4  # m/s to the threshold, within which float32 may decide either way
PARTITIONED = {"velocity_ant_4x2", "velocity_half_cheetah_6x1"}  # the robots of other tasks, shared out otherwise


def each(*full: str):
    late = PARTITIONED | set(full)
    marked = [pytest.param(name, marks=pytest.mark.full if name in late else ()) for name in NAMES]
    return pytest.mark.parametrize("name", marked)


@functools.cache
def recordings() -> dict[str, np.ndarray]:
    with np.load(DATA / "velocity_reference.npz") as data:
        return dict(data)


def recording(name: str) -> dict[str, np.ndarray]:
    return {k.split("/")[1]: x for k, x in recordings().items() if k.startswith(f"{name}/")}


@functools.cache
def made(name: str, physics: str = "mujoco"):
    env = envs.make(name, physics=physics)
    return env, jax.jit(jax.vmap(env.restore)), jax.jit(jax.vmap(env.step))


def restored(name: str, rows, physics: str = "mujoco"):
    _, restore, _ = made(name, physics)
    place = {key: rows[f"{key}0"].astype(np.float32) for key in PLACES if f"{key}0" in rows}
    return restore(rows["qpos0"], rows["qvel0"], rows["warm0"], **place)


def near(actual, expected, tolerance: float, share: float) -> None:
    error = np.abs(np.asarray(actual, np.float64) - expected).reshape(len(expected), -1).max(1)
    assert (error > tolerance).mean() <= share, error.max()


def check_replay(name: str, physics: str) -> None:
    rows, (env, _, step) = recording(name), made(name, physics)
    after = step(restored(name, rows, physics), rows["action"])
    qpos, qvel, reward, obs, share = TOLERANCES[physics]
    near(after.carry.physics.qpos, rows["qpos1"], qpos, share)
    near(after.carry.physics.qvel, rows["qvel1"], qvel, share)
    near(after.reward, rows["reward"], reward, share)
    near(after.obs, rows["obs1"], obs, share)
    near(after.global_state, rows["state1"], obs, share)
    clear = np.abs(rows["speed"] - env.threshold) > EDGE
    assert clear.sum() > 0.8 * len(clear)
    cost = np.broadcast_to(rows["cost"][:, None], after.cost.shape[:2])
    np.testing.assert_array_equal(after.cost[clear, :, 0], cost[clear])
    np.testing.assert_array_equal(after.terminated, rows["terminated"])


@each("velocity_humanoid_9_8")
def test_reproduces_the_recorded_steps(name):
    check_replay(name, "mujoco")


ON_FUSED = {
    "velocity_hopper_3x1": pytest.mark.full,
    "velocity_swimmer_2x1": pytest.mark.full,
    "velocity_humanoid_9_8": pytest.mark.full,
}


@compiled
@pytest.mark.parametrize("name", [pytest.param(name, marks=ON_FUSED.get(name, pytest.mark.slow)) for name in NAMES])
def test_reproduces_the_recorded_steps_on_fused(name):
    """Each robot compiles for seconds. (tests/envs/physics has their states against C.)"""
    check_replay(name, "fused")


# MJX compiles a robot for up to a minute. .ci/run has it with the hands in tests/envs/hands/test_hand_over.py.
@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_reproduces_the_recorded_steps_on_mjx(name):
    check_replay(name, "mjx")


@pytest.mark.gpu
@pytest.mark.parametrize("name", NAMES)
def test_reproduces_the_recorded_steps_on_warp(name):
    pytest.importorskip("warp")
    check_replay(name, "warp")


@each("velocity_humanoid_9_8")
def test_reproduces_the_recorded_resets(name):
    rows, (_, restore, _) = recording(name), made(name)
    state = restore(rows["reset_qpos"], rows["reset_qvel"])
    np.testing.assert_allclose(state.obs, rows["reset_obs"], atol=2e-5)
    np.testing.assert_allclose(state.global_state, rows["reset_state"], atol=2e-5)


@pytest.mark.parametrize("robot", robots.ROBOTS)
def test_models_compile_to_the_recorded_arrays(robot):
    model, seen = robots.model(robot), 0
    for key, expected in recordings().items():
        _, _, field = key.rpartition("/")
        if not key.startswith(f"model/{robot}/") or field == "body_iquat":  # its axes may be chosen otherwise
            continue
        seen += 1
        if field.endswith("_names"):
            kind = field.removesuffix("_names")
            assert [getattr(model, kind)(i).name for i in range(len(expected))] == expected.tolist()
        elif field in ("geom_contype", "geom_conaffinity") and robot == "swimmer":
            assert not getattr(model, field).any()  # its contacts were of predefined pairs, and there were none
        else:
            scale = 2 if field == "geom_margin" else 1  # margins add up since MuJoCo 3.5
            np.testing.assert_allclose(scale * getattr(model, field), expected, atol=1e-12, err_msg=field)
    assert seen > 30


def test_robots_have_the_masses_and_integrators_of_the_original():
    substeps = {"half_cheetah": (5, 0.01, "EULER"), "ant": (5, 0.01, "RK4"), "hopper": (4, 0.002, "RK4")}
    substeps |= {"walker2d": (4, 0.002, "RK4"), "swimmer": (4, 0.01, "RK4"), "humanoid": (5, 0.003, "RK4")}
    masses = {"ant": 0.91088008, "half_cheetah": 14.0, "hopper": 15.8200134, "walker2d": 23.6771366}
    masses |= {"swimmer": 106.81415, "humanoid": 42.1160305}
    for robot, (steps, timestep, integrator) in substeps.items():
        model = robots.model(robot)
        assert (robots.ROBOTS[robot].substeps, model.opt.timestep) == (steps, timestep)
        assert model.opt.integrator == getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
        np.testing.assert_allclose(model.body_mass.sum(), masses[robot], rtol=1e-8)
    for variant, (robot, _, partition) in VARIANTS.items():
        assert sorted(i for agent in partition for i in agent) == list(range(robots.model(robot).nu)), variant


@pytest.mark.full
def test_padding_of_unequal_agents_is_ignored():
    env, _, step = made("velocity_humanoid_9_8")
    assert env.spec.action_mask[0].all() and env.spec.action_mask[1].tolist() == [1] * 8 + [0]
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 2))
    action = jnp.zeros((2, 2, 9)).at[1, 1, 8].set(9.0)
    after = step(state, action)
    np.testing.assert_array_equal(after.info["reward_ctrl"], [0.0, 0.0])


@pytest.mark.full
def test_any_partition_drives_the_same_robot():
    whole = envs.make("velocity_half_cheetah_2x3", partition=((5, 4, 3, 2, 1), (0,)), **PLAIN)
    halves = envs.make("velocity_half_cheetah_2x3", **PLAIN)
    assert whole.spec.action_mask.tolist() == [[1] * 5, [1, 0, 0, 0, 0]] and whole.spec.obs_dim == 19
    ctrl = np.linspace(-1.2, 1.2, 6, dtype=np.float32)
    state = halves.reset(jax.random.key(0))
    a = halves.step(state, ctrl.reshape(2, 3))
    b = whole.step(state, np.array([ctrl[[5, 4, 3, 2, 1]], [ctrl[0], 7, 7, 7, 7]]))
    np.testing.assert_array_equal(a.global_state, b.global_state)
    np.testing.assert_allclose(a.reward, b.reward, rtol=1e-6)


def moving_at(env, speed: float):
    """A half cheetah that stands in the air and glides at `speed` m/s, stepped once with motors at rest."""
    qpos, qvel = np.zeros(9), np.zeros(9)
    qpos[1], qvel[0] = 3.0, speed
    return env.step(env.restore(qpos, qvel), jnp.zeros((2, 3)))


def test_costs_of_speed():
    cheetah = functools.partial(envs.make, "velocity_half_cheetah_2x3")
    for speed, expected in ((3.0, 0), (3.4, 1), (-3.4, 1)):  # backwards too
        assert moving_at(cheetah(), speed).cost.tolist() == [[expected]] * 2
    assert moving_at(cheetah(threshold=2.0), 3.0).cost.tolist() == [[1], [1]]
    np.testing.assert_allclose(moving_at(cheetah(threshold=2.0, cost="excess"), 3.0).cost, 0.5, atol=0.01)
    assert moving_at(cheetah(threshold=2.0, cost="excess"), 5.0).cost.tolist() == [[1], [1]]
    assert moving_at(cheetah(threshold=2.0, cost="excess"), 1.0).cost.tolist() == [[0], [0]]


@pytest.mark.full
def test_falling_as_a_second_cost():
    env = envs.make("velocity_hopper_3x1", fall_cost=True, physics="mujoco")
    assert env.spec.num_costs == 2 and env.spec.cost_limit == (25.0, 0.1)
    lying = np.array([0, 0.5, 0, 0, 0, 0])
    for qpos, expected in ((env.model.qpos0, 0), (lying, 1)):
        after = env.step(env.restore(qpos, np.zeros(6)), jnp.zeros((3, 1)))
        assert after.cost[:, 1].tolist() == [expected] * 3 and int(after.terminated) == expected
    with pytest.raises(TaskError, match="fall_cost would always be 0"):
        envs.make("velocity_swimmer_2x1", fall_cost=True)


def test_raw_observations_are_the_state_and_who_observes():
    env = envs.make("velocity_walker2d_2x3", **PLAIN)
    state = env.restore(env.model.qpos0, np.full(9, 20.0))
    np.testing.assert_array_equal(state.global_state, [*env.model.qpos0[1:], *[10.0] * 9])  # velocities are clipped
    np.testing.assert_array_equal(state.obs, np.c_[np.tile(state.global_state, (2, 1)), np.eye(2)])


@pytest.mark.full
def test_resets_draw_what_the_tasks_say():
    for name, qpos_noise, qvel_noise in (("swimmer_2x1", 0.1, 0.1), ("hopper_3x1", 0.005, 0.005)):
        env, *_ = made(f"velocity_{name}")
        physics = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 2000)).carry.physics
        for x, start, noise in ((physics.qpos, env.model.qpos0, qpos_noise), (physics.qvel, 0, qvel_noise)):
            offset = np.asarray(x) - start
            assert 0.98 * noise < np.abs(offset).max() < 1.001 * noise
            np.testing.assert_allclose(offset.std(axis=0), noise / np.sqrt(3), rtol=0.06)
    env, *_ = made("velocity_ant_2x4")
    physics = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 2000)).carry.physics
    np.testing.assert_allclose(np.linalg.norm(physics.qpos[:, 3:7], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.asarray(physics.qvel).std(axis=0), 0.1, rtol=0.08)


def test_a_picture_shows_speed_by_a_bar_and_too_much_of_it_in_red():
    env = envs.make("velocity_half_cheetah_2x3", physics="mujoco")
    data, scene = mujoco.MjData(env.model), mujoco.MjvScene(env.model, maxgeom=50)
    data.qpos[0] = 57.3
    mujoco.mj_forward(env.model, data)
    drawn = []
    for speed in (1.0, 4.0):
        camera, every = mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(env.model, data, mujoco.MjvOption(), None, camera, every, scene)
        env.decorate(scene, {"qpos": data.qpos, "speed": np.float32(speed)}, 0.0)
        geoms = scene.geoms[: scene.ngeom]
        bar = next(g for g in geoms if g.type == mujoco.mjtGeom.mjGEOM_BOX)
        floor = next(g for g in geoms if g.type == mujoco.mjtGeom.mjGEOM_PLANE)
        torso = next(g for g in geoms if g.type == mujoco.mjtGeom.mjGEOM_CAPSULE)
        drawn.append((float(bar.size[0]), torso.rgba[0] > 2 * torso.rgba[1]))
        assert abs(floor.pos[0] - 57.3) <= 1 and floor.pos[0] % 2 == 0 and bar.pos[2] > torso.pos[2]
    (short, tan), (long, red) = drawn
    np.testing.assert_allclose(long / short, 4, rtol=1e-5)
    assert red and not tan


@pytest.mark.full
def test_standing_still_is_worth_1003_to_the_ant():
    env, *_ = made("velocity_ant_2x4")
    vector = VectorEnv(env, 4)

    @jax.jit
    def episode(key):
        def step(state, _):
            state, outcome = vector.step(state, jnp.zeros((4, 2, 4)))
            return state, (outcome.reward, outcome.cost.sum(), outcome.truncated)

        return jax.lax.scan(step, vector.reset(key), None, length=1000)[1]

    reward, cost, truncated = episode(jax.random.key(0))
    np.testing.assert_allclose(reward.sum(axis=0), 1003, atol=15)
    assert not cost.any() and truncated[-1].all() and not truncated[:-1].any()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"threshold": 0.0}, "threshold must be a speed above 0 m/s, not 0.0"),
        ({"cost": "exces"}, "did you mean 'excess'"),
        ({"observation": "zscor"}, "did you mean 'zscore'"),
        ({"partition": ((0, 1), (2, 3))}, "each of the actuators 0 to 7 to one agent"),
        ({"partition": ((0, 1, 2, 3), (3, 4, 5, 6))}, "each of the actuators 0 to 7 to one agent"),
        ({"partition": (tuple(range(8)), ())}, "every agent at least one"),
        ({"partition": "all"}, r"partition must be a tuple \(\[a, b\] on a command line\) or none, not 'all'"),
    ],
)
def test_mistakes_get_one_sentence(options, said):
    with pytest.raises(TaskError, match=said):
        envs.make("velocity_ant_2x4", **options)


def test_a_partition_of_digits_is_one_of_numbers():
    """As a command line or a file may give it."""
    given, meant = (
        envs.make("velocity_half_cheetah_2x3", physics="mujoco", partition=partition)
        for partition in ((("0", "1", "2"), ("3", "4", "5")), ((0, 1, 2), (3, 4, 5)))
    )
    assert given.declares.actions == meant.declares.actions
