"""What tasks declare for generic code: it must fit what they return."""

from __future__ import annotations

import subprocess
import sys

import jax
import pytest

import envs
from envs.base import declarations
from places import ROOT

NEEDS = {"plain": set(), "scene": {"qpos"}, "map": {"vm_pu"}}  # of the quantities that a picture reads


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.full] if x == "voltage_141" else []) for x in envs.names()]
)
def test_declarations_name_what_is_there(name):
    env = envs.make(name)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    declared = declarations(env)
    assert declared.overflow is None or declared.overflow in state.info
    assert set(envs.columns(name)) <= set(state.info)
    assert NEEDS[declared.picture.kind] <= set(jax.eval_shape(declared.picture.raw, state))
    for make in declared.baselines.values():
        assert jax.eval_shape(make(), state).shape == env.spec.action_mask.shape


def test_a_task_that_declares_nothing_has_the_defaults():
    class Minimal:
        pass

    declared = declarations(Minimal())
    assert declared.picture.kind == "plain" and not declared.baselines and declared.overflow is None
    assert envs.columns("my_env.py") == {}


def test_columns_need_no_jax():
    script = "import sys, envs; assert envs.columns('voltage_33'); assert not {'jax', 'mujoco'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=True)
