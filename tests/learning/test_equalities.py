"""Equalities between methods: where what makes them differ is nothing, they are the same."""

from __future__ import annotations

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.toys import Lane
from pmt_jax import METHODS, load_config, make_train
from pmt_jax.learning import fear, policies, regret, schedules
from pmt_jax.learning.types import LearnerState, Tag
from small import SMALL, acted, differ, program, trained, weights


def holding(state: LearnerState, **changes: jax.Array) -> LearnerState:
    """`state` with parts of its constraint changed."""
    return dataclasses.replace(state, constraint=dataclasses.replace(state.constraint, **changes))


@pytest.mark.full
def test_a_multiplier_that_is_zero_for_ever_makes_mappo_l_happo():
    lagrangian, _ = trained("mappo_l", lambda_init=0.0, lambda_max=0.0)
    chex.assert_trees_all_equal(weights(lagrangian), weights(trained("happo")[0]))


@pytest.mark.full
def test_a_penalty_of_weight_zero_makes_p3o_happo():
    chex.assert_trees_all_close(weights(trained("p3o", lambda_max=0.0)[0]), weights(trained("happo")[0]), atol=1e-6)
    assert differ(weights(trained("p3o")[0])["actor"], weights(trained("happo")[0])["actor"])


@pytest.mark.slow
def test_the_order_is_a_switch_so_that_p3o_without_weight_is_mappo_too(monkeypatch: pytest.MonkeyPatch):
    together = dataclasses.replace(METHODS["p3o"], order="simultaneous", share_actor=True)
    monkeypatch.setitem(METHODS, "p3o_together", together)
    without, _ = trained("p3o_together", lambda_max=0.0)
    chex.assert_trees_all_close(weights(without), weights(trained("mappo")[0]), atol=1e-6)


class Seen(Lane):
    """`lane` of one agent that observes the global state and nothing else."""

    def __init__(self):
        super().__init__(num_agents=1)
        self.spec = dataclasses.replace(self.spec, obs_dim=self.spec.state_dim)

    def _state(self, *seen, **signals):
        state = super()._state(*seen, **signals)
        return dataclasses.replace(state, obs=state.global_state[None])


@pytest.mark.full
def test_ippo_of_one_agent_that_observes_the_state_is_mappo():
    states = []
    for method in ("ippo", "mappo"):
        train = make_train(load_config("lane", method=method, **SMALL), Seen())
        states.append(weights(jax.jit(train)(jax.random.key(0))[0]))
    chex.assert_trees_all_close(*states, rtol=1e-5, atol=1e-6)


@pytest.mark.full
def test_critics_of_observations_see_nothing_of_other_agents():
    made = program("ippo_l")
    state = made.init(made.setup.hyper, jax.random.key(0))
    obs = jax.random.normal(jax.random.key(1), (3, 2, made.setup.vector.spec.obs_dim))
    other = obs.at[:, 1].set(5.0)
    nets = made.setup.nets
    for net, value in ((state.critic, nets.value), (state.cost_critic, nets.cost_value)):
        before, after = (value(net.net.params, x) for x in (obs, other))
        assert before.shape[:2] == (3, 2)
        np.testing.assert_array_equal(before[:, 0], after[:, 0])
        assert jnp.abs(before[:, 1] - after[:, 1]).min() > 1e-6


@pytest.mark.full
def test_crpo_within_its_limit_is_happo():
    within, metrics = trained("crpo", cost_limit=25.0)
    chex.assert_trees_all_close(weights(within)["actor"], weights(trained("happo")[0])["actor"], atol=1e-6)
    assert metrics["lambda"] == 0
    beyond, metrics = trained("crpo", cost_limit=0.0)
    assert metrics["lambda"] == 1 and differ(weights(beyond)["actor"], weights(within)["actor"])


@pytest.mark.full
def test_an_agent_of_crpo_improves_its_cost_or_the_reward():
    setup, _, batch = acted()
    setup = dataclasses.replace(setup, method=METHODS["crpo"])
    reward, *cost = 10 * jax.random.normal(jax.random.key(2), (3, *batch.reward.shape))  # far from the floor
    none, chosen = jnp.zeros_like(batch.log_prob), jnp.asarray([[1.0], [0.0]])
    rows = policies.policy_samples(setup, chosen, batch, reward, jnp.stack(cost, -1)[..., None], none)
    for advantage, expected in zip(rows.advantage, (-cost[0], reward), strict=True):
        np.testing.assert_allclose(advantage, ((expected - expected.mean()) / expected.std()).ravel(), atol=1e-4)


@pytest.mark.full
def test_pid_pays_with_what_it_has_just_added_up_and_keeps_the_size_of_the_step():
    gains = {"lambda_init": 0.5, "lambda_lr": 0.6, "lambda_kp": 0.5, "lambda_kd": 0.25}  # over three updates
    made = program("mappo_pid")
    state = made.init(made.hyper(**gains), jax.random.key(0))
    integral, previous = 0.5, 0.0
    for _ in range(3):
        state, metrics = made.step(made.hyper(**gains), state)
        excess = min(float(metrics["cost_excess"]), 1.0)
        integral = max(integral + 0.2 * excess, 0.0)
        price = integral + 0.5 * excess + 0.25 * max(excess - previous, 0.0)
        np.testing.assert_allclose(metrics["lambda"], price, rtol=1e-4)
        previous = excess
    np.testing.assert_allclose(state.constraint.multiplier, integral, rtol=1e-4)


@pytest.mark.full
def test_a_multiplier_that_acts_makes_a_difference():
    assert differ(weights(trained("mappo_l")[0])["actor"], weights(trained("happo")[0])["actor"])


@pytest.mark.full
def test_pid_weighs_costs_by_three_terms():
    """A proportional gain weighs costs as a larger multiplier does, from the first update on."""
    plain, limit = program("mappo_l"), {"cost_limit": 8.0}
    without = plain.hyper(lambda_kp=0.0, **limit)
    start = plain.init(without, jax.random.key(0))
    _, metrics = plain.step(without, start)
    excess = metrics["cost_excess"]  # the same of both agents; the estimate before the first update is the limit
    assert 0 < excess < 1
    with_gains, shown = plain.step(plain.hyper(lambda_kp=0.5, lambda_kd=0.25, **limit), start)
    larger, _ = plain.step(without, holding(start, multiplier=start.constraint.multiplier + 0.75 * excess))
    chex.assert_trees_all_close(with_gains.actor.params, larger.actor.params, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(shown["lambda"], with_gains.constraint.multiplier.mean() + 0.75 * excess, rtol=1e-5)
    _, later = plain.step(plain.hyper(lambda_kp=0.0, lambda_kd=0.25, **limit), with_gains)
    rise = max(float(later["cost_excess"] - excess), 0.0)
    np.testing.assert_allclose(
        later["lambda"], plain.step(without, with_gains)[0].constraint.multiplier.mean() + 0.25 * rise, rtol=1e-2
    )


@pytest.mark.full
@pytest.mark.parametrize("method", ["mappo_l", "macpo"])
def test_a_margin_is_a_lower_limit_that_nobody_is_judged_by(method: str):
    """Also by an estimate that remembers what it began with: no excess."""
    kept, shown = trained(method, cost_limit=2.0, cost_margin=0.5)
    lower, others = trained(method, cost_limit=1.0)
    chex.assert_trees_all_equal(weights(kept)["actor"], weights(lower)["actor"])
    assert shown["cost_excess"] == others["cost_excess"]
    assert shown["episode_cost_beyond"] < others["episode_cost_beyond"]


@pytest.mark.full
def test_macpo_keeps_to_the_limit_that_it_lowered():
    made = program("macpo")
    start = made.init(made.setup.hyper, jax.random.key(0))
    lowered = holding(start, lowered=jnp.full_like(start.constraint.lowered, 2 / 12))
    after, metrics = made.step(made.hyper(cost_limit=12.0, limit_lr=0.25), lowered)
    lower, _ = made.step(made.hyper(cost_limit=10.0), start)
    chex.assert_trees_all_close(after.actor.params, lower.actor.params, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(after.constraint.lowered, 2 / 12 + 0.25 * metrics["cost_excess"], rtol=1e-5)


@pytest.mark.full
def test_a_multiplier_grows_by_the_same_share_below_every_limit():
    made = program("mappo_l")
    for limit in 1.0, 0.125:
        after, _ = made.step(
            made.hyper(cost_limit=limit, lambda_lr=0.75),
            made.init(made.setup.hyper, jax.random.key(0)),
        )
        np.testing.assert_allclose(after.constraint.multiplier, 2.0 * (1 + 0.75 / 3), rtol=1e-6)


@pytest.mark.full
def test_happo_and_mappo_are_the_same_with_one_agent():
    """But for rounding: without AVX-512, XLA rounds a loop over one agent and none differently."""
    happo, mappo = (trained(method, env=(("num_agents", 1),))[0] for method in ("happo", "mappo"))
    chex.assert_trees_all_close(weights(happo), weights(mappo), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("method", "without"), [("r4sg", "mappo_l"), pytest.param("mixed", "f4sg", marks=pytest.mark.slow)]
)
def test_regret_that_is_cut_to_nothing_makes_no_difference(method: str, without: str):
    chex.assert_trees_all_equal(weights(trained(method, kappa=0.0)[0]), weights(trained(without)[0]))


@pytest.mark.full
def test_fear_that_is_the_cost_itself_makes_f4sg_mappo_l(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fear, "appraise_fear", lambda *given: (given[3], given[4].cost, {}))
    made = program.__wrapped__("f4sg")
    state = made.init(made.setup.hyper, jax.random.key(0))
    for _ in range(3):
        state, _ = made.step(made.setup.hyper, state)
    chex.assert_trees_all_equal(weights(state), weights(trained("mappo_l")[0]))


@pytest.mark.full
def test_regret_weighs_a_trust_region_too(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(METHODS, "macpo_regret", dataclasses.replace(METHODS["macpo"], ratio_weight="regret"))

    def updated(method: str, **hyper: float):
        made = program(method)
        numbers = made.hyper(**hyper)
        return weights(made.step(numbers, made.init(numbers, jax.random.key(0)))[0])["actor"]

    without, plain = updated("macpo_regret", kappa=0.0), updated("macpo")
    chex.assert_trees_all_close(without, plain, rtol=1e-2, atol=2e-4)
    assert differ(updated("macpo_regret"), plain)


@pytest.mark.full
def test_regret_stands_still_where_nothing_ever_costs():
    setup, state, batch = acted()
    now = schedules.at(setup.config, setup.hyper, jnp.int32(0))
    harmless = dataclasses.replace(batch, cost=jnp.zeros_like(batch.cost))
    appraise = jax.jit(lambda batch: regret.appraise_regret(setup, setup.hyper, now, state.regret, batch, state.key))
    net, log_weight, _ = appraise(harmless)
    chex.assert_trees_all_equal(net, state.regret)
    assert not log_weight.any()
    net, log_weight, _ = appraise(batch)
    assert log_weight.any()


@pytest.mark.full
def test_each_agent_is_corrected_by_the_ratios_of_those_before_it():
    setup, state, batch = acted()
    hyper = setup.hyper
    tagged = {tag: jax.random.fold_in(jax.random.key(1), tag) for tag in Tag}
    noise = jax.random.normal(jax.random.key(2), (*batch.reward.shape, 2, 1))
    now = schedules.at(setup.config, hyper, state.update)
    rows = policies.policy_samples(
        setup, state.constraint.multiplier, batch, noise[..., 0, 0], noise, jnp.zeros_like(batch.log_prob)
    )
    excess = jnp.asarray([[0.5], [0.25]])
    team = policies.Team(state.actor, state.constraint, rows, excess)
    actor, constraint, _ = policies.update_policies(setup, hyper, now, team, tagged)

    factor = jnp.ones_like(rows.factor[0])
    total = jnp.zeros_like(factor)
    update = jax.jit(lambda *each: policies.update_policy(setup, hyper, now, *each))
    for i in np.asarray(jax.random.permutation(tagged[Tag.ORDER], 2)):
        mine = dataclasses.replace(policies.select_agent(rows, i), factor=factor)
        before, key = policies.select_agent(state.actor, i), jax.random.fold_in(tagged[Tag.ACTOR], i)
        net, _, _ = update(before, mine, excess[i], key)
        chex.assert_trees_all_close(net.params, policies.select_agent(actor.params, i), rtol=1e-5, atol=1e-6)
        log_ratio, _ = policies.policy_change(setup, net.params, mine)
        expected = 2.0 * (1 + hyper.lambda_lr * excess[i, 0] / setup.config.num_updates)
        np.testing.assert_allclose(constraint.multiplier[i, 0], expected, rtol=1e-5)
        factor, total = factor * jnp.exp(log_ratio), total + log_ratio
    np.testing.assert_allclose(factor, jnp.exp(total), rtol=1e-5)
    assert jnp.abs(factor - 1).max() > 1e-3
