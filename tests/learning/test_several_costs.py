"""Several costs an agent: each is held to its own limit, reported by itself, and all count for `best`."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest

from pmt_jax import load_config, make_setup
from pmt_jax.config.load import to_toml
from pmt_jax.errors import UsageError
from pmt_jax.files import read_rows
from pmt_jax.training.metrics import judged_cost

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
SMALL = {"num_envs": 4, "rollout_length": 25, "minibatches": 1, "epochs": 1, "hidden": (8,)}


@pytest.fixture
def task(tmp_path: pathlib.Path) -> str:
    file = tmp_path / "two.py"
    file.write_text(TASK)
    return str(file)


def test_limits_are_the_tasks_or_one_for_all_or_a_list(task: str):
    def limits(**changes: object) -> list[float]:
        return list(make_setup(load_config(task, **SMALL, **changes)).limits.each)

    assert limits() == [1.0, 0.5]
    assert limits(cost_limit=2) == [2.0, 2.0]
    assert limits(cost_limit="3,0.25") == limits(cost_limit=[3, 0.25]) == [3.0, 0.25]
    assert limits(cost_seen=0.5) == [0.5, 0.25]


def test_a_list_of_limits_survives_the_run_folder(task: str, tmp_path: pathlib.Path):
    config = load_config(task, cost_limit=[3, 0.25], **SMALL)
    (tmp_path / "config.toml").write_text(to_toml(config))
    assert load_config(tmp_path / "config.toml") == config


def test_another_number_of_limits_than_costs_is_refused(task: str):
    with pytest.raises(UsageError, match=r"cost_limit has 3 numbers, but task 'two' has 2 cost\(s\)"):
        make_setup(load_config(task, cost_limit="1,2,3", **SMALL))
    with pytest.raises(UsageError, match="cost_limit must be a cost per episode"):
        load_config(task, cost_limit="1,-2", **SMALL)


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
