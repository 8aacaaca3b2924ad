"""Other libraries' own checks of our tasks, and that nothing is lost on the way."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import adapters
from envs.base import State
from envs.toys import HORIZON, Lane


class Fragile(Lane):
    """`lane` that terminates beyond 0.3 and starts anywhere near 0, so that ends and new starts can be told apart."""

    def reset(self, key: jax.Array) -> State:
        return self.restore(jax.random.uniform(key, maxval=0.1), 0, jnp.zeros((2, 2)), key)

    def step(self, state: State, action: jax.Array) -> State:
        state = super().step(state, action)
        return dataclasses.replace(state, terminated=state.carry.position > 0.3)


class Uneven(Lane):
    """`lane` whose second agent has one action entry only."""

    def __init__(self) -> None:
        super().__init__()
        self.spec = dataclasses.replace(self.spec, action_mask=np.array([[1, 1], [1, 0]], np.float32))


@pytest.fixture(scope="module")
def vector():
    pytest.importorskip("gymnasium")
    return adapters.to_gymnasium(Fragile(), 3)


def test_gymnasium_spaces_seeds_and_wrappers(vector):
    import gymnasium

    assert isinstance(vector, gymnasium.vector.VectorEnv)
    obs, info = vector.reset(seed=3)
    assert obs in vector.observation_space and info["global_state"].shape == (3, 6)
    assert (vector.reset(seed=3)[0] == obs).all() and (vector.reset()[0] != obs).any()
    recorded = gymnasium.wrappers.vector.RecordEpisodeStatistics(vector)
    recorded.reset(seed=0)
    for _ in range(HORIZON):
        *_, truncated, info = recorded.step(np.zeros((3, 2, 2)))
    assert truncated.all() and (info["episode"]["l"] == HORIZON).all()


def test_gymnasium_ends(vector):
    """The first environment races over the edge, the others stand still: only the first starts anew."""
    start, _ = vector.reset(seed=0)
    action = np.zeros((3, 2, 2))
    action[0] = 1.0
    obs, reward, terminated, truncated, info = vector.step(action)
    assert terminated.tolist() == [True, False, False] and not truncated.any()
    assert info["_final_obs"].tolist() == [True, False, False]
    position = (info["final_obs"][0, 0, 0] + 1) / 2
    np.testing.assert_allclose(position, 0.8 * (start[0, 0, 0] + 1) / 2 + 0.4, rtol=1e-5)
    np.testing.assert_allclose(reward[0], 1 - (position - 1) ** 2, rtol=1e-5)
    assert obs[0, 0, 0] != start[0, 0, 0] and (obs[0, 0, 0] + 1) / 2 < 0.1  # another start
    _, _, terminated, _, info = vector.step(np.zeros((3, 2, 2)))
    assert not terminated.any() and "final_obs" not in info


@pytest.mark.filterwarnings("error")
def test_pettingzoo_passes_its_own_test():
    pytest.importorskip("pettingzoo")
    from pettingzoo.test import parallel_api_test

    parallel_api_test(adapters.to_pettingzoo(envs.make("noisy")), num_cycles=60)


def test_pettingzoo_agents_have_the_actions_they_have_and_feel_their_costs():
    pytest.importorskip("pettingzoo")
    parallel = adapters.to_pettingzoo(Uneven())
    obs, _ = parallel.reset(seed=1)
    assert [parallel.action_space(agent).shape for agent in parallel.agents] == [(2,), (1,)]
    obs, rewards, terminated, truncated, infos = parallel.step({"agent_0": [1.0, 1.0], "agent_1": [0.5]})
    position = 0.2 * (1 + 0.25)  # the entry that agent_1 lacks counts as 0
    np.testing.assert_allclose(infos["agent_0"]["position"], position, rtol=1e-6)
    np.testing.assert_allclose(list(rewards.values()), 1 - (position - 1) ** 2, rtol=1e-6)
    assert infos["agent_1"]["cost"] == [0] and not any(terminated.values())
    np.testing.assert_allclose(parallel.state()[:5], [2 * position - 1, 1, 1, 0.5, 0])
    for _ in range(HORIZON - 1):
        *_, truncated, infos = parallel.step({"agent_0": [1.0, 1.0], "agent_1": [1.0]})
    assert all(truncated.values()) and parallel.agents == [] and infos["agent_1"]["cost"] == [1]


def test_brax_wrappers_accept_a_task_and_say_what_it_says():
    pytest.importorskip("brax")
    from brax.envs.wrappers import training

    env = envs.make("lane")
    team = adapters.to_brax(env)
    assert (team.observation_size, team.action_size) == (16, 4)
    wrapped = training.EvalWrapper(training.wrap(team, episode_length=HORIZON))
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    first = state.obs
    step = jax.jit(wrapped.step)
    plain, paid = env.reset(jax.random.key(0)), 0
    for _ in range(HORIZON):
        state = step(state, jnp.full((3, 4), 0.5))
        plain = env.step(plain, jnp.full((2, 2), 0.5))
        np.testing.assert_allclose(state.reward, plain.reward, rtol=1e-5)
        paid += plain.cost.mean()
    assert state.done.all() and state.info["truncation"].all()
    np.testing.assert_array_equal(state.obs, first)  # brax has reset it
    np.testing.assert_allclose(state.info["eval_metrics"].episode_metrics["cost"], paid)
    assert step(state, jnp.zeros((3, 4))).done.sum() == 0


def test_a_missing_library_is_one_sentence_and_nothing_is_imported_before_it_is_asked_for():
    code = """
import sys, envs, envs.adapters
assert not {"gymnasium", "pettingzoo", "brax"} & set(sys.modules)
sys.modules["pettingzoo"] = None
try: envs.adapters.to_pettingzoo(envs.make("lane"))
except envs.TaskError as error: print(error)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout == "this adapter needs pettingzoo, which is not installed: pip install pettingzoo\n", result
