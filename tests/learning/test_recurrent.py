"""Recurrent actors and critics: what they remember, until when, and that everything that acts remembers the same."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import pathlib
import signal
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from envs.base import EnvSpec, State
from pmt_jax import evaluate, load_config, load_policy, make_setup, make_train
from pmt_jax.learning import critics, learner, policies
from pmt_jax.learning.maths import gru, running_moments
from pmt_jax.learning.setup import Setup
from pmt_jax.learning.types import Batch, LearnerState, Tag
from pmt_jax.policies import hub, load, numpy_policy, onnx_policy
from pmt_jax.policies.export import weights
from pmt_jax.render import episode
from runs import assert_same_run, rows, saved, stop_after_rows
from small import SMALL

STEPS = 8
LIMIT = 1.0
OPTIMUM = float(STEPS)  # away from the danger in every step
# A policy without memory knows the side in the first step alone. In any other, whatever it does, half of the episodes
# have the danger on the side that it takes: a step that moves earns at most 1 and costs 1/2 in the mean, one that stays
# at 0 earns and costs nothing. With a cost of at most LIMIT an episode, 2 * LIMIT steps move besides the first.
WITHOUT_MEMORY = 1 + 2 * LIMIT


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Carry:
    """side [] -1 or 1, where the danger is; time [] int32."""

    side: jax.Array
    time: jax.Array


class Recall:
    """Two agents move a point along a line, u = mean of their actions in [-1, 1], and it returns to 0 after each step.

    The reward is abs(u), on either side. One side is dangerous for the whole episode: there a step costs 1.
    Observations and the state show the side in the first step alone, and the time.
    """

    engine = "xla"
    shares_cost = True

    def __init__(self) -> None:
        self.spec = EnvSpec(
            name="recall",
            num_agents=2,
            obs_dim=4,
            action_dim=1,
            state_dim=2,
            num_costs=1,
            horizon=STEPS,
            action_mask=np.ones((2, 1), np.float32),
            cost_limit=LIMIT,
        )

    def reset(self, key: jax.Array) -> State:
        side = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
        return self._state(Carry(side, jnp.int32(0)), jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        carry = dataclasses.replace(state.carry, time=state.carry.time + 1)
        return self._state(carry, jnp.clip(action, -1.0, 1.0).mean())

    def _state(self, carry: Any, u: jax.Array) -> State:
        seen = jnp.stack([jnp.where(carry.time == 0, carry.side, 0.0), carry.time / STEPS])
        return State(
            obs=jnp.concatenate([jnp.broadcast_to(seen, (2, 2)), jnp.eye(2)], axis=1),
            global_state=seen,
            reward=jnp.abs(u),
            cost=jnp.broadcast_to(u * carry.side > 0, (2, 1)).astype(u.dtype),
            terminated=jnp.asarray(False),
            info={"u": u},
            carry=carry,
        )


GRU = {**SMALL, "recurrent": "gru", "rollout_length": 20, "steps": 8 * 20 * 2, "minibatches": 2}
ARGUMENTS = ("lane", "--recurrent", "gru", "--num-envs", 4, "--rollout-length", 20, "--log-interval", 2, "--hidden", 8)
ARGUMENTS += ("--minibatches", 2, "--seeds", 2, "--eval-interval", 4, "--eval-episodes", 4, "--no-cache")
LEARNS = {"num_envs": 32, "rollout_length": 12, "steps": 16_000, "hidden": (16,), "minibatches": 2, "epochs": 4}
LEARNS |= {"activation": "tanh", "actor_lr": 3e-3, "critic_lr": 5e-3, "gamma": 0.95}

# Critics of states, critics of observations, and one actor for all agents.
METHODS = pytest.mark.parametrize(
    "method", ["mappo_l", *(pytest.param(method, marks=pytest.mark.full) for method in ("ippo_l", "mappo"))]
)


@functools.cache
def acted(method: str) -> tuple[Setup, LearnerState, LearnerState, Batch]:
    """The second rollout of 20 steps on `recall`, whose episodes have 8: states before and after it, and the batch."""
    setup = make_setup(load_config("switch", method=method, **GRU), Recall())
    start = jax.jit(functools.partial(learner.init, setup))(setup.hyper, jax.random.key(0))
    act = jax.jit(functools.partial(learner.act, setup))
    before, _ = act(setup.hyper, start, {tag: jax.random.fold_in(jax.random.key(1), tag) for tag in Tag})
    after, batch = act(setup.hyper, before, {tag: jax.random.fold_in(jax.random.key(2), tag) for tag in Tag})
    return setup, before, after, batch


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A run of two seeds and 8 updates, whose rollouts of 20 steps end within episodes of 25."""
    from pmt_jax.cli import main

    out = tmp_path_factory.mktemp("recurrent") / "run"
    assert main([str(a) for a in ("train", *ARGUMENTS, "--steps", 640, "--out", out)]) == 0
    return out


# ---------------------------------------------------------------------------------------------------------------------
# The unit, and what it remembers


def test_the_unit_is_that_of_flax():
    gates, hidden = jax.random.normal(jax.random.key(0), (2, 5, 24))[0], jax.random.normal(jax.random.key(1), (5, 8))
    x = jax.random.normal(jax.random.key(2), (5, 3))
    cell = nn.GRUCell(8)
    params = jax.tree.map(lambda w: w + 0.1, cell.init(jax.random.key(3), hidden, x))
    layers = params["params"]
    outer = [layers[f"i{gate}"] for gate in "rzn"]
    gates = jnp.concatenate([x @ w["kernel"] + w["bias"] for w in outer], -1)
    kernel = jnp.concatenate([layers[f"h{gate}"]["kernel"] for gate in "rzn"], -1)
    after = gru.cell(gates, hidden, kernel, layers["hn"]["bias"])
    np.testing.assert_allclose(after, cell.apply(params, hidden, x)[0], rtol=1e-5, atol=1e-6)


def test_every_episode_of_a_sequence_begins_with_nothing():
    """Sequences of 12 steps with ends in many places, against NumPy's form of the unit step after step."""
    gates, hidden = jax.random.normal(jax.random.key(0), (4, 12, 24)), jax.random.normal(jax.random.key(1), (4, 8))
    kernel, bias = jax.random.normal(jax.random.key(2), (8, 24)), jnp.arange(8.0)
    done = np.asarray(jax.random.bernoulli(jax.random.key(3), 0.3, (4, 12)))
    assert 3 < done.sum() < 40 and done[:, :-1].any(1).all()
    states = gru.unroll(gates, hidden, jnp.asarray(done), kernel, bias)
    now = np.asarray(hidden)[:, None]  # [sequences, one agent, H]
    for t in range(12):
        now = numpy_policy._gru(np.asarray(gates)[:, t, None], now, np.asarray(kernel)[None], np.asarray(bias)[None])
        np.testing.assert_allclose(states[:, t], now[:, 0], rtol=1e-5, atol=1e-6)
        now = now * ~done[:, t, None, None]


def test_hidden_states_are_reset_where_an_episode_ends_and_not_where_a_rollout_does():
    _, before, after, batch = acted("mappo_l")
    assert before.rollout.memory and after.rollout.memory
    assert np.flatnonzero(batch.done[:, 0]).tolist() == [3, 11, 19]  # 20 steps were before: 2.5 episodes
    assert np.abs(before.rollout.memory.actor).min() > 0  # within an episode
    np.testing.assert_array_equal(after.rollout.memory.actor, 0)  # the rollout ends with an episode


@METHODS
def test_sequences_give_the_policy_that_acted(method: str):
    """So every ratio is 1 before the first step of an update, in a rollout that begins within an episode."""
    setup, before, _, batch = acted(method)
    assert before.rollout.memory
    none = jnp.zeros_like(batch.log_prob)
    price, cost = jnp.ones((2, 1)), none[..., None]
    samples = policies.policy_samples(setup, price, batch, batch.reward, cost, none, before.rollout.memory.actor)
    params = setup.nets.of_all(before.actor.params)
    log_ratio, kl = jax.vmap(functools.partial(policies.policy_change, setup))(params, samples)
    np.testing.assert_allclose(log_ratio, 0, atol=2e-5)
    np.testing.assert_allclose(kl, 0, atol=1e-5)
    forgetful = dataclasses.replace(samples.obs, hidden=0 * samples.obs.hidden)
    mean, _ = jax.vmap(setup.nets.policy)(params, forgetful)
    apart = np.abs(np.asarray(mean - samples.mean)).max((0, 1, 3))
    assert apart[0] > 1e-4 and apart[4:].max() < 1e-5  # until the first episode ends


@pytest.mark.full
@METHODS
def test_critics_remember_as_step_after_step(method: str):
    setup, before, after, batch = acted(method)
    memory = before.rollout.memory
    assert memory
    memory = dataclasses.replace(memory, critic=memory.critic + 0.5)
    valued, _, later = critics.appraise(setup, after, batch, memory)
    params, hidden = after.critic.net.params, memory.critic
    seen, following = (batch.obs, batch.next_obs) if setup.own_critics else (batch.state, batch.next_state)
    for t in range(20):
        hidden = setup.nets.advance(params, seen[t], hidden)
        ahead = setup.nets.advance(params, following[t], hidden)
        for x, states in ((valued.value, hidden), (valued.next_value, ahead)):
            value = setup.nets.value(params, critics.Remembered(states))
            np.testing.assert_allclose(x[t], running_moments.denormalise(after.critic.returns, value), atol=1e-5)
        hidden = gru.reset(hidden, batch.done[t])
    assert later.memory
    np.testing.assert_allclose(later.memory.critic, hidden, atol=1e-5)


# ---------------------------------------------------------------------------------------------------------------------
# Learning


@pytest.mark.parametrize(
    "method",
    [
        *(pytest.param(x, marks=pytest.mark.full) for x in ("macpo", "mixed")),
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("mappo_l", "mappo", "ippo_l", "p3o", "focops")),
    ],
)
def test_updates_of_recurrent_networks(method: str):
    """All recurrent networks learn, also what multiplies their hidden states."""
    setup = make_setup(load_config("switch", method=method, **GRU), Recall())
    first = learner.init(setup, setup.hyper, jax.random.key(0))
    step = jax.jit(functools.partial(learner.train_step, setup, setup.hyper))
    state, metrics = step(step(first)[0])
    for new, old in ((state.actor, first.actor), (state.critic.net, first.critic.net)):
        moved = jax.tree.map(lambda x, y: np.abs(np.asarray(x - y)).max(), new.params, old.params)
        assert min(x for path, x in jax.tree_util.tree_leaves_with_path(moved) if "std" not in str(path)) > 0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((state.actor.params, metrics["step_reward"])))


@pytest.mark.full
def test_a_seed_does_not_depend_on_the_others():
    train = make_train(load_config("lane", method="mappo_l", **GRU))
    several = jax.jit(jax.vmap(train))
    keys = jax.vmap(jax.random.key)(jnp.arange(4))
    both = several(keys[:2])[0]
    others = several(keys[jnp.array([3, 1])])[0]
    second, same = (jax.tree.map(lambda x: x[1], learned(state)) for state in (both, others))
    chex.assert_trees_all_equal(second, same)
    alone = jax.jit(train)(keys[1])[0]
    chex.assert_trees_all_close(learned(alone), second, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_jitted_or_not():
    train = make_train(load_config("lane", **{**GRU, "num_envs": 2, "rollout_length": 3, "steps": 6}))
    jitted, _ = jax.jit(train)(jax.random.key(0))
    with jax.disable_jit():
        plain, _ = train(jax.random.key(0))
    chex.assert_trees_all_close(learned(jitted), learned(plain), rtol=1e-4, atol=1e-5)


def learned(state: LearnerState) -> Any:
    return state.actor.params, state.critic.net.params, state.cost_critic.net.params, state.rollout.memory


@pytest.mark.full
def test_only_a_policy_that_remembers_comes_near_the_optimum():
    """Each of 6 seeds earned 8.00 at no cost under mean actions; while training 7.6 or more after 9,000 steps."""
    config = load_config({"task": "lane"}, method="mappo_l", recurrent="gru", **LEARNS)
    state, _ = jax.jit(make_train(config, Recall()))(jax.random.key(0))
    setup = make_setup(config, Recall())
    results = jax.jit(functools.partial(evaluate, setup, episodes=256, deterministic=True))(state)
    assert WITHOUT_MEMORY < 0.95 * OPTIMUM <= results["episode_reward"].mean()
    assert results["episode_cost"].mean() <= LIMIT


# ---------------------------------------------------------------------------------------------------------------------
# Runs, and what is made of them


@pytest.mark.full
def test_resumed_within_an_episode_bit_for_bit(trained: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch):
    out = tmp_path / "run"
    stop_after_rows(monkeypatch, signal.SIGTERM)
    assert cli("train", *ARGUMENTS, "--steps", 640, "--out", out)[0] == 128 + 15
    monkeypatch.undo()
    memory = {path: x for path, x in saved(out).items() if path.startswith("['last'].rollout.memory")}
    assert len(memory) == 3 and all(np.abs(x).max() > 0 for x in memory.values())
    assert cli("train", *ARGUMENTS, "--steps", 640, "--out", out, "--resume")[0] == 0
    assert_same_run(out, trained)


@pytest.mark.full
def test_policies_loaded_exported_and_drawn_act_as_the_one_that_was_evaluated(
    trained: pathlib.Path, tmp_path: pathlib.Path, cli
):
    assert cli("eval", trained, "--episodes", 3, "--deterministic", "--save", tmp_path / "steps.npz")[0] == 0
    with np.load(tmp_path / "steps.npz") as file:
        obs, action = file["obs"][1].swapaxes(0, 1), file["action"][1].swapaxes(0, 1)  # [steps, episodes, ...]
    assert cli("export", trained, "-o", tmp_path / "policy", "--seed", 1)[0] == 0
    program = jax.export.deserialize((tmp_path / "policy" / "policy.stablehlo").read_bytes())
    loaded, in_numpy = (
        jax.jit(jax.vmap(load_policy(trained, seed=1))),
        numpy_policy.load(tmp_path / "policy/policy.npz"),
    )
    act = (in_numpy, program.call, loaded)
    hidden = [np.zeros((3, 2, 8), np.float32)] * len(act)
    for t in range(len(obs)):
        given = [(x, np.asarray(obs[t], np.float32), state) for x, state in zip(act, hidden, strict=True)]
        means, hidden = zip(*(x(*each) for x, *each in given), strict=True)
        for mean in means:
            np.testing.assert_allclose(mean, action[t], rtol=1e-4, atol=1e-5)
    for begun in (in_numpy(obs[0])[0], loaded(obs[0])[0]):  # without hidden states an episode begins
        np.testing.assert_allclose(begun, action[0], rtol=1e-4, atol=1e-5)
    assert np.abs(in_numpy(obs[-1])[0] - means[0]).max() > 1e-4  # it does remember


@pytest.mark.full
def test_a_picture_shows_what_the_policy_does(trained: pathlib.Path):
    shown = episode.record_run(trained, seed=1, deterministic=True)
    env, policy, hidden = shown.env, jax.jit(load_policy(trained, seed=1)), None
    step = jax.jit(env.step)
    state = env.reset(jax.random.split(jax.random.fold_in(jax.random.key(episode.EVALUATION_KEY), 0))[0])
    for action in shown.action[1:]:
        mean, hidden = policy(state.obs, hidden)
        np.testing.assert_allclose(mean, action, rtol=1e-4, atol=1e-5)
        state = step(state, mean)


@pytest.mark.parametrize(
    "changes",
    [
        {"method": "mappo", "activation": "elu"},
        pytest.param({"obs_norm": "layernorm", "hidden": [8, 4]}, marks=pytest.mark.full),
        pytest.param({"obs_norm": "layernorm", "layer_norm": False}, marks=pytest.mark.full),
        {"obs_norm": "none", "hidden": [8, 4, 6]},
    ],
)
def test_weights_in_numpy_and_onnx_for_every_kind_of_network(changes: dict, tmp_path: pathlib.Path):
    run = make_setup(load_config("lane", **{"hidden": [8], "recurrent": "gru", **changes}))
    noise = jax.random.normal(jax.random.key(1), (50, 8))
    moments = running_moments.accumulate(running_moments.init((8,)), 3 * noise + 1)
    params = jax.tree.map(lambda x: x + noise[0, 0], jax.jit(run.nets.init_actor)(jax.random.key(0)))
    made = weights(run, params, moments)
    np.savez(tmp_path / "policy.npz", **made)
    obs = np.asarray(5 * jax.random.normal(jax.random.key(2), (12, 2, 8)))
    hidden = np.asarray(jax.random.normal(jax.random.key(3), (12, 2, run.config.hidden[-1])))
    mean, _, after = run.nets.act(params, run.scale(moments, obs), hidden)
    for found, expected in zip(numpy_policy.load(tmp_path / "policy.npz")(obs, hidden), (mean, after), strict=True):
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-5)
    if all(map(importlib.util.find_spec, ("onnx", "onnxruntime"))):
        onnx_policy.write(made, tmp_path / "policy.onnx")
        onnx_policy.check(tmp_path / "policy.onnx", [obs, hidden], [np.asarray(mean), np.asarray(after)])


@pytest.mark.full
def test_a_policy_in_the_hub(trained: pathlib.Path, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(hub, "FOLDER", tmp_path)
    run, _, state = load.load_seed(trained, 1)
    state = jax.tree.map(lambda x: x[None], state)
    acting = load.ActingState(dataclasses.replace(state.actor, opt_state=None), state.obs_moments, state.update)
    hub.save("hub:lane/mappo_l", run.config, acting, {"seed": 1})
    obs = jax.random.normal(jax.random.key(0), (2, 8))
    mine, packed = load_policy(trained, seed=1), load_policy("hub:lane/mappo_l")
    hidden = jnp.full((2, 8), 0.5)
    for ours, theirs in zip(mine(obs, hidden), packed(obs, hidden), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=0.05)


@pytest.mark.full
def test_a_run_starts_from_a_recurrent_one_but_not_from_another(trained: pathlib.Path, tmp_path: pathlib.Path, cli):
    out = tmp_path / "run"
    assert cli("train", *ARGUMENTS, "--steps", 640, "--init", trained, "--out", out)[0] == 0
    assert rows(out)[0]["critic/loss"] != rows(trained)[0]["critic/loss"]
    code, _, error = cli(
        "train",
        "lane",
        "--num-envs",
        4,
        "--rollout-length",
        20,
        "--hidden",
        8,
        "--init",
        trained,
        "--out",
        tmp_path / "b",
    )
    assert code == 2 and "with the same hidden, layer_norm and recurrent" in error and "Traceback" not in error


def test_environments_that_cannot_be_cut_into_minibatches(tmp_path: pathlib.Path, cli):
    sizes = ("--num-envs", 4, "--rollout-length", 30, "--recurrent", "gru")
    code, _, error = cli("train", "lane", *sizes, "--minibatches", 3, "--out", tmp_path / "run")
    assert code == 2 and "the sequences of 4 environments cannot be cut into 3 equal minibatches" in error
    assert not (tmp_path / "run").exists()
