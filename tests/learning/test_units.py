"""What the learner computes depends on neither the unit of costs nor how often they are noticed."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.toys import Switch
from envs.vector import observed_cost
from pmt_jax import METHODS, load_config, make_setup
from pmt_jax.config.load import to_toml
from pmt_jax.errors import UsageError
from pmt_jax.files import read_rows
from pmt_jax.learning import constraint, learner
from pmt_jax.learning.types import LearnerState
from pmt_jax.training.metrics import judged_cost
from small import SMALL, program


class Scaled(Switch):
    """`switch` whose costs are divided, by a power of two, so that 32 bits hold the same digits."""

    def __init__(self, divisor: jax.Array):
        super().__init__()
        self.divisor = divisor

    def _state(self, *seen, **signals):
        state = super()._state(*seen, **signals)
        return dataclasses.replace(state, cost=state.cost / self.divisor)


def trainer(method: str) -> Callable[[float], tuple[LearnerState, dict[str, jax.Array]]]:
    """Three updates where costs and the limit are divided by a number, which compiles nothing anew."""
    config = load_config("switch", method=method, **SMALL)

    @jax.jit
    def train(divisor: jax.Array) -> tuple[LearnerState, dict[str, jax.Array]]:
        setup = make_setup(config, Scaled(divisor))
        hyper = dataclasses.replace(setup.hyper, cost_limit=setup.hyper.cost_limit / divisor)
        return learner.train_chunk(setup, hyper, learner.init(setup, hyper, jax.random.key(0)), 3)

    return train


FULL = ("mixed", "macpo", "crpo", "ippo_l")  # every way to hold a limit, fear, regret, critics of observations


@pytest.mark.parametrize(
    "method",
    [  # but by the letter, whose equations have the unit of costs
        pytest.param(name, marks=pytest.mark.full if name in FULL else pytest.mark.slow)
        for name, row in METHODS.items()
        if not row.letter
    ],
)
def test_costs_and_a_limit_of_an_eighth_change_nothing(method: str):
    """Every method learns the same weights, and moves the same multipliers, bit for bit."""
    (state, metrics), (cheap, others) = map(trainer(method), (1.0, 8.0))
    assert metrics["step_cost"][0] > 0
    np.testing.assert_array_equal(others["step_cost"], metrics["step_cost"] / 8)
    for name in ("actor", "critic", "cost_critic", "fear", "regret", "constraint"):
        chex.assert_trees_all_equal(getattr(cheap, name), getattr(state, name))
    np.testing.assert_array_equal(others["lambda"], metrics["lambda"])
    np.testing.assert_array_equal(others["cost_excess"], metrics["cost_excess"])


def test_units_of_a_limit():
    """A cost in every step is as many limits as the limit is steps; a margin makes the limit smaller."""
    made = program("mappo_l")
    cost = jnp.asarray([0.0, 0.5, 1.0])
    for limit, margin, scale in (5.0, 0.0, 5.0), (5.0, 0.5, 10.0), (0.5, 0.0, 50.0), (0.0, 0.0, 25.0):
        hyper = made.hyper(cost_limit=limit, cost_margin=margin)
        np.testing.assert_allclose(constraint.in_unit(made.setup, hyper, cost), scale * cost, rtol=1e-6)


@pytest.mark.parametrize(("cost", "share"), [(0, -1), (1.5, -0.25), (2, 0), (3, 0.5), (4, 1), (90, 44)])
def test_an_excess_is_a_share_of_the_limit(cost: float, share: float):
    made = program("mappo_l")
    for scale in 1.0, 0.125:
        hyper = made.hyper(cost_limit=2 * scale)
        estimate = constraint.in_unit(made.setup, hyper, jnp.asarray(cost * scale / 25))
        np.testing.assert_allclose(constraint.cost_excess(made.setup, hyper, estimate), share, rtol=1e-5, atol=1e-6)
    assert constraint.cut(jnp.asarray([-3.0, -0.25, 0.5, 44.0])).tolist() == [-1, -0.25, 0.5, 1]


def test_nothing_is_below_a_limit_of_0():
    made = program("mappo_l")
    hyper = made.hyper(cost_limit=0.0)
    assert constraint.cost_excess(made.setup, hyper, jnp.asarray([0.0, 0.5])).tolist() == [0, 0.5]
    assert constraint.init(made.setup, hyper).estimate.tolist() == [[0], [0]]


# ---------------------------------------------------------------------------------------------------------------------
# Costs that are seldom observed: `cost_seen`


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


# ---------------------------------------------------------------------------------------------------------------------
# Several costs an agent: each is held to its own limit, reported by itself, and all count for `best`


TASK = """
import dataclasses
import jax.numpy as jnp
from envs.toys import Switch

class Two(Switch):
    '''`switch` with a second cost: a first action below -0.3.'''

    def __init__(self):
        super().__init__()
        self.spec = dataclasses.replace(self.spec, name="two", num_costs=2, cost_limit=(1.0, 0.5))

    def _state(self, carry, last_action, reward, cost):
        state = super()._state(carry, last_action, reward, cost)
        low = jnp.broadcast_to(last_action[0, 0] < -0.3, (2, 1)).astype(state.cost.dtype)
        return dataclasses.replace(state, cost=jnp.concatenate([state.cost, low], axis=1))
"""
SIZES = {"num_envs": 4, "rollout_length": 25, "minibatches": 1, "epochs": 1, "hidden": (8,)}


@pytest.fixture
def task(tmp_path: pathlib.Path) -> str:
    file = tmp_path / "two.py"
    file.write_text(TASK)
    return str(file)


def test_limits_are_the_tasks_or_one_for_all_or_a_list(task: str):
    def limits(**changes: object) -> list[float]:
        return list(make_setup(load_config(task, **SIZES, **changes)).limits.each)

    assert limits() == [1.0, 0.5]
    assert limits(cost_limit=2) == [2.0, 2.0]
    assert limits(cost_limit="3,0.25") == limits(cost_limit=[3, 0.25]) == [3.0, 0.25]
    assert limits(cost_seen=0.5) == [0.5, 0.25]


def test_a_list_of_limits_survives_the_run_folder(task: str, tmp_path: pathlib.Path):
    config = load_config(task, cost_limit=[3, 0.25], **SIZES)
    (tmp_path / "config.toml").write_text(to_toml(config))
    assert load_config(tmp_path / "config.toml") == config


def test_another_number_of_limits_than_costs_is_refused(task: str):
    with pytest.raises(UsageError, match=r"cost_limit has 3 numbers, but task 'two' has 2 cost\(s\)"):
        make_setup(load_config(task, cost_limit="1,2,3", **SIZES))
    with pytest.raises(UsageError, match="cost_limit must be a cost per episode"):
        load_config(task, cost_limit="1,-2", **SIZES)


def test_a_policy_is_judged_by_the_cost_that_is_furthest_beyond_its_limit():
    row = {"episode_cost": 3.0, "episode_cost/0": 1.0, "episode_cost/1": 2.0, "cost_limit": 5.0}
    assert judged_cost(row, "") == (3.0, 5.0)
    assert judged_cost(row | {"cost_limit/0": 4.0, "cost_limit/1": 1.0}, "") == (1.0, 0.0)  # within the sum, not within
    assert judged_cost(row | {"cost_limit/0": 4.0, "cost_limit/1": 3.0}, "") == (-1.0, 0.0)


@pytest.mark.full
def test_rows_and_evaluations_name_each_cost(task: str, tmp_path: pathlib.Path, cli):
    out = tmp_path / "run"
    words = ["--num-envs", 4, "--rollout-length", 25, "--minibatches", 1, "--epochs", 1, "--hidden", 8, "--steps", 200]
    code, _, err = cli("train", task, *words, "--eval-interval", 2, "--eval-episodes", 2, "--out", out)
    assert code == 0, err
    rows = read_rows(out / "metrics.jsonl")
    for row in rows:
        assert (row["cost_limit"], row["cost_limit/0"], row["cost_limit/1"]) == (1.5, 1.0, 0.5)
        np.testing.assert_allclose(row["episode_cost"], row["episode_cost/0"] + row["episode_cost/1"], rtol=1e-6)
    last = rows[-1]
    np.testing.assert_allclose(
        last["eval/episode_cost"], last["eval/episode_cost/0"] + last["eval/episode_cost/1"], rtol=1e-6
    )
    assert "(cost limit 1 + 0.5 an episode)" in cli("eval", out, "--episodes", 2, "--deterministic", "--trust")[1]
