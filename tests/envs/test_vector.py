"""Ends of episodes: time limit, termination, quarantine, auto-reset."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Env
from envs.toys import Lane
from envs.vector import VectorEnv, VectorState


class Fragile(Lane):
    """`lane` that terminates beyond 1 and breaks (nan) when the first action is exactly -1."""

    def step(self, state, action):
        after = super().step(state, action)
        broken = jnp.where(action[0, 0] == -1.0, jnp.nan, 0.0)
        carry = dataclasses.replace(after.carry, position=after.carry.position + broken)
        reward, terminated = after.reward + broken, carry.position > 1.0
        return dataclasses.replace(after, carry=carry, obs=after.obs + broken, reward=reward, terminated=terminated)


def programs(env: Env, num_envs: int, horizon: int):
    """The vector wrapper's reset and step, compiled."""
    vector = VectorEnv(env, num_envs, horizon=horizon)
    return jax.jit(vector.reset), jax.jit(vector.step)


def test_a_time_limit_truncates_and_keeps_the_true_next_state():
    reset, step = programs(envs.make("lane"), 3, horizon=4)
    state = reset(jax.random.key(0))
    for t in range(4):
        previous = state
        state, outcome = step(state, jnp.ones((3, 2, 2)))
        assert not outcome.terminated.any()
        assert (outcome.truncated == (t == 3)).all()
    expected = 2 * (0.8 * previous.env.carry.position + 0.4) - 1
    np.testing.assert_allclose(outcome.next_global_state[:, 0], expected, rtol=1e-6)  # the true next state ...
    np.testing.assert_array_equal(state.env.global_state[:, 0], -1)  # ... and the one after the reset
    np.testing.assert_array_equal(state.elapsed, 0)
    np.testing.assert_array_equal(state.episode, 1)


def test_termination_is_not_truncation_even_on_the_last_step():
    reset, step = programs(Fragile(), 1, horizon=5)
    state = reset(jax.random.key(0))
    ends = []
    for _ in range(5):
        state, outcome = step(state, jnp.ones((1, 2, 2)))
        ends.append((bool(outcome.terminated[0]), bool(outcome.truncated[0])))
    # 0.4, 0.72, 0.976, 1.18: beyond 1 on the fourth step, one before the limit.
    assert ends == [(False, False)] * 3 + [(True, False), (False, False)]
    reset, step = programs(Fragile(), 1, horizon=4)
    state = reset(jax.random.key(0))
    for _ in range(4):
        state, outcome = step(state, jnp.ones((1, 2, 2)))
    assert outcome.terminated[0] and not outcome.truncated[0]


def test_a_step_that_is_not_finite_is_quarantined_alone():
    reset, step = programs(Fragile(), 2, horizon=9)
    state = reset(jax.random.key(0))
    state, _ = step(state, jnp.full((2, 2, 2), 0.5))
    before = state.env
    state, outcome = step(state, jnp.stack([jnp.full((2, 2), -1.0), jnp.full((2, 2), 0.5)]))
    np.testing.assert_array_equal(outcome.non_finite, [True, False])
    np.testing.assert_array_equal(outcome.terminated, [True, False])
    np.testing.assert_array_equal(outcome.reward[0], 0)
    np.testing.assert_array_equal(outcome.cost[0], 1)
    np.testing.assert_array_equal(outcome.next_obs[0], before.obs[0])
    for leaf in jax.tree.leaves((state.env.obs, state.env.carry.position, outcome)):
        assert np.isfinite(leaf).all()
    np.testing.assert_array_equal(state.env.carry.position[0], 0)  # started anew
    np.testing.assert_array_equal(state.elapsed, [0, 2])


@pytest.mark.parametrize("info", [{}, {"count": jnp.int32(3)}])
def test_info_without_floating_numbers(info: dict[str, jax.Array]):
    class Quiet(Fragile):
        def _state(self, *arguments, **named):
            return dataclasses.replace(super()._state(*arguments, **named), info=info)

    reset, step = programs(Quiet(), 2, horizon=9)
    state, outcome = step(reset(jax.random.key(0)), jnp.stack([jnp.full((2, 2), -1.0), jnp.full((2, 2), 0.5)]))
    np.testing.assert_array_equal(outcome.non_finite, [True, False])
    np.testing.assert_array_equal(state.elapsed, [0, 1])


def test_keys_of_resets_never_repeat():
    reset, step = programs(envs.make("noisy"), 4, horizon=1)
    state = reset(jax.random.key(0))
    seen = []
    for _ in range(5):
        seen.append(np.asarray(jax.random.key_data(state.env.carry.key)))
        state, _ = step(state, jnp.zeros((4, 2, 2)))
    assert len(np.unique(np.concatenate(seen), axis=0)) == 20


@pytest.mark.full
def test_a_time_limit_that_terminates_leaves_nothing_to_bootstrap_from():
    """SafePO's convention: the same episodes, but their ends count as terminations."""
    env = envs.make("lane")
    outcomes = []
    for limit_terminates in (False, True):
        vector = VectorEnv(env, 2, horizon=2, limit_terminates=limit_terminates)
        state, step = vector.reset(jax.random.key(0)), jax.jit(vector.step)
        for _ in range(2):
            state, outcome = step(state, jnp.zeros((2, 2, 2)))
        assert (state.episode == 1).all()
        outcomes.append((outcome.terminated.tolist(), outcome.truncated.tolist()))
    assert outcomes == [([False] * 2, [True] * 2), ([True] * 2, [False] * 2)]


@functools.cache
def side_by_side(resets_all: bool):
    """For two batches of 150: reset, step, and from what a step started all new starts and all plain steps."""
    vector = VectorEnv(Fragile(), 150)
    vector.resets_all = resets_all

    def alternatives(start: VectorState, episode: jax.Array, action: jax.Array):
        keys = jax.vmap(jax.vmap(jax.random.fold_in))(start.key, episode)
        return jax.vmap(jax.vmap(vector.env.reset))(keys), jax.vmap(jax.vmap(vector.env.step))(start.env, action)

    return jax.jit(jax.vmap(vector.reset)), jax.jit(jax.vmap(vector.step)), jax.jit(alternatives)


@pytest.mark.parametrize("resets_all", [False, True])
@pytest.mark.parametrize("ends", [0, 1, 16, 17, 150])
def test_those_that_end_start_anew_however_many_and_no_others(ends: int, resets_all: bool):
    """Two batches of 150 side by side, one without an end; a CPU resets 16 at a time."""
    reset, step, alternatives = side_by_side(resets_all)
    ended = np.isin(np.arange(150), np.random.default_rng(ends).permutation(150)[:ends])
    action = np.full((2, 150, 2, 2), 0.5, np.float32)
    action[0, ended] = -1.0
    start = reset(jax.random.split(jax.random.key(0)))
    after, outcome = step(start, action)
    np.testing.assert_array_equal(outcome.terminated, [ended, np.zeros(150)])
    np.testing.assert_array_equal(after.episode, [ended, np.zeros(150)])
    np.testing.assert_array_equal(after.elapsed, [~ended, np.ones(150)])
    fresh, moved = alternatives(start, after.episode, action)
    for found, new, old in zip(*(jax.tree.leaves(x) for x in (after.env, fresh, moved)), strict=True):
        if jnp.issubdtype(found.dtype, jax.dtypes.prng_key):
            found, new, old = (jax.random.key_data(x) for x in (found, new, old))
        found, new, old = map(np.asarray, (found, new, old))
        np.testing.assert_array_equal(found[0, ended], new[0, ended])
        np.testing.assert_array_equal(found[0, ~ended], old[0, ~ended])
        np.testing.assert_array_equal(found[1], old[1])
