"""Two hands and an object: the task's rules, and physics that all engines agree on."""

from __future__ import annotations

import copy
import functools
import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import physics
from envs.errors import TaskError
from envs.hands import hand_over
from envs.vector import VectorEnv
from paths import ROOT

CATCH = ROOT / "bench" / "results" / "hand_over_catch.json"
COUNT = 1000  # starts of the session's batch; the action 0 is the middle of all ranges, a half-flexed hand


@functools.cache
def made(variant: str = "2x6", **options):
    return envs.make(f"hand_over_{variant}", **{"physics": "mujoco", **options})


@functools.cache
def stepper(**options):
    return jax.jit(jax.vmap(made(**options).step))


@functools.cache
def restore():
    return jax.jit(made().restore)


@functools.cache
def starts(count: int = COUNT):
    return jax.jit(jax.vmap(made().reset))(jax.random.split(jax.random.key(0), count))


def random_actions(key: int, *shape: int) -> jax.Array:
    return jax.random.uniform(jax.random.key(key), (*shape, 2, 20), minval=-1, maxval=1)


def episodes(env, actions: jax.Array, first):
    """States [T, B, ...] that the actions [T, B, 2, 20] lead to from `first`, without resets."""

    def advance(state, action):
        after = jax.vmap(env.step)(state, action)
        return after, after

    return jax.jit(lambda: jax.lax.scan(advance, first, actions)[1])()


def joint_action(**entries: float) -> jax.Array:
    """A [2, 20] action that is 0 but for entries named as a0_4 (agent and index)."""
    action = np.zeros((2, 20), np.float32)
    for name, value in entries.items():
        agent, index = name[1:].split("_")
        action[int(agent), int(index)] = value
    return jnp.asarray(action)


@pytest.mark.parametrize(
    ("variant", "agents", "width"), [("2x6", 2, 20), ("4x3", 4, 12), ("safe_joint", 2, 20), ("safe_finger", 2, 20)]
)
def test_spec(variant, agents, width):
    spec = made(variant).spec
    assert (spec.name, spec.num_agents, spec.action_dim) == (f"hand_over_{variant}", agents, width)
    assert (spec.obs_dim, spec.state_dim, spec.num_costs, spec.horizon, spec.cost_limit) == (211, 398, 1, 75, 2.5)
    assert spec.action_mask.sum(axis=1).tolist() == ([20, 20] if agents == 2 else [8, 12, 8, 12])


def test_model_is_the_task_s():
    model = made().model
    assert (model.nq, model.nv, model.nu, model.ntendon, model.nsensordata) == (55, 54, 40, 8, 60)
    passive = {model.joint(i).name for i in range(48)} - {model.joint(i).name for i in model.actuator_trnid[:, 0]}
    assert passive == {f"h{hand}_{finger}J0" for hand in (0, 1) for finger in ("FF", "MF", "RF", "LF")}
    by_name = {model.actuator(i).name: i for i in range(40)}
    assert [by_name[f"h1_{name}"] for name in ("WRJ1", "FFJ1", "LFJ4", "THJ0")] == [20, 24, 31, 39]
    np.testing.assert_allclose(model.actuator_gainprm[:4, 0], [5, 5, 1, 1])
    np.testing.assert_allclose(model.actuator_forcerange[[0, 1, 4, 15], 1], [4.785, 2.175, 0.7245, 2.3722])
    np.testing.assert_allclose(
        model.actuator_ctrlrange[[0, 4, 11, 39]], [[-0.489, 0.14], [0, 1.571], [0, 0.785], [-1.571, 0]]
    )
    np.testing.assert_allclose(model.body("object").mass, 500 * 4 / 3 * np.pi * 0.03**2 * 0.04)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.body("h0_palm").xpos, [0, -0.29, 0.49], atol=1e-6)
    np.testing.assert_allclose(data.body("h1_palm").xpos, [0, -0.71, 0.49], atol=1e-6)
    np.testing.assert_allclose(data.geom("h0_mfdistal").xmat.reshape(3, 3)[:, 2], [0, -1, 0], atol=1e-6)


@pytest.mark.parametrize(("thing", "mass"), [("egg", 0.0754), ("block", 0.0709), ("pen", 0.0212)])
def test_objects_and_the_hand_s_own_contacts(thing, mass):
    model = hand_over.model(thing, full_hand=True)
    np.testing.assert_allclose(model.body("object").mass, mass, rtol=5e-3)
    assert model.npair == 40 and (model.pair_dim == 1).all()
    np.testing.assert_allclose(model.dof_frictionloss[:3], [0.005, 0.005, 0.001])
    capsule = hand_over.model("egg", capsule=True)
    np.testing.assert_array_equal(capsule.body("object").inertia, hand_over.model("egg").body("object").inertia)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 20)
    assert np.isfinite(data.qpos).all()


@pytest.mark.full
def test_reset_draws_what_the_task_says():
    state = starts()
    qpos = np.asarray(state.carry.physics.qpos)
    low, high = made().model.jnt_range[:24].T
    np.testing.assert_array_equal(qpos[:, :24], qpos[:, 24:48])  # both hands alike
    u = (qpos[:, :24] / 0.2 - low) / (high - low)
    assert u.min() >= -1 - 1e-5 and u.max() <= 1 + 1e-5 and np.abs(u).max() > 0.99
    np.testing.assert_allclose(u.mean(axis=0), 0, atol=0.08)
    offset = qpos[:, 48:51] - hand_over.START
    assert np.abs(offset).max() <= 0.01 + 1e-6 and np.abs(offset).max(axis=0).min() > 0.0098
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 51:], axis=1), 1, atol=1e-6)
    # Rx(pi u) Ry(pi v) = (cos cos, sin cos, cos sin, sin sin) of the half angles
    for turn in (qpos[:, 51:], np.asarray(state.carry.goal_quat)):
        np.testing.assert_allclose(turn[:, 0] * turn[:, 3], turn[:, 1] * turn[:, 2], atol=1e-6)
        np.testing.assert_allclose((turn**2).mean(axis=0), 0.25, atol=0.03)
    assert not np.asarray(state.carry.physics.qvel).any()
    sensed = np.asarray(state.obs)[:, :, [*range(48, 72), *range(137, 167)]]
    assert not sensed.any() and not np.asarray(state.obs)[:, :, 167:187].any()  # no forces, no last action yet


def test_observation_layout():
    env = made()
    rng = np.random.default_rng(0)
    qpos = np.r_[rng.uniform(0.0, 0.1, 48), 0.1, -0.5, 0.6, 0.5, 0.5, -0.5, 0.5].astype(np.float32)
    qvel = rng.normal(size=54).astype(np.float32)
    last_action = np.linspace(-1, 1, 40, dtype=np.float32)
    goal_quat = np.array([0, 1, 0, 0], np.float32)
    force = rng.uniform(-0.4, 0.4, 48).astype(np.float32)
    state = jax.jit(env.restore)(qpos, qvel, goal_quat, last_action, joint_force=force)
    obs, seen = np.asarray(state.obs), np.asarray(state.global_state)
    np.testing.assert_array_equal(seen, np.concatenate([obs[0, :187], obs[1, :187], obs[0, 187:]]))
    np.testing.assert_array_equal(obs[0, 187:], obs[1, 187:])
    model, data = env.model, mujoco.MjData(env.model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    for hand in (0, 1):
        own, joints = obs[hand], slice(24 * hand, 24 * hand + 24)
        low, high = model.jnt_range[joints].T
        np.testing.assert_allclose(own[:24], (2 * qpos[joints] - low - high) / (high - low), atol=1e-5)
        np.testing.assert_allclose(own[24:48], 0.2 * qvel[joints], atol=1e-6)
        np.testing.assert_allclose(own[48:72], 10 * force[joints], atol=1e-5)
        np.testing.assert_allclose(own[167:187], last_action[20 * hand : 20 * hand + 20])
        for i, finger in enumerate(hand_over.FINGERS):
            body, velocity = data.body(f"h{hand}_{finger}distal"), np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body.id, velocity, 0)
            tip = own[72 + 13 * i : 85 + 13 * i]
            np.testing.assert_allclose(tip[:3], body.xpos, atol=1e-5)
            np.testing.assert_allclose(abs(tip[3:7] @ np.roll(body.xquat, -1)), 1, atol=1e-5)
            np.testing.assert_allclose(tip[7:], np.clip(np.r_[velocity[3:], velocity[:3]], -5, 5), atol=1e-4)
    turn = data.body("object").xmat.reshape(3, 3)
    expected = np.r_[0.1, -0.5, 0.6, 0.5, -0.5, 0.5, 0.5, qvel[48:51], 0.2 * turn @ qvel[51:]]
    np.testing.assert_allclose(obs[0, 187:200], expected, atol=1e-5)
    np.testing.assert_allclose(obs[0, 200:], [0, -0.64, 0.54, 1, 0, 0, 0, *(-0.5, -0.5, -0.5, 0.5)], atol=1e-5)


@pytest.mark.full
def test_4x3_is_2x6_cut_in_halves():
    two, four = made(), made("4x3")
    action = np.random.default_rng(0).uniform(-1, 1, 40).astype(np.float32)
    halves = np.full((4, 12), 9.0, np.float32)  # the padding must not matter
    halves[0, :8], halves[1], halves[2, :8], halves[3] = np.split(action, [8, 20, 28])
    start = jax.tree.map(lambda x: x[0], starts())
    a, b = two.step(start, action.reshape(2, 20)), four.step(four.restore(**two.raw(start)), halves)
    np.testing.assert_array_equal(a.global_state, b.global_state)
    np.testing.assert_array_equal(b.obs, np.repeat(a.obs, 2, axis=0))
    np.testing.assert_array_equal(a.carry.last_action, action)


@pytest.mark.parametrize(
    ("variant", "action", "cost"),
    [
        ("2x6", {"a0_4": 0.099}, 0),
        ("2x6", {"a0_4": 0.101}, 1),
        ("2x6", {"a0_4": -0.101}, 1),
        ("2x6", {"a0_3": 1.0, "a0_5": 1.0, "a1_4": 1.0}, 0),
        ("safe_joint", {"a0_4": 0.499, "a0_2": 1.0}, 0),
        ("safe_joint", {"a0_4": -3.0}, 1),
        ("safe_finger", {"a0_2": 0.501}, 1),
        ("safe_finger", {"a0_3": -0.501}, 1),
        ("safe_finger", {"a0_4": 0.501}, 1),
        ("safe_finger", {"a0_2": 0.4, "a0_3": 0.4, "a0_4": 0.4, "a0_5": 1.0}, 0),
    ],
)
def test_cost_depends_on_the_action_alone(variant, action, cost):
    env = made(variant)
    given = jnp.clip(joint_action(**action), -1, 1).reshape(-1)
    np.testing.assert_array_equal(env.cost_of(given), np.full((2, 1), cost))


def test_actions_are_clamped_and_seen_by_the_next_state():
    wild, plain = (stepper()(starts(), jnp.full((COUNT, 2, 20), x)) for x in (7.0, 1.0))
    np.testing.assert_array_equal(wild.global_state, plain.global_state)
    np.testing.assert_array_equal(wild.global_state[:, 167 + 4], 1.0)
    np.testing.assert_array_equal(wild.cost, 1.0)


def test_reward_at_the_goal_is_one_and_falls_as_the_task_says():
    env = made()

    def reward(place, turn, goal):
        carry = restore()(np.r_[np.zeros(48), place, turn], np.zeros(54), np.asarray(goal), np.zeros(40)).carry
        return float(env.reward_of(carry))

    goal = np.array([np.cos(0.4), np.sin(0.4), 0, 0])
    assert reward(hand_over.GOAL, goal, goal) == pytest.approx(1)
    assert reward(hand_over.GOAL, -goal, goal) == pytest.approx(1)  # the same turn
    assert reward(hand_over.GOAL, [1, 0, 0, 0], goal) == pytest.approx(np.exp(-0.2 * 0.8), rel=1e-5)
    assert reward([0, -0.64, 0.64], [0, 0, 0, 1], [0, 1, 0, 0]) == pytest.approx(np.exp(-1 - 0.2 * np.pi), rel=1e-3)


def test_a_fallen_object_ends_the_episode():
    env = made()

    def ended(height: float) -> bool:
        qpos = np.r_[np.zeros(48), 0, -0.5, height, 1, 0, 0, 0]
        return bool(env.ends(restore()(qpos, np.zeros(54), np.array([1, 0, 0, 0]), np.zeros(40)).carry.physics))

    assert (ended(0.1999), ended(0.2001), ended(np.nan)) == (True, False, True)


@pytest.fixture(scope="session")
def holding():
    """Episodes [75, 64] of hands that stay half flexed: qpos before each step, and the vector wrapper's outcomes."""
    vector = VectorEnv(made(), 64)

    def advance(state, _):
        after, outcome = vector.step(state, jnp.zeros((64, 2, 20)))
        return after, (state.env.carry.physics.qpos, outcome)

    return jax.jit(lambda: jax.lax.scan(advance, vector.reset(jax.random.key(0)), None, length=75)[1])()


@pytest.mark.full
def test_still_half_flexed_hands_keep_the_egg_until_time_cuts_the_episode(holding):
    _, outcome = holding
    assert not outcome.terminated.any() and not outcome.truncated[:74].any() and outcome.truncated[74].all()
    np.testing.assert_allclose(outcome.reward.sum(axis=0).mean(), 3.4, atol=0.3)  # what learning has to beat


@pytest.mark.full
def test_contacts_at_rest_are_no_deeper_than_3_mm(holding):
    qpos, _ = holding
    model, depths = made().model, []
    data = mujoco.MjData(model)
    for pose in np.asarray(qpos[-1]):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        depths.append(-min(contact.dist for contact in data.contact))
    assert 0 < max(depths) < 3e-3


def test_energy_does_not_grow_with_actions_off():
    model = copy.copy(made().model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(4):
        mujoco.mj_resetData(model, data)
        data.qpos[:48] = model.jnt_range[:48].mean(axis=1)
        data.qvel[:48], data.qvel[48:51] = rng.normal(size=48), [0, -1, 0.5]
        energies = []
        for _ in range(150):
            mujoco.mj_step(model, data)
            energies.append(
                data.energy[1] + model.body("object").mass[0] * 9.81 * data.qpos[50]
            )  # hands are weightless
        assert max(energies) <= energies[0] + 1e-4 and energies[-1] < 0.9 * energies[0]


@pytest.mark.full
def test_fingertips_sense_the_egg_and_not_their_own_weight(holding):
    env = made()
    in_the_air = np.r_[np.full(48, 0.3), 0, -0.4, 9, 1, 0, 0, 0]
    state = restore()(in_the_air, np.zeros(54), np.array([1, 0, 0, 0]), np.zeros(40))
    after = episodes(env, jnp.zeros((60, 1, 2, 20)), jax.tree.map(lambda x: x[None], state))
    assert np.abs(after.obs[-1, 0, :, 137:167]).max() < 0.01
    weight = np.asarray(holding[1].next_obs[-10:, :, 0, 137:167]).reshape(-1, 5, 6)[..., :3]
    assert np.linalg.norm(weight, axis=-1).max(axis=-1).mean() > 0.5  # 10 x N; the egg weighs 0.74 N


def test_c_engine_reads_the_sensors_that_plain_steps_leave_behind():
    env, state = made(), jax.tree.map(lambda x: x[:4], starts())
    readout = {"sensors": ("sensordata", slice(None))}
    engine = physics.make_engine(env.model, substeps=hand_over.SUBSTEPS, readout=readout, physics="mujoco")
    after, out = jax.vmap(engine.step)(state.carry.physics, jnp.zeros((4, 40)))
    data = mujoco.MjData(env.model)
    for i in range(4):
        mujoco.mj_resetData(env.model, data)
        data.qpos[:] = state.carry.physics.qpos[i]
        mujoco.mj_step(env.model, data, hand_over.SUBSTEPS)
        np.testing.assert_array_equal(after.qvel[i], data.qvel.astype(np.float32))
        np.testing.assert_array_equal(out["sensors"][i], data.sensordata.astype(np.float32))


@pytest.fixture(scope="session")
def both_engines():
    """1,000 random-policy states one control step on, by C and by MJX, with the egg on which they agree."""
    before = episodes(made(egg="capsule"), random_actions(1, 75, 14), jax.tree.map(lambda x: x[:14], starts()))
    before = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:COUNT], before)
    return [stepper(egg="capsule", physics=name)(before, random_actions(2, COUNT)) for name in ("mujoco", "mjx")]


# Median and worst of 1,000 states. Turn and spin suffer from the normals of MJX's capsules, which are 7e-4 rad off.
AGREEMENT = {
    "hand qpos": (2e-6, 1e-4),
    "hand qvel": (2e-4, 1e-2),
    "place": (5e-7, 5e-5),
    "turn": (1.6e-4, 5e-3),
    "spin": (0.054, 1.0),
    "reward": (1e-6, 1e-4),
}


@pytest.mark.full
@pytest.mark.parametrize("name", AGREEMENT)
def test_mjx_agrees_with_c(both_engines, name):
    def quantity(state):
        qpos, qvel = state.carry.physics.qpos, state.carry.physics.qvel
        places = {"hand qpos": qpos[:, :48], "place": qpos[:, 48:51], "turn": qpos[:, 51:]}
        return (places | {"hand qvel": qvel[:, :48], "spin": qvel[:, 51:], "reward": state.reward[:, None]})[name]

    c, m = (np.asarray(quantity(state)) for state in both_engines)
    error = np.abs(c - m).max(axis=1)
    median, most = AGREEMENT[name]
    assert np.median(error) < median and error.max() < most


@pytest.mark.full
def test_engines_agree_exactly_on_costs_and_ends(both_engines):
    c, m = both_engines
    np.testing.assert_array_equal(c.cost, m.cost)
    np.testing.assert_array_equal(c.terminated, m.terminated)
    assert 0 < c.cost.mean() < 1


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["mujoco", "mjx"])
def test_a_thousand_random_steps_break_nothing(physics):
    vector = VectorEnv(made(physics=physics), 256)

    def advance(state, t):
        action = jax.random.uniform(jax.random.fold_in(jax.random.key(3), t), (256, 2, 20), minval=-1, maxval=1)
        state, outcome = vector.step(state, action)
        return state, outcome.non_finite.any()

    broken = jax.jit(lambda: jax.lax.scan(advance, vector.reset(jax.random.key(0)), jnp.arange(1000))[1])()
    assert not broken.any()


@pytest.mark.slow
def test_the_egg_can_be_handed_over():
    """Actions found by search (docs/figures/hand_over.py), from the three starts that they were found on."""
    env, found = made(), json.loads(CATCH.read_text())
    actions = np.asarray(found["actions"], np.float32).reshape(75, 1, 2, 20)
    first = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 3))
    after = episodes(env, jnp.broadcast_to(actions, (75, 3, 2, 20)), first)
    assert (after.reward.sum(axis=0) > 16).all() and not after.cost.any()
    assert (after.info["distance"][-1] < 0.05).all()


def test_decoration_shows_the_goal_and_reddens_the_finger_only_when_it_costs():
    env = made()
    data, raw = mujoco.MjData(env.model), jax.tree.map(np.asarray, env.raw(jax.tree.map(lambda x: x[0], starts())))
    data.qpos[:] = raw["qpos"]
    mujoco.mj_forward(env.model, data)
    finger = {env.model.geom(name).id for name in hand_over.CONSTRAINED}
    for cost in (0.0, 1.0):
        scene = mujoco.MjvScene(env.model, maxgeom=200)
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(env.model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, scene)
        plain = scene.ngeom
        env.decorate(scene, raw, cost)
        assert scene.ngeom == plain + 1
        np.testing.assert_allclose(scene.geoms[plain].pos, hand_over.GOAL, atol=1e-6)
        red = {g.objid for g in scene.geoms[:plain] if np.allclose(g.rgba, hand_over.COST_COLOUR)}
        assert red == (finger if cost else set())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"object": "eg"}, "did you mean 'egg'"),
        ({"egg": "elipsoid"}, "did you mean 'ellipsoid'"),
    ],
)
def test_mistakes_get_one_sentence(options, said):
    with pytest.raises(TaskError, match=said):
        made(**options)
