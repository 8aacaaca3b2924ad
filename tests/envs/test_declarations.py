"""What tasks declare for generic code must fit what they return; options and specs that cannot be are one sentence."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from typing import Any

import jax
import numpy as np
import pytest

import envs
from envs.base import EnvSpec, declarations
from envs.blocks import length, slices
from envs.errors import TaskError, typed
from envs.voltage.control import VoltageControl, load_scenario
from paths import ROOT

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
    assert envs.columns("my_env.py") == {}


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
