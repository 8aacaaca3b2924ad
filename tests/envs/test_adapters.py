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
from envs import adapters, user
from envs.base import State
from envs.toys import HORIZON, Lane


class Fragile(Lane):
    """`lane` that terminates beyond 0.3 and starts anywhere near 0, so that new starts show."""

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


def test_pettingzoo_agents_have_the_actions_they_have_and_get_their_costs():
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


def test_jaxmarl_gets_what_the_task_says_and_a_new_episode_in_the_same_step():
    env = Fragile()
    team = adapters.to_jaxmarl(env)
    assert team.observation_space("agent_1").shape == (8,) and team.action_space("agent_0").shape == (2,)
    obs, state = jax.jit(team.reset)(jax.random.PRNGKey(0))
    step = jax.jit(team.step)
    plain = jax.tree.map(lambda x: x[0], state.env)
    np.testing.assert_array_equal(jnp.stack(list(obs.values())), plain.obs)
    for push in (0.2, 1.0):  # the second push ends the episode
        plain = env.step(plain, jnp.full((2, 2), push))
        actions = dict.fromkeys(team.agents, jnp.full(2, push))
        obs, state, rewards, dones, infos = step(jax.random.PRNGKey(1), state, actions)
        np.testing.assert_allclose(list(rewards.values()), plain.reward, rtol=1e-6)
        np.testing.assert_array_equal(infos["cost"], plain.cost.sum(-1))
        assert {bool(done) for done in dones.values()} == {bool(plain.terminated)}
    assert dones["__all__"] and not infos["truncated"].any() and infos["position"].shape == (2,)
    assert (obs["agent_0"][0] + 1) / 2 < 0.1  # where a new episode begins


def test_jaxmarl_ends_with_the_time_limit_and_cuts_actions_that_an_agent_lacks():
    team = adapters.to_jaxmarl(Uneven())
    assert [team.action_space(agent).shape for agent in team.agents] == [(2,), (1,)]
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    _, state = jax.vmap(team.reset)(keys)
    actions = dict.fromkeys(team.agents, jnp.full((3, 2), 0.5))  # a trainer that shares one network pads them
    step = jax.jit(jax.vmap(team.step))
    first = None
    for _ in range(HORIZON):
        _, state, _, dones, infos = step(keys, state, actions)
        first = infos["position"] if first is None else first
    np.testing.assert_allclose(first, 0.2 * (0.5 + 0.25), rtol=1e-6)
    assert dones["__all__"].all() and infos["truncated"].all() and infos["cost"].shape == (3, 2)
    assert not step(keys, state, actions)[3]["__all__"].any()


def test_jaxmarl_wraps_it():
    wrappers = pytest.importorskip("jaxmarl.wrappers.baselines")
    team = wrappers.LogWrapper(adapters.to_jaxmarl(envs.make("lane")))
    _, state = team.reset(jax.random.PRNGKey(0))
    for _ in range(HORIZON):
        _, state, _, _, infos = team.step(jax.random.PRNGKey(0), state, dict.fromkeys(team.agents, jnp.zeros(2)))
    assert (infos["returned_episode_lengths"] == HORIZON).all() and (infos["cost"] == 0).all()


def test_a_brax_environment_becomes_a_task():
    """`lane` to brax and back is `lane`, to the cost's mean over agents."""
    pytest.importorskip("brax")
    lane = envs.make("lane")
    back = adapters.from_brax(adapters.to_brax(lane), "cost", 1.0, horizon=HORIZON, partition=[[3, 0], [1, 2]])
    user.check_shapes(back, "lane and back")
    assert (back.spec.num_agents, back.spec.obs_dim, back.spec.state_dim, back.spec.name) == (2, 18, 16, "braxenv")
    ours, theirs = back.reset(jax.random.key(0)), lane.reset(jax.random.key(0))
    for _ in range(4):
        theirs = lane.step(theirs, jnp.array([[0.1, 0.2], [0.3, 1.0]]))
        ours = jax.jit(back.step)(ours, jnp.array([[1.5, 0.1], [0.2, 0.3]]))  # 1.5 is clipped, as lane does itself
        np.testing.assert_allclose(ours.reward, theirs.reward, rtol=1e-6)
        np.testing.assert_array_equal(ours.cost, jnp.full((2, 1), theirs.cost.mean()))
        np.testing.assert_array_equal(ours.obs[:, :16], jnp.tile(theirs.obs.ravel(), (2, 1)))
        np.testing.assert_array_equal(ours.obs[:, 16:], jnp.eye(2))
    low = adapters.from_brax(adapters.to_brax(lane), "position", 1.0, above=0.2)
    assert (low.spec.num_agents, low.spec.obs_dim, low.spec.action_dim) == (1, 16, 4)
    state = low.step(low.reset(jax.random.key(0)), jnp.full((1, 4), 0.3))  # to 0.12, then 0.216
    assert state.cost == 0 and low.step(state, jnp.full((1, 4), 0.3)).cost == 1


@pytest.mark.parametrize(
    ("metric", "partition", "said"),
    [
        ("costs", "", "unknown metric 'costs'; did you mean 'cost'"),
        ("cost", "0,1|2", "each of the actuators 0 to 3 once"),
        ("cost", "0,1|2,x", "each of the actuators 0 to 3 once"),
    ],
)
def test_brax_environments_that_cannot_be_used(metric: str, partition: str, said: str):
    pytest.importorskip("brax")
    with pytest.raises(envs.TaskError, match=said):
        adapters.from_brax(adapters.to_brax(envs.make("lane")), metric, 1.0, partition=partition)


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
