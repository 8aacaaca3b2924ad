"""Costs that are seldom observed: `cost_seen`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.vector import observed_cost
from pmt_jax import load_config, make_setup
from pmt_jax.errors import UsageError
from small import program

B, N, K = 40_000, 2, 1


def test_a_cost_that_is_always_observed_is_itself_bit_for_bit():
    cost = jax.random.uniform(jax.random.key(0), (B, N, K)) * (jnp.arange(B) % 3 == 0)[:, None, None]
    np.testing.assert_array_equal(observed_cost(cost, jax.random.key(1), 1.0), cost)


def test_the_share_of_observed_harm():
    costly = jnp.arange(B) % 2 == 0
    cost = jnp.broadcast_to(costly[:, None, None] * 1.0, (B, N, K))
    observed = np.asarray(observed_cost(cost, jax.random.key(2), 0.2))
    assert (observed[:, 0] == observed[:, 1]).all()  # one draw for the team
    spread = 4 * (0.25 / (B / 2)) ** 0.5
    assert observed[np.asarray(costly)].mean() == pytest.approx(0.2, abs=spread)
    assert (observed[~np.asarray(costly)] == 0).all()


def test_the_tasks_limit_follows_what_is_observed():
    small = {"num_envs": 4, "rollout_length": 16, "minibatches": 1}
    assert make_setup(load_config("lane", cost_seen=0.1, **small)).limits.total == pytest.approx(0.1)
    assert make_setup(load_config("lane", cost_seen=0.1, cost_limit=0.7, **small)).limits.total == pytest.approx(0.7)


@pytest.mark.parametrize("change", [{"cost_seen": 0}, {"cost_seen": 1.5}])
def test_shares_that_are_none(change: dict[str, float]):
    with pytest.raises(UsageError, match=next(iter(change))):
        load_config("lane", **change)


@pytest.mark.full
def test_the_learner_sees_what_is_observed_and_reports_what_was_true():
    made = program("f4sg")
    start = made.init(made.setup.hyper, jax.random.key(0))
    seen = np.asarray([1.0, 0.5, 0.25])
    each = [made.step(made.hyper(cost_seen=p), start)[1] for p in seen]
    metrics = {name: np.asarray([row[name] for row in each]) for name in each[0]}
    # The same seed acts alike before it has learned: what is true agrees, what is observed is its share.
    np.testing.assert_array_equal(metrics["true_step_cost"], metrics["true_step_cost"][0])
    assert metrics["step_cost"][0] == metrics["true_step_cost"][0] > 0.05
    assert metrics["episode_cost"][0] == metrics["true_episode_cost"][0]
    assert metrics["violation_rate"][0] == metrics["true_violation_rate"][0]
    share = metrics["step_cost"] / metrics["true_step_cost"]
    costly = made.setup.config.batch_size * metrics["true_step_cost"][0]  # of which each is observed or not
    np.testing.assert_allclose(share, seen, atol=4 * 0.5 / costly**0.5)
