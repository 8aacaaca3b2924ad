"""The toys' optima, found again by brute force."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.toys import HORIZON


@functools.cache
def program(name: str):
    """Returns and costs [K] of an open-loop sequence: controls [HORIZON, 2, 2], keys [K]."""
    env = envs.make(name)

    def step(state, action):
        state = env.step(state, action)
        return state, (state.reward, state.cost[0, 0])

    def episode(controls, key):
        _, (reward, cost) = jax.lax.scan(step, env.reset(key), controls)
        return reward.sum(), cost.sum()

    return jax.jit(jax.vmap(episode, (None, 0)))


def play(name: str, controls: np.ndarray, keys: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Returns and costs [keys] of an open-loop sequence."""
    return program(name)(jnp.asarray(controls, jnp.float32), jax.vmap(jax.random.key)(jnp.arange(keys)))


def lane_optimum(budget: int) -> float:
    """Dynamic programming over a fine grid of positions and remaining costs."""
    grid = np.linspace(-0.2, 1.2, 1401)  # steps of 0.001; 0.5 is a grid point
    reach = 0.8 * grid[:, None] + 0.4 * np.linspace(-1, 1, 801)
    index = np.rint((reach + 0.2) / 0.001).astype(int)
    inside = (index >= 0) & (index < len(grid))
    index = np.clip(index, 0, len(grid) - 1)
    target = grid[index]
    reward, costly = 1 - (target - 1) ** 2, target > 0.5 + 1e-9
    if budget >= HORIZON:  # the remaining cost is no state then
        budget, costly = 0, np.zeros_like(costly)
    value = np.zeros((budget + 1, len(grid)))
    for _ in range(HORIZON):
        spent = np.concatenate([np.full((1, len(grid)), -np.inf), value[:-1]])
        future = np.where(costly, spent[:, index], value[:, index])
        value = np.where(inside, reward + future, -np.inf).max(-1)
    return float(value[budget, np.argmin(abs(grid))])


@pytest.mark.parametrize(
    ("budget", "optimum"), [(0, 18.64), pytest.param(1, 18.85, marks=pytest.mark.full), (25, 24.561)]
)
def test_lane_optima(budget: int, optimum: float):
    assert abs(lane_optimum(budget) - optimum) < 0.01


def test_lane_played_at_the_edge_and_freely():
    safe = np.full((HORIZON, 2, 2), 0.25)
    safe[0] = 1.0  # 0.4 at once, then 0.8 * 0.5 + 0.1 = 0.5 for ever (approached from below)
    reward, cost = play("lane", safe)
    assert cost == 0 and 18.2 < reward < 18.65
    free = np.full((HORIZON, 2, 2), 0.5)
    free[:2] = 1.0
    free[2] = 0.8 * 0.53
    free[2] = (1 - 0.8 * 0.72) / 0.4
    reward, cost = play("lane", free)
    assert cost == 24
    np.testing.assert_allclose(reward, 24.561, atol=1e-2)


@pytest.mark.parametrize(("late", "reward", "cost"), [(0.3, 16.0, 0), (0.9, 16.36, 1)])
def test_switch_optima(late: float, reward: float, cost: int):
    controls = np.full((HORIZON, 2, 2), 0.5)
    controls[:, 0, 0] = 0.2999999
    controls[-1, 0, 0] = 0.2999999 if cost == 0 else late
    got = play("switch", controls)
    np.testing.assert_allclose(got, ([reward], [cost]), atol=1e-3)


def test_noisy_costs_three_times_in_ten_and_never_the_same_twice():
    over = np.ones((HORIZON, 2, 2))
    costs = play("noisy", over, keys=40)[1]
    assert 0.2 < np.mean(costs) / 24 < 0.4
    assert len(np.unique(costs)) > 3


def test_actions_are_clipped_by_the_environment():
    assert play("lane", np.full((HORIZON, 2, 2), 5.0)) == play("lane", np.ones((HORIZON, 2, 2)))


def test_one_agent():
    env = envs.make("lane", num_agents=1)
    state = env.step(env.reset(jax.random.key(0)), jnp.ones((1, 2)))
    np.testing.assert_allclose(state.carry.position, 0.2)
    assert state.obs.shape == (1, env.spec.obs_dim)
