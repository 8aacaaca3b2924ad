"""The contract, over every registered environment; new ones are picked up by themselves."""

from __future__ import annotations

import collections
import functools
import subprocess
import sys
from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Env, State
from envs.vector import VectorEnv
from pmt_jax.config import load

BATCH = 4
# Variants differ from hand_over_2x6 in numbers only, which hands/test_hand_over.py holds.
ALL = [name for name in envs.names() if not name.startswith("hand_over_") or name == "hand_over_2x6"]
TRACED: collections.Counter[str] = collections.Counter()  # how often a task's step was traced, once a program
SIBLINGS = {"ant_4x2", "voltage_141"}  # of tasks whose code is the same
SIBLINGS |= {name for name in ALL if name.startswith("velocity_") and name != "velocity_hopper_3x1"}
SIBLINGS |= {name for name in ALL if name.startswith("multi_goal_") and name != "multi_goal_point_0"}


FULL = ("ant_4x2", "velocity_humanoid_9_8", "multi_goal_ant_2")  # a sibling of each kind of task with a robot


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
