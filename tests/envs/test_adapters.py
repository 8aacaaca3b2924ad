"""Other libraries' own checks of our tasks, and that nothing is lost on the way."""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib.util
import os
import pickle
import re
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


@pytest.fixture(scope="module")
def vectors(vector):
    """Both modes, on a task whose episodes end by its rule and by the time limit."""
    return {"SameStep": vector, "NextStep": adapters.to_gymnasium(Fragile(), 3, autoreset_mode="NextStep")}


def ends_and_goes_on(env):
    """An episode of the first environment, and what comes after: what `step` returned each time."""
    action = np.zeros((3, 2, 2))
    action[0] = 1.0
    return [env.step(action), env.step(np.zeros((3, 2, 2)))]


def test_gymnasium_tells_the_last_global_state_and_costs_of_an_episode(vectors):
    """A centralised critic bootstraps from the state before the reset, as from `final_obs`."""
    for mode, env in vectors.items():
        env.reset(seed=0)
        (obs, reward, terminated, _, info), (obs_2, reward_2, terminated_2, _, info_2) = ends_and_goes_on(env)
        assert terminated.tolist() == [True, False, False]
        last = info["final_info"] if mode == "SameStep" else info
        last_obs = info["final_obs"] if mode == "SameStep" else obs
        fresh, fresh_state = (obs, info["global_state"]) if mode == "SameStep" else (obs_2, info_2["global_state"])
        np.testing.assert_array_equal(last["global_state"][:, 0], last_obs[:, 0, 0])  # both begin with the position
        np.testing.assert_array_equal(last["position"][0], (last_obs[0, 0, 0] + 1) / 2)
        assert last["position"][0] > 0.3 > (fresh[0, 0, 0] + 1) / 2 and fresh_state[0, 0] == fresh[0, 0, 0]
        assert last["cost"].shape == (3, 2, 1) and (last["cost"] == info["cost"]).all()
        assert not terminated_2.any() and "final_info" not in info_2
        if mode == "SameStep":
            assert info["_final_info"].tolist() == last["_global_state"].tolist() == [True, False, False]
        else:  # the second step only shows the new episode; the others moved on
            assert reward_2[0] == 0 and (info_2["cost"][0] == 0).all() and fresh[0, 0, -3] == 0 and reward_2[1] != 0
            assert (obs_2[:, 0, 5] > 0).tolist() == [False, True, True]  # the time of the episode


def test_both_modes_of_gymnasium_show_the_same_episodes(vectors):
    """Step by step, but for the one step in which `NextStep` shows the start."""
    action = np.random.default_rng(0).uniform(-1, 0.3, (60, 2, 2))
    seen = {}
    for mode, env in vectors.items():
        obs, _ = env.reset(seed=5)
        shown = [obs[0]]
        used, fresh = 0, False
        while used < 40:
            joint = np.broadcast_to(action[used], (3, 2, 2))
            obs, _, terminated, truncated, info = env.step(joint)
            used += not fresh
            fresh = bool(terminated[0] | truncated[0]) and mode == "NextStep"
            ended = terminated[0] | truncated[0]
            shown += [info["final_obs"][0], obs[0]] if ended and mode == "SameStep" else [obs[0]]
        seen[mode] = np.stack(shown)
    np.testing.assert_array_equal(*(x[:40] for x in seen.values()))


def wrappers_of_gymnasium():
    """Every wrapper of vector environments that can be made of one alone, and how."""
    import gymnasium
    from gymnasium.wrappers import vector

    box = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    made = {
        "ClipAction": lambda env: vector.ClipAction(env),
        "ClipReward": lambda env: vector.ClipReward(env, -1, 1),
        "DictInfoToList": vector.DictInfoToList,
        "DtypeObservation": lambda env: vector.DtypeObservation(env, np.float64),
        "FlattenObservation": vector.FlattenObservation,
        "NormalizeObservation": vector.NormalizeObservation,
        "NormalizeReward": vector.NormalizeReward,
        "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
        "RescaleAction": lambda env: vector.RescaleAction(env, -0.5, 0.5),
        "RescaleObservation": lambda env: _bounded(vector, env),
        "ReshapeObservation": lambda env: vector.ReshapeObservation(env, (16,)),
        "TransformAction": lambda env: vector.TransformAction(env, lambda x: 0.5 * x),
        "TransformObservation": lambda env: vector.TransformObservation(
            env, lambda x: x[:, 0, :2], single_observation_space=box
        ),
        "TransformReward": lambda env: vector.TransformReward(env, lambda x: 2 * x),
        "VectorizeTransformObservation": lambda env: vector.VectorizeTransformObservation(
            env, gymnasium.wrappers.TransformObservation, func=lambda x: x[0, :2], observation_space=box
        ),
    }
    return made


def _bounded(vector, env):
    import gymnasium

    box = gymnasium.spaces.Box(-2, 2, (2, 8), np.float32)
    inside = vector.TransformObservation(env, lambda x: x.clip(-2, 2), single_observation_space=box)
    return vector.RescaleObservation(inside, -1, 1)


REFUSES_SAME_STEP = r"Expected .*autoreset_mode.* to be"  # what gymnasium says


def test_gymnasiums_own_wrappers_accept_it(vectors):
    """All that gymnasium has, over the end of an episode; of `SameStep` those that gymnasium allows there."""
    for name, wrap in wrappers_of_gymnasium().items():
        for mode, env in vectors.items():
            try:
                wrapped = wrap(env)
            except ValueError as error:
                assert mode == "SameStep" and re.match(REFUSES_SAME_STEP, str(error)), (name, mode)
                continue
            obs, _ = wrapped.reset(seed=0)
            assert obs in wrapped.observation_space, (name, mode)
            ends_and_goes_on(wrapped)
            for _ in range(2):
                obs, *_ = wrapped.step(wrapped.action_space.sample())
                assert obs in wrapped.observation_space, (name, mode)


@pytest.mark.full
def test_a_client_may_write_to_every_array_without_changing_what_comes(vectors):
    """`obs -= 1`, `reward[done] = 0` and the like are usual; a twin that is left alone shows the same afterwards."""
    for mode, env in vectors.items():
        twin = adapters.to_gymnasium(Fragile(), 3, autoreset_mode=mode)
        returned, expected = [env.reset(seed=1)], [twin.reset(seed=1)]
        for push in (1.0, 0.1, 0.2):
            spoil(returned[-1])
            returned.append(env.step(np.full((3, 2, 2), push)))
            expected.append(twin.step(np.full((3, 2, 2), push)))
        jax.tree.map(np.testing.assert_array_equal, returned[-1], expected[-1])
    for make in (adapters.to_pettingzoo,):
        parallel = make(Fragile())
        returned = [parallel.reset(seed=1)]
        spoil((returned[0], parallel.state()))
        actions = dict.fromkeys(parallel.agents, np.full(2, 0.1))
        spoil(parallel.step(actions))
        before = parallel.state()
        spoil(parallel.state())
        np.testing.assert_array_equal(parallel.state(), before)


def spoil(tree):
    """Writes into every array; one that lies in another's memory would be seen."""
    for x in jax.tree.leaves(tree):
        if isinstance(x, np.ndarray):
            x[...] = x == 0


def check_vector(make):
    """What gymnasium's `check_env` checks of a single environment, of a vector: spaces, seeds, dtypes, shapes."""
    env, twin = make(), make()
    assert env.observation_space.shape == (env.num_envs, *env.single_observation_space.shape)
    assert env.action_space.shape == (env.num_envs, *env.single_action_space.shape)
    for one in (env, twin):
        one.action_space.seed(7)
    first, _ = env.reset(seed=123, options={})
    second, _ = twin.reset(seed=123)
    np.testing.assert_array_equal(first, second)
    assert env.np_random_seed == 123 and first in env.observation_space and first.dtype == env.observation_space.dtype
    for _ in range(2 * HORIZON):
        returned, others = (one.step(one.action_space.sample()) for one in (env, twin))
        jax.tree.map(np.testing.assert_array_equal, returned, others)
        obs, reward, terminated, truncated, info = returned
        assert obs in env.observation_space and obs.dtype == env.observation_space.dtype
        assert reward.shape == terminated.shape == truncated.shape == (env.num_envs,) and isinstance(info, dict)
        assert np.issubdtype(reward.dtype, np.floating) and terminated.dtype == truncated.dtype == bool
    assert (env.reset(seed=1)[0] != env.reset(seed=2)[0]).any()
    env.close()


@pytest.mark.parametrize("mode", ["SameStep", pytest.param("NextStep", marks=pytest.mark.full)])
def test_gymnasium_keeps_what_its_checker_checks(mode: str):
    pytest.importorskip("gymnasium")
    check_vector(lambda: adapters.to_gymnasium(Fragile(), 2, autoreset_mode=mode))


@pytest.mark.parametrize(
    "task",
    [
        pytest.param("ant_2x4", marks=pytest.mark.full),
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("noisy", "switch", "velocity_hopper_3x1")),
        pytest.param("voltage_33", marks=pytest.mark.slow),  # whose power flow compiles eight times
    ],
)
def test_other_libraries_checkers_accept_the_tasks(task: str):
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    env = envs.make(task)
    vector = adapters.to_gymnasium(env, 2, autoreset_mode="NextStep")
    obs, _ = vector.reset(seed=0)
    for _ in range(3):
        obs, *_ = vector.step(vector.action_space.sample())
        assert obs in vector.observation_space
    parallel_api_test(adapters.to_pettingzoo(env), num_cycles=30)
    parallel_seed_test(lambda: adapters.to_pettingzoo(env), num_cycles=10)


@pytest.mark.filterwarnings("error")
def test_pettingzoo_passes_its_own_tests():
    pytest.importorskip("pettingzoo")
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    parallel_api_test(adapters.to_pettingzoo(envs.make("noisy")), num_cycles=60)
    parallel_seed_test(lambda: adapters.to_pettingzoo(Fragile()), num_cycles=60)


def refused(call) -> str:
    """The sentence with which `call` is refused."""
    with pytest.raises(envs.TaskError) as found:
        call()
    assert "\n" not in str(found.value)
    return str(found.value)


def test_what_adapters_refuse():
    pytest.importorskip("pettingzoo")
    lane = envs.make("lane")
    for wrong in (0, -1, 2.5, "3"):
        said = refused(functools.partial(adapters.to_gymnasium, lane, wrong))
        assert "num_envs must be a whole number of at least 1" in said
    said = refused(lambda: adapters.to_gymnasium(lane, 2, autoreset_mode="NEXT_STEP"))
    assert "unknown autoreset_mode 'NEXT_STEP'" in said and "NextStep" in said
    vector, parallel = adapters.to_gymnasium(lane, 2), adapters.to_pettingzoo(lane)
    actions = dict.fromkeys(parallel.possible_agents, np.zeros(2))
    for call in (lambda: vector.step(np.zeros((2, 2, 2))), lambda: parallel.step(actions), parallel.state):
        assert "before reset" in refused(call)
    vector.reset()
    assert "(2, 2, 2), not (2, 2)" in refused(lambda: vector.step(np.zeros((2, 2))))  # which NumPy would stretch
    assert "must be numbers" in refused(lambda: vector.step([["a"]]))
    assert "reset_mask" in refused(lambda: vector.reset(options={"reset_mask": np.array([True, False])}))
    parallel.reset()
    assert "none of agent_1" in refused(lambda: parallel.step({"agent_0": np.zeros(2)}))
    assert "action of agent_0 must have shape (2,)" in refused(
        lambda: parallel.step(actions | {"agent_0": np.zeros(1)})
    )
    for _ in range(HORIZON):
        assert parallel.agents
        parallel.step(actions)
    assert "the episode has ended" in refused(lambda: parallel.step(actions))
    parallel.reset()
    parallel.step(actions)


@pytest.mark.parametrize("mode", ["SameStep", pytest.param("NextStep", marks=pytest.mark.full)])
def test_a_pickled_gymnasium_environment_goes_on_where_it_was(mode: str):
    pytest.importorskip("gymnasium")
    env = adapters.to_gymnasium(Fragile(), 3, autoreset_mode=mode)
    env = pickle.loads(pickle.dumps(env))  # before the first reset
    env.reset(seed=2)
    env.step(np.full((3, 2, 2), 1.0))  # ends all
    copies = [env, pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    for push in (0.1, 0.9, 0.2):
        found = [one.step(np.full((3, 2, 2), push)) for one in copies]
        jax.tree.map(np.testing.assert_array_equal, found[0], found[1], found[2])
    starts = [one.reset()[0] for one in copies]
    np.testing.assert_array_equal(starts[0], starts[1])


def test_a_pickled_pettingzoo_environment_goes_on_where_it_was():
    pytest.importorskip("pettingzoo")
    env = adapters.to_pettingzoo(envs.make("noisy"))
    env.reset(seed=2)
    other = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        actions = dict.fromkeys(env.agents, np.full(2, 0.9))
        jax.tree.map(np.testing.assert_array_equal, env.step(actions), other.step(actions))
    np.testing.assert_array_equal(env.state(), other.state())


@pytest.mark.parametrize("physics", ["fused", "mujoco"])
def test_a_pickled_task_steps_as_the_task_does(physics: str):
    try:
        env = envs.make("velocity_hopper_3x1", physics=physics)
    except envs.TaskError as error:
        pytest.skip(str(error))
    other = pickle.loads(pickle.dumps(env))
    action = 0.3 * jnp.ones(env.spec.action_mask.shape)
    found = []
    for each in (env, other):
        state = jax.jit(each.step)(each.reset(jax.random.key(0)), action)
        found.append((state.obs, state.reward, state.cost, state.info))
    jax.tree.map(np.testing.assert_array_equal, *found)


def test_every_task_can_be_pickled():
    for name in ("lane", "switch", "noisy", "voltage_33"):
        pickle.loads(pickle.dumps(envs.make(name)))


@pytest.mark.full
def test_spaces_have_the_dtypes_of_arrays_in_64_bits_too():
    pytest.importorskip("pettingzoo")
    code = """
import envs, numpy as np
from envs import adapters
vector = adapters.to_gymnasium(envs.make("lane"), 2, autoreset_mode="NextStep")
obs, info = vector.reset()
assert obs.dtype == vector.observation_space.dtype == np.float64 and obs in vector.observation_space, obs.dtype
obs, *_ = vector.step(vector.action_space.sample())
assert obs.dtype == np.float64 and vector.action_space.dtype == np.float64
parallel = adapters.to_pettingzoo(envs.make("lane"))
obs, _ = parallel.reset()
assert all(x in parallel.observation_space(agent) and x.dtype == np.float64 for agent, x in obs.items())
assert parallel.state() in parallel.state_space and parallel.state().dtype == np.float64
obs, *_ = parallel.step({agent: parallel.action_space(agent).sample() for agent in parallel.agents})
assert obs["agent_0"].dtype == np.float64
marl = adapters.to_jaxmarl(envs.make("lane"))
assert marl.observation_space("agent_0").dtype == marl.action_space("agent_0").dtype == np.float64
print("fine")
"""
    environment = {**os.environ, "JAX_ENABLE_X64": "1"}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert result.stdout == "fine\n", result.stderr


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


class Priced(Lane):
    """Its `info` has names that adapters use."""

    def step(self, state: State, action: jax.Array) -> State:
        after = super().step(state, action)
        return dataclasses.replace(after, info=self._named(after.info))

    def reset(self, key: jax.Array) -> State:
        start = super().reset(key)
        return dataclasses.replace(start, info=self._named(start.info))

    def _named(self, info: dict[str, jax.Array]) -> dict[str, jax.Array]:
        return info | dict.fromkeys(("cost", "truncated", "global_state"), jnp.asarray(7.5))


def test_no_name_of_a_task_hides_costs_and_ends():
    env, full, key = Priced(), jnp.ones((2, 2)), jax.random.PRNGKey(0)
    team = adapters.to_brax(env)
    assert team.step(team.reset(key), full.ravel()).metrics["cost"] <= 1
    agents = adapters.to_jaxmarl(env)
    _, state = agents.reset(key)
    infos = agents.step(key, state, dict.fromkeys(agents.agents, full[0]))[-1]
    assert infos["cost"].max() <= 1 and not infos["truncated"].any()
    if importlib.util.find_spec("gymnasium"):
        vector = adapters.to_gymnasium(env, 3)
        _, info = vector.reset(seed=0)
        assert info["cost"].shape == (3, 2, 1) and info["global_state"].shape == (3, 6)
        assert vector.step(np.ones((3, 2, 2), np.float32))[-1]["cost"].shape == (3, 2, 1)
    if importlib.util.find_spec("pettingzoo"):
        parallel = adapters.to_pettingzoo(env)
        _, infos = parallel.reset(seed=0)
        assert infos["agent_0"]["cost"].shape == (1,)


@pytest.mark.full
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
    np.testing.assert_array_equal(team.get_last_world_state(state), plain.global_state)  # before the reset
    np.testing.assert_array_equal(jnp.stack(list(team.get_last_obs(state).values())), plain.obs)
    assert team.get_world_state(state)[0] == obs["agent_0"][0] and team.world_state_size() == 6


@pytest.mark.full
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
    never = adapters.from_brax(adapters.to_brax(lane), "position", 1.0, above=-0.5)
    start = never.reset(jax.random.key(0))
    assert start.cost == start.reward == 0 and never.step(start, jnp.zeros((1, 4))).cost == 1


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


@pytest.mark.full
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
