"""The learner: equalities between methods, randomness, shapes, and that it learns."""

from __future__ import annotations

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.toys import Lane
from pmt_jax import METHODS, load_config, make_setup, make_train
from pmt_jax.learning import emotions, learner, policy_update, rollout
from pmt_jax.learning.types import LearnerState, Tag

SMALL = {"num_envs": 8, "rollout_length": 25, "steps": 8 * 25 * 3, "log_interval": 1, "hidden": (8,), "epochs": 2}


@functools.cache
def small_run(
    method: str, seeds: int = 1, task: str = "lane", **overrides
) -> tuple[LearnerState, dict[str, jax.Array]]:
    config = load_config(task, method=method, **{**SMALL, **overrides})
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    return jax.jit(jax.vmap(make_train(config)))(keys)


def weights(state: LearnerState):
    return {"actor": state.actor.params, "critic": state.critic.net.params, "lambda": state.multiplier}


# ---------------------------------------------------------------------------------------------------------------------
# Equalities between methods


def test_a_multiplier_that_is_zero_for_ever_makes_mappo_l_happo():
    lagrangian, _ = small_run("mappo_l", lambda_init=0.0, lambda_lr=0.0)
    plain, _ = small_run("happo")
    chex.assert_trees_all_equal(weights(lagrangian), weights(plain))


def test_a_multiplier_that_acts_makes_a_difference():
    with pytest.raises(AssertionError):
        chex.assert_trees_all_equal(weights(small_run("mappo_l")[0])["actor"], weights(small_run("happo")[0])["actor"])


def test_happo_and_mappo_are_the_same_with_one_agent():
    happo, _ = small_run("happo", env=(("num_agents", 1),))
    mappo, _ = small_run("mappo", env=(("num_agents", 1),))
    chex.assert_trees_all_equal(weights(happo), weights(mappo))


def test_regret_that_is_cut_to_nothing_makes_r4sg_mappo_l_and_mixed_f4sg():
    """On `switch`, where costs are there to be regretted from the first step."""

    def same(method: str, other: str) -> None:
        regretless, _ = small_run(method, task="switch", regret_max=0.0)
        chex.assert_trees_all_equal(weights(regretless), weights(small_run(other, task="switch")[0]))

    same("r4sg", "mappo_l")
    same("mixed", "f4sg")


def test_regret_weighs_a_trust_region_too(monkeypatch: pytest.MonkeyPatch):
    """`switch` costs from the first step; with regret cut to nothing the step is that of MACPO."""
    monkeypatch.setitem(METHODS, "macpo_regret", dataclasses.replace(METHODS["macpo"], ratio_weight="regret"))
    one_update = {**SMALL, "steps": 8 * 25}
    config = load_config("switch", method="macpo_regret", **one_update)
    hyper, key = make_setup(config).hyper, jax.random.key(0)
    train = jax.jit(make_train(config))
    without = weights(train(key, dataclasses.replace(hyper, regret_max=jnp.float32(0)))[0])
    chex.assert_trees_all_equal(without, weights(train(key, dataclasses.replace(hyper, kappa=jnp.float32(0)))[0]))
    plain = jax.jit(make_train(load_config("switch", method="macpo", **one_update)))(key)[0]
    chex.assert_trees_all_close(without["actor"], plain.actor.params, rtol=1e-2, atol=2e-4)
    with pytest.raises(AssertionError):
        chex.assert_trees_all_close(weights(train(key, hyper)[0])["actor"], plain.actor.params, rtol=1e-2, atol=2e-4)


@pytest.mark.parametrize("response", ["one_sided", "advantage"])
def test_other_responses_to_regret_act_and_vanish_with_it(response: str):
    plain = weights(small_run("mappo_l", task="switch")[0])
    with pytest.raises(AssertionError):
        chex.assert_trees_all_close(
            weights(small_run("r4sg", task="switch", regret_response=response)[0]), plain, rtol=1e-4
        )
    without, _ = small_run("r4sg", task="switch", regret_response=response, regret_max=0.0)
    chex.assert_trees_all_close(weights(without), plain, rtol=1e-4, atol=1e-5)


def test_fear_that_is_the_cost_itself_makes_f4sg_mappo_l(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(emotions, "appraise_fear", lambda setup, hyper, net, batch, key: (net, batch.cost, {}))
    fearful, _ = small_run.__wrapped__("f4sg", task="switch")
    chex.assert_trees_all_equal(weights(fearful), weights(small_run("mappo_l", task="switch")[0]))


class Harmless(Lane):
    """`lane` where nothing ever costs."""

    def _get_cost(self, position, action, key):
        return jnp.zeros_like(position)


def test_regret_stands_still_where_nothing_ever_costs():
    def trained(method: str) -> LearnerState:
        return jax.jit(make_train(load_config("lane", method=method, **SMALL), Harmless()))(jax.random.key(0))[0]

    regretful = trained("r4sg")
    chex.assert_trees_all_equal(weights(regretful), weights(trained("mappo_l")))
    run = make_setup(load_config("lane", method="r4sg", **SMALL), Harmless())
    start = learner.init(run, run.hyper, jax.random.key(0))
    chex.assert_trees_all_close(regretful.regret.params, start.regret.params, rtol=1e-6)


# ---------------------------------------------------------------------------------------------------------------------
# The sequential update


def test_each_agent_is_corrected_by_the_ratios_of_those_before_it():
    run = make_setup(load_config("lane", method="mappo_l", **SMALL))
    hyper = run.hyper
    state = learner.init(run, hyper, jax.random.key(0))
    tagged = {tag: jax.random.fold_in(jax.random.key(1), tag) for tag in Tag}
    state, batch = learner._act(run, state, tagged[Tag.ACTION])
    noise = jax.random.normal(jax.random.key(2), (*batch.reward.shape, 2, 1))
    rows = policy_update.policy_rows(run, hyper, state, batch, noise[..., 0, 0], noise, jnp.zeros_like(batch.log_prob))
    violation = jnp.asarray([[0.5], [0.25]])
    actor, multiplier, _ = policy_update._sequential(run, hyper, state, rows, violation, tagged)

    factor = jnp.ones_like(rows.factor[0])
    total = jnp.zeros_like(factor)
    for i in np.asarray(jax.random.permutation(tagged[Tag.ORDER], 2)):
        mine = dataclasses.replace(policy_update._select_agent(rows, i), factor=factor)
        net, _ = policy_update.update_policy(
            run,
            hyper,
            policy_update._select_agent(state.actor, i),
            mine,
            violation[i],
            jax.random.fold_in(tagged[Tag.ACTOR], i),
        )
        chex.assert_trees_all_close(net.params, policy_update._select_agent(actor.params, i), rtol=1e-5, atol=1e-6)
        log_ratio = policy_update._moved(run, net.params, mine)[0]
        surrogate = jnp.mean(jnp.exp(log_ratio) * rows.cost_advantage[i, :, 0])
        expected = 0.78 + hyper.lambda_lr * (violation[i, 0] + surrogate)
        np.testing.assert_allclose(multiplier[i, 0], expected, rtol=1e-5)
        factor, total = factor * jnp.exp(log_ratio), total + log_ratio
    np.testing.assert_allclose(factor, jnp.exp(total), rtol=1e-5)
    assert jnp.abs(factor - 1).max() > 1e-3


# ---------------------------------------------------------------------------------------------------------------------
# One program, many seeds


def test_a_seed_among_others_is_that_seed_alone():
    together, metrics = small_run("mappo_l", seeds=3)
    config = load_config("lane", method="mappo_l", **SMALL)
    alone, alone_metrics = jax.jit(make_train(config))(jax.random.key(2))
    third = jax.tree.map(lambda x: x[2], (weights(together), metrics))
    chex.assert_trees_all_close(third, (weights(alone), alone_metrics), rtol=1e-4, atol=1e-5)


def test_seeds_differ():
    state, _ = small_run("mappo_l", seeds=3)
    kernel = jax.tree.leaves(state.actor.params)[-1]
    assert len(np.unique(np.asarray(kernel).reshape(3, -1), axis=0)) == 3


def test_jitted_or_not():
    config = load_config("lane", method="mappo_l", **{**SMALL, "num_envs": 2, "rollout_length": 3, "steps": 6})
    train = make_train(config)
    jitted, _ = jax.jit(train)(jax.random.key(0))
    with jax.disable_jit():
        plain, _ = train(jax.random.key(0))
    chex.assert_trees_all_close(weights(jitted), weights(plain), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("env", [None, {"num_agents": 1}, "two costs"])
@pytest.mark.parametrize("method", METHODS)
def test_an_update_keeps_types_so_that_one_program_serves_all_chunks(method: str, env: object):
    own = TwoDangers() if env == "two costs" else envs.make("lane", **env) if isinstance(env, dict) else None
    run = make_setup(load_config("lane", method=method, **SMALL), own)
    before = jax.eval_shape(functools.partial(learner.init, run), run.hyper, jax.random.key(0))
    after, _ = jax.eval_shape(functools.partial(learner.train_step, run), run.hyper, before)
    chex.assert_trees_all_equal_structs(before, after)
    for x, y in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        assert not y.weak_type and not x.weak_type


def test_hyper_parameters_are_traced_and_can_be_swept():
    config = load_config("lane", method="mappo_l", **{**SMALL, "steps": 200})
    train, base = make_train(config), make_setup(config).hyper
    sweep = jax.tree.map(lambda x: jnp.broadcast_to(x, (3,)), base)
    sweep = dataclasses.replace(sweep, lambda_lr=jnp.asarray([0.0, 0.1, 1.0]))
    state, _ = jax.jit(jax.vmap(train, (None, 0)))(jax.random.key(0), sweep)
    assert len(np.unique(np.asarray(state.multiplier[:, 0, 0]))) == 3
    np.testing.assert_allclose(state.multiplier[0], 0.78)


def test_learning_rates_decay_beyond_two_to_the_31_steps():
    setup = make_setup(load_config("lane", num_envs=128, rollout_length=64))
    hyper = dataclasses.replace(setup.hyper, lr_half_life=jnp.float32(1e9))
    updates = jnp.asarray([122_070, 300_000, 2**31 - 1], jnp.int32)  # 1e9, 2.5e9 and 1.8e13 steps of a seed
    rates = jax.vmap(lambda update: learner._annealed(setup, hyper, update).actor_lr)(updates)
    expected = setup.config.actor_lr * 2.0 ** -(np.float64(updates) * setup.config.batch_size / 1e9)
    np.testing.assert_allclose(rates, expected, rtol=1e-5, atol=1e-30)


def test_step_sizes_of_all_networks_halve_in_their_half_life():
    run = make_setup(load_config("lane", method="mixed", **SMALL))
    rates = ("actor_lr", "critic_lr", "emotion_lr")
    halved = dataclasses.replace(run.hyper, **{name: getattr(run.hyper, name) / 2 for name in rates})
    falling = dataclasses.replace(run.hyper, lr_half_life=jnp.float32(run.config.batch_size))
    step = jax.jit(lambda hyper, state: learner.train_step(run, hyper, state)[0])
    start = learner.init(run, run.hyper, jax.random.key(0))
    first = step(falling, start)
    chex.assert_trees_all_equal(first, step(run.hyper, start))
    second = step(falling, first)
    chex.assert_trees_all_equal(second, step(halved, first))
    with pytest.raises(AssertionError):
        chex.assert_trees_all_equal(second.actor, step(run.hyper, first).actor)


@pytest.mark.parametrize("method", ["mappo", "r4sg"])
def test_an_update_moves_no_policy_further_than_kl_max(method):
    """A shared actor moves for all agents at once, so its bound holds for their mean."""
    run = make_setup(load_config("lane", method=method, actor_lr=3e-3, **SMALL))
    step = jax.jit(lambda hyper, state: learner.train_step(run, hyper, state))
    start = learner.init(run, run.hyper, jax.random.key(0))
    free, figures = step(run.hyper, start)
    far = np.asarray(figures["actor/kl_per_agent"])
    held, held_figures = step(dataclasses.replace(run.hyper, kl_max=jnp.float32(far.mean() / 16)), start)
    near = np.asarray(held_figures["actor/kl_per_agent"])
    assert figures["actor/share_of_step"] == 1.0
    np.testing.assert_allclose(near.mean(), far.mean() / 16, rtol=0.2)
    if method == "mappo":  # one step of all: the same way, a quarter of it (agents in turn answer to those before them)
        share = held_figures["actor/share_of_step"]
        np.testing.assert_allclose(share, 0.25, rtol=1e-5)
        chex.assert_trees_all_close(
            held.actor.params,
            jax.tree.map(lambda x, y: x + share * (y - x), start.actor.params, free.actor.params),
            atol=1e-6,
        )
    never = dataclasses.replace(run.hyper, kl_max=jnp.float32(2 * far.max()))
    chex.assert_trees_all_equal(step(never, start)[0], free)


# ---------------------------------------------------------------------------------------------------------------------
# More costs than one


class TwoDangers(Lane):
    """`lane` with a second cost: going left of -0.1."""

    def __init__(self) -> None:
        super().__init__()
        self.spec = dataclasses.replace(self.spec, num_costs=2)

    def _state(self, carry, last_action, reward, cost):
        state = super()._state(carry, last_action, reward, cost)
        left = jnp.broadcast_to(carry.position < -0.1, (2, 1)).astype(float)
        return dataclasses.replace(state, cost=jnp.concatenate([state.cost, left], axis=1))


def test_two_costs_have_a_multiplier_each():
    config = load_config("lane", method="mappo_l", **SMALL)
    state, _ = jax.jit(make_train(config, TwoDangers()))(jax.random.key(0))
    assert state.multiplier.shape == (2, 2)
    assert jnp.abs(state.multiplier[:, 0] - state.multiplier[:, 1]).max() > 1e-5


# ---------------------------------------------------------------------------------------------------------------------
# Bookkeeping


def test_the_episode_estimate_keeps_its_value_until_an_episode_ends():
    run = make_setup(load_config("lane", **{**SMALL, "rollout_length": 5, "steps": 100}))
    state = learner.init(run, run.hyper, jax.random.key(0))
    _, batch = learner._act(run, state, jax.random.key(1))
    previous = jnp.full((2, 1), 7.0)
    np.testing.assert_array_equal(rollout.episode_cost_estimate(batch, previous, "episode", 25), previous)
    rate = rollout.episode_cost_estimate(batch, previous, "rate", 25)
    np.testing.assert_allclose(rate, 25 * batch.cost.mean((0, 1)))
    ended = dataclasses.replace(batch, truncated=batch.truncated.at[3, 2].set(True))
    np.testing.assert_array_equal(
        rollout.episode_cost_estimate(ended, previous, "episode", 25), batch.episode_cost[3, 2]
    )


def test_episode_figures_count_finished_episodes_only():
    _, metrics = small_run("happo", rollout_length=10, steps=8 * 10 * 5)
    # Episodes of 25 steps end in the third and the fifth update of 10 steps.
    np.testing.assert_array_equal(metrics["episodes"][0], [0, 0, 8, 0, 8])
    assert np.isnan(metrics["episode_reward"][0, [0, 1, 3]]).all()
    assert np.isfinite(metrics["episode_reward"][0, [2, 4]]).all()
    np.testing.assert_array_equal(metrics["episode_length"][0, [2, 4]], 25)


def test_observations_are_normalised_with_what_was_seen_before():
    state, _ = small_run("happo")
    assert state.obs_moments.weight[0] == 3 * 8 * 25 * 2  # updates, environments, steps, agents
    assert state.state_moments.weight[0] == 3 * 8 * 25


# ---------------------------------------------------------------------------------------------------------------------
# Learning


@functools.cache
def learned(task: str, method: str, **changes: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean episode cost and reward of the last 15 of 100 updates, for two seeds."""
    keys = jax.random.split(jax.random.key(1), 2)
    _, metrics = jax.jit(jax.vmap(make_train(load_config(task, method=method, **changes))))(keys)
    return tuple(np.asarray(metrics[name])[:, -15:].mean(1) for name in ("episode_cost", "episode_reward"))


@pytest.mark.parametrize("task", ["lane", "switch"])
@pytest.mark.parametrize("method", ["mappo", "happo"])
def test_unsafe_methods_learn_the_reward_and_pay(task: str, method: str):
    cost, reward = learned(task, method)
    assert (cost >= 20).all() and (reward >= 23).all()


@pytest.mark.parametrize(("task", "most_cost", "least_reward"), [("lane", 4, 15), ("switch", 3, 7)])
@pytest.mark.parametrize("method", ["mappo_l", "macpo", "f4sg", "r4sg", "mixed"])
def test_safe_methods_learn_near_the_limit(task: str, method: str, most_cost: float, least_reward: float):
    cost, reward = learned(task, method)
    assert (cost <= most_cost).all() and (reward >= least_reward).all()


def test_fear_of_the_current_state_cannot_see_what_an_action_costs():
    """On `switch` only the next state knows the action; fear of the current one gives it no blame."""
    cost, _ = learned("switch", "f4sg")
    assert (cost <= 3).all()
    cost, _ = learned("switch", "f4sg", fear_time="current")
    assert cost.mean() >= 10  # four seeds of five stay at 20 or more of 25; one found a way down to 5.5


def test_fear_sees_through_noise_where_the_cost_itself_does_not():
    """On `noisy` (limit 0.5) a step beyond costs three times in ten: fear learns the 0.3, the cost signal is noise."""
    fearful, _ = learned("noisy", "f4sg")
    assert fearful.mean() <= 1.5
    lagrangian, _ = learned("noisy", "mappo_l")
    assert (lagrangian >= 3).all()


def test_the_letter_of_the_paper_runs():
    for preset in ("paper_letter", "reference"):
        for method in ("mixed", "macpo"):
            config = load_config("lane", method=method, preset=preset, **SMALL)
            state, metrics = jax.jit(make_train(config))(jax.random.key(0))
            for x in jax.tree.leaves((weights(state), metrics["actor/loss"])):
                assert np.isfinite(x).all()


def test_every_network_keeps_what_it_learned():
    state, _ = small_run("mixed", task="switch")
    run = make_setup(load_config("switch", method="mixed", **SMALL))
    start = jax.vmap(lambda key: learner.init(run, run.hyper, key))(jax.vmap(jax.random.key)(jnp.arange(1)))

    def nets(state: LearnerState):
        return state.actor, state.critic.net, state.cost_critic.net, state.fear, state.regret

    for now, then in zip(nets(state), nets(start), strict=True):
        assert any((x != y).any() for x, y in zip(*map(jax.tree.leaves, (now.params, then.params)), strict=True))
        assert (jax.tree.leaves(now.opt_state)[0] > 0).all()  # steps of Adam


def test_diagnostics_of_fear_and_regret():
    _, metrics = small_run("mixed")
    fear = {"fear/brier", "fear/ece", "fear/on_costly", "fear/on_safe"}
    regret = {"regret/on_costly", "regret/on_safe", "regret/weight_mean", "regret/weight_std"}
    assert fear | regret <= set(metrics)
    assert metrics["actor/kl_per_agent"].shape == (1, 3, 2)
    _, metrics = small_run("macpo")
    assert {"actor/case", "actor/line_search_steps"} <= set(metrics)


def test_the_environments_of_the_toys_are_what_the_configurations_name():
    for task in ("lane", "switch", "noisy"):
        assert load_config(task).task == task
        assert envs.make(task).spec.name == task
