"""The contract, over every registered environment; new ones are picked up by themselves."""

from __future__ import annotations

import collections
import dataclasses
import functools
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Env, EnvSpec, State, declarations
from envs.blocks import length, slices
from envs.errors import TaskError, typed
from envs.vector import VectorEnv
from envs.voltage.control import VoltageControl, load_scenario
from paths import ROOT
from pmt_jax.config import load

BATCH = 4
# Variants differ from hand_over_2x6 in numbers only, which hands/test_hand_over.py holds.
ALL = [name for name in envs.names() if not name.startswith("hand_over_") or name == "hand_over_2x6"]
TRACED: collections.Counter[str] = collections.Counter()  # how often a task's step was traced, once a program
SIBLINGS = {"ant_4x2", "voltage_141"}  # of tasks whose code is the same
SIBLINGS |= {name for name in ALL if name.startswith("velocity_") and name != "velocity_hopper_3x1"}
SIBLINGS |= {name for name in ALL if name.startswith("multi_goal_") and name != "multi_goal_point_0"}


# A sibling of each kind of task with a robot, and those whose own tests step them on the engine of the default tests.
FULL = ("velocity_humanoid_9_8", "multi_goal_ant_2", "velocity_hopper_3x1", "multi_goal_point_0", "voltage_33")


def each_task(*full: str, siblings: Sequence[str] = FULL):
    """A test of every task; of `siblings` and of those named in the full suite alone, of others by hand."""
    marks = dict.fromkeys(SIBLINGS, pytest.mark.slow) | dict.fromkeys((*siblings, *full), pytest.mark.full)
    return pytest.mark.parametrize("name", [pytest.param(name, marks=marks.get(name, ())) for name in ALL])


each_code = functools.partial(each_task, siblings=())  # what a sibling's numbers cannot change


@functools.cache
def made(name: str) -> Env:
    return envs.make(name)


@functools.cache
def programs(name: str):
    """reset and step of a batch, compiled once for all tests of this file."""
    env = made(name)

    def step(state: State, action: jax.Array) -> State:
        TRACED[name] += 1
        return env.step(state, action)

    return jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(step))


def start(name: str, seed: int = 0) -> State:
    return programs(name)[0](jax.random.split(jax.random.key(seed), BATCH))


def actions(name: str, seed: int = 1) -> jax.Array:
    spec = made(name).spec
    return jax.random.uniform(jax.random.key(seed), (BATCH, spec.num_agents, spec.action_dim), minval=-1, maxval=1)


def raw_data(tree):
    return jax.tree.map(lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x, tree)


@each_task()
def test_its_configuration_describes_it(name: str):
    spec = made(name).spec
    for fact in (f" {spec.num_agents} agents", f" {spec.horizon} steps", f"limit {spec.cost_limit:g}"):
        assert fact in load.about(name)


@each_task()
def test_shapes_and_dtypes(name: str):
    spec, state = made(name).spec, start(name)
    assert spec.name == name
    n, k = spec.num_agents, spec.num_costs
    chex.assert_shape(state.obs, (BATCH, n, spec.obs_dim))
    chex.assert_shape(state.global_state, (BATCH, spec.state_dim))
    chex.assert_shape(state.reward, (BATCH,))
    chex.assert_shape(state.cost, (BATCH, n, k))
    chex.assert_shape(state.terminated, (BATCH,))
    chex.assert_shape(list(state.info.values()), (BATCH,))
    assert state.terminated.dtype == bool
    assert spec.action_mask.shape == (n, spec.action_dim)
    assert set(np.unique(spec.action_mask)) <= {0, 1}
    assert spec.horizon > 0 and spec.cost_limit >= 0
    assert not state.reward.any() and not state.cost.any() and not state.terminated.any()


@each_task()
def test_step_keeps_the_structure_that_reset_made(name: str):
    env = made(name)
    reset = jax.eval_shape(env.reset, jax.random.key(0))
    step = jax.eval_shape(env.step, reset, jnp.zeros((env.spec.num_agents, env.spec.action_dim)))
    chex.assert_trees_all_equal_structs(reset, step)

    def described(tree):
        return [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(tree)]

    assert described(reset) == described(step)


@each_task()
def test_cost_lies_in_the_unit_interval_and_everything_is_finite(name: str):
    state, step = start(name), programs(name)[1]
    for seed in range(5):
        state = step(state, actions(name, seed))
        assert ((state.cost >= 0) & (state.cost <= 1)).all()
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating))


@each_task()
def test_pure(name: str):
    step, state = programs(name)[1], start(name)
    before = jax.tree.map(np.array, raw_data(state))
    first, second = step(state, actions(name)), step(state, actions(name))
    chex.assert_trees_all_equal(raw_data(first), raw_data(second))
    chex.assert_trees_all_equal(before, jax.tree.map(np.array, raw_data(state)))


@each_task()
def test_starts_differ_between_keys_and_repeat_with_a_key(name: str):
    if name in ("lane", "switch", "noisy"):
        pytest.skip("the toys start at their origin, by definition")
    state = start(name)
    assert len(np.unique(np.asarray(state.global_state), axis=0)) == BATCH
    chex.assert_trees_all_equal(raw_data(state), raw_data(start(name)))


@each_task()
def test_no_recompilation_between_steps(name: str):
    step, state = programs(name)[1], start(name)
    state = step(state, actions(name, 0))
    traced = TRACED[name]
    for seed in range(3):
        state = step(state, actions(name, seed))
    assert TRACED[name] == traced > 0


@each_task()
def test_restore_is_the_inverse_of_raw(name: str):
    env, step = made(name), programs(name)[1]
    state = step(start(name), actions(name, 0))
    restored = jax.jit(jax.vmap(lambda s: env.restore(**env.raw(s))))(state)
    # These observe forces of the last step or its motors, which are no part of what it starts from.
    if name != "velocity_humanoid_9_8" and not name.startswith("multi_goal_"):
        np.testing.assert_allclose(restored.obs, state.obs, rtol=1e-6, atol=1e-6)
    chex.assert_trees_all_equal(raw_data(restored.carry), raw_data(state.carry))
    after, expected = step(restored, actions(name, 1)), step(state, actions(name, 1))
    chex.assert_trees_all_equal(raw_data(after), raw_data(expected))


@each_code("hand_over_2x6", "voltage_33", "multi_goal_point_0")
def test_same_numbers_jitted_or_not(name: str):
    env = made(name)
    state = jax.tree.map(lambda x: x[0], start(name))
    jitted = jax.tree.map(lambda x: x[0], programs(name)[1](start(name), actions(name)))
    if env.engine == "mjx":
        pytest.skip("op by op, MJX takes minutes")
    plain = env.step(state, actions(name)[0])
    chex.assert_trees_all_close(raw_data(plain), raw_data(jitted), rtol=1e-5, atol=1e-5)


@each_code("hand_over_2x6", "voltage_33", "multi_goal_point_0")
def test_batches_nest(name: str):
    env = made(name)
    state = start(name)
    pairs = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), state)
    nested = jax.jit(jax.vmap(jax.vmap(env.step)))(pairs, actions(name).reshape(2, 2, *actions(name).shape[1:]))
    flat = programs(name)[1](state, actions(name))
    unnested = jax.tree.map(lambda x: x.reshape(BATCH, *x.shape[2:]), nested)
    chex.assert_trees_all_close(raw_data(unnested), raw_data(flat), rtol=1e-5, atol=1e-5)


@each_code("hand_over_2x6", "voltage_33", "multi_goal_point_0")
def test_auto_reset_starts_anew_every_time(name: str):
    vector = VectorEnv(made(name), 2, horizon=2)
    step = jax.jit(vector.step)
    state = jax.jit(vector.reset)(jax.random.key(0))
    starts = [np.asarray(state.env.global_state)]
    keys = [state.episode]
    for t in range(4):
        state, outcome = step(state, actions(name)[:2])
        assert outcome.truncated.all() == (t % 2 == 1) or outcome.terminated.any()
        if t % 2:
            starts.append(np.asarray(state.env.global_state))
            keys.append(state.episode)
    assert [int(k[0]) for k in keys] == [0, 1, 2]
    if name not in ("lane", "switch", "noisy"):
        assert len(np.unique(np.concatenate(starts), axis=0)) == 6


def test_unknown_names_and_options_are_answered_with_the_nearest():
    with pytest.raises(envs.TaskError, match="unknown task 'lan'; did you mean 'lane'"):
        envs.make("lan")
    with pytest.raises(envs.TaskError, match="has no option 'num_agent'; did you mean 'num_agents'"):
        envs.make("lane", num_agent=3)


def test_listing_tasks_imports_neither_jax_nor_mujoco():
    code = "import envs, sys; envs.names(); assert not {'jax', 'mujoco', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


# ---------------------------------------------------------------------------------------------------------------------
# What tasks declare for generic code must fit what they return; options and specs that cannot be are one sentence


LATE = {"voltage_141": pytest.mark.full, "multi_goal_ant_2": pytest.mark.full}
LATE |= {f"multi_goal_{x}": pytest.mark.slow for x in ("point_0", "point_2", "ant_0", "ant_1")}
NEEDS = {"plain": set(), "scene": {"qpos"}, "map": {"vm_pu"}}  # of the quantities that a picture reads


@pytest.mark.parametrize("name", [pytest.param(x, marks=LATE.get(x, ())) for x in envs.names()])
def test_declarations_name_what_is_there(name):
    robot = name.startswith(("velocity", "multi_goal"))
    env = envs.make(name, **{"physics": "mujoco"} if robot else {})  # which has nothing to compile
    state = jax.eval_shape(env.reset, jax.random.key(0))
    declared = declarations(env)
    assert declared.overflow is None or declared.overflow in state.info
    assert set(envs.columns(name)) <= set(state.info)
    assert (length(declared.observation), length(declared.state)) == (state.obs.shape[1], state.global_state.shape[0])
    assert [len(names) for names in declared.actions] == env.spec.action_mask.sum(1).tolist()
    assert NEEDS[declared.picture.kind] <= set(jax.eval_shape(declared.picture.raw, state))
    for make in declared.baselines.values():
        assert jax.eval_shape(make(), state).shape == env.spec.action_mask.shape


def blocks(name: str, agent: int = 0, **options: Any) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """An agent's observation and the global state by block, and the quantities that they show, right after a reset."""
    env: Any = envs.make(name, **options)
    state = jax.jit(env.reset)(jax.random.key(3))
    observation, whole = slices(env.declares.observation), slices(env.declares.state)
    seen = {block: np.asarray(state.obs[agent][where]) for block, where in observation.items()}
    return seen, {block: np.asarray(state.global_state[where]) for block, where in whole.items()}, env.raw(state)


@pytest.mark.parametrize(
    "name", ["ant_4x2", "velocity_ant_2x4", pytest.param("velocity_humanoid_9_8", marks=[pytest.mark.full])]
)
def test_blocks_of_a_robot_hold_what_they_are_called(name):
    seen, state, raw = blocks(name, observation="raw")
    qpos, qvel = raw["qpos"], raw["qvel"]
    expected = {
        "torso height": qpos[2:3],
        "torso orientation": qpos[3:7],
        "joint angles": qpos[7:],
        "torso velocity": qvel[:3],
        "torso spin": qvel[3:6],
        "joint velocities": qvel[6:],
    }
    for block, values in expected.items():
        np.testing.assert_array_equal(seen[block], values)
        np.testing.assert_array_equal(state[block], values)
    np.testing.assert_array_equal(seen["agent index"], np.eye(len(seen["agent index"]))[0])
    if name.startswith("ant"):
        np.testing.assert_allclose(seen["place along x"], qpos[:1] / 5)


def test_blocks_of_a_planar_robot_hold_what_they_are_called():
    seen, _, raw = blocks("velocity_hopper_3x1", observation="raw")
    entries = [*raw["qpos"][1:3], raw["qpos"][3:], *raw["qvel"][:3], raw["qvel"][3:]]
    for values, expected in zip(seen.values(), entries, strict=False):
        np.testing.assert_array_equal(values, np.atleast_1d(expected))
    assert list(seen)[:3] == ["rootz", "rooty", "joint angles"] and list(seen)[3] == "rootx velocity"


@pytest.mark.full
def test_blocks_of_a_grid_hold_what_they_are_called():
    table = load_scenario("case33").table
    regions = [table["zone"] == table["zone"][bus] for bus in table["pv_bus"]]
    agent = int(np.argmax([region.sum() for region in regions]))  # of the largest region, as the blocks are
    seen, state, raw = blocks("voltage_33", agent)
    np.testing.assert_allclose(seen["PV power"], raw["row"][agent])
    np.testing.assert_allclose(seen["inverter's reactive power"], raw["q"][agent])
    np.testing.assert_allclose(seen["voltage"], raw["vm_pu"][regions[agent]])
    np.testing.assert_allclose(seen["voltage angle"], raw["va_rad"][regions[agent]])
    np.testing.assert_allclose(state["voltage"], raw["vm_pu"])
    np.testing.assert_allclose(state["voltage angle"], np.rad2deg(raw["va_rad"]), rtol=1e-5)
    np.testing.assert_allclose(state["active demand"], raw["p_bus"])
    assert set(seen) == set(state)
    longer: Any = envs.make("voltage_33", history=2)
    assert [x.name for x in longer.declares.observation][::6] == ["active demand, 1 steps ago", "active demand"]


@pytest.mark.full
def test_blocks_of_the_hands_hold_what_they_are_called():
    seen, state, raw = blocks("hand_over_2x6")
    np.testing.assert_allclose(seen["object place"], raw["qpos"][48:51])
    np.testing.assert_allclose(seen["goal orientation"], np.roll(raw["goal_quat"], -1))
    np.testing.assert_allclose(seen["joint velocities"], 0.2 * raw["qvel"][:24])
    np.testing.assert_allclose(state["hand 1 joint velocities"], 0.2 * raw["qvel"][24:48])
    np.testing.assert_array_equal(seen["last action"], raw["last_action"][:20])


def test_blocks_of_a_toy_hold_what_they_are_called():
    seen, _, raw = blocks("lane")
    assert seen["position"] == 2 * raw["position"] - 1 and seen["time"] == 0
    np.testing.assert_array_equal(seen["last action"], raw["last_action"].ravel())


def test_a_task_that_declares_nothing_has_the_defaults():
    class Minimal:
        pass

    declared = declarations(Minimal())
    assert declared.picture.kind == "plain" and not declared.baselines and declared.overflow is None
    for name in ("my_env.py", "ant_mine.py", "voltage_mine", "ants"):
        assert envs.columns(name) == {}
    assert envs.columns("ant_6_2") == envs.columns("ant_2x4")


def test_columns_need_no_jax():
    script = "import sys, envs; assert envs.columns('voltage_33'); assert not {'jax', 'mujoco'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=True)


# ---------------------------------------------------------------------------------------------------------------------
# Options of the wrong type or out of range, whichever door they come through


@pytest.mark.parametrize(
    ("task", "options", "says"),
    [
        ("lane", {"num_agents": 2.5}, "num_agents must be a whole number, not 2.5"),
        ("lane", {"num_agents": True}, "num_agents must be a whole number, not True"),
        ("lane", {"num_agents": 0}, "num_agents must be at least 1, not 0"),
        ("ant_2x4", {"threads": "two"}, "threads must be a whole number or none, not 'two'"),
        ("ant_2x4", {"walls": 3}, "walls must be a text, not 3"),
        ("hand_over_2x6", {"full_hand": 1}, "full_hand must be true or false, not 1"),
        ("voltage_33", {"v_lower": "abc"}, "v_lower must be a number, not 'abc'"),
        ("voltage_33", {"v_upper": float("nan")}, "v_upper must be a number, not nan"),
        ("voltage_33", {"v_lower": 1.2}, "v_lower must be below v_upper, but 1.2 is not below 1.05"),
        ("voltage_33", {"data": 3}, "data must be a text or a Path or a Profiles, not 3"),
        ("voltage_33", {"history": 0}, "history must be at least 1, not 0"),
        ("voltage_33", {"v_lower": -1.0}, "v_lower must be a voltage above 0 p.u., not -1"),
        ("voltage_33", {"pv_scale": 0.0}, "pv_scale must be above 0, as the inverters' limits scale with it, not 0"),
        ("voltage_33", {"demand_scale": -1.0}, "demand_scale must be at least 0, not -1.0"),
        ("voltage_33", {"q_weight": -1.0}, "q_weight must be at least 0, not -1.0"),
        ("voltage_33", {"line_weight": -1.0}, "line_weight must be at least 0, not -1.0"),
        ("voltage_33", {"voltage_weight": -1.0}, "voltage_weight must be at least 0, not -1.0"),
        ("voltage_33", {"state_space": ()}, "state_space must keep at least one of demand, pv"),
        ("voltage_33", {"state_space": (1, 2)}, "unknown state_space block '1'"),
        ("ant_2x4", {"threads": 0, "physics": "mjx"}, "threads must be at least 1, not 0"),
        ("hand_over_2x6", {"object": "block", "egg": "capsule"}, "the object is a block; leave egg out"),
    ],
)
def test_options_that_cannot_be(task, options, says):
    with pytest.raises(TaskError) as error:
        envs.make(task, **options)
    assert says in str(error.value)


def test_constructors_check_too_and_take_whole_numbers_for_numbers():
    with pytest.raises(TaskError, match="q_weight must be a number"):
        VoltageControl(q_weight="a lot")

    class Task:
        @typed
        def __init__(self, share: float, *, blocks: str | tuple[str, ...] = ()) -> None:
            self.share = share

    assert Task(1).share == 1 and Task(share=0.5, blocks=("a",)).share == 0.5
    with pytest.raises(
        TaskError, match=r"blocks must be a text or a tuple \(\[a, b\] on a command line\), not \['a'\]"
    ):
        Task(1, blocks=["a"])


@pytest.mark.parametrize("name", ["", "a/b", "..", "../a", ".a", "a..b", "a b", "<b>", "a\nb", "a\\b", "$HOME", None])
def test_a_spec_refuses_names_that_are_no_folders(name):
    with pytest.raises(TaskError, match="spec.name names folders"):
        dataclasses.replace(envs.make("lane").spec, name=name)
    assert isinstance(dataclasses.replace(envs.make("lane").spec, name="my-env_2.1+x"), EnvSpec)


def test_a_spec_takes_one_limit_or_one_for_each_cost():
    spec = dataclasses.replace(envs.make("lane").spec, num_costs=2)
    assert dataclasses.replace(spec, cost_limit=(1.0, 2)).cost_limit == (1.0, 2)
    for wrong in ((1.0,), (1.0, -1.0), float("nan"), "1", (1.0, "2")):
        with pytest.raises(TaskError, match="spec.cost_limit must be a number of at least 0, or a tuple of 2"):
            dataclasses.replace(spec, cost_limit=wrong)
