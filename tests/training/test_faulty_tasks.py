"""Steps that break the contract of tasks: counted, reported, and costs outside [0, 1] stop the run."""

from __future__ import annotations

import math
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import faulty
from envs.vector import ROUNDING, VectorEnv, out_of_range
from pmt_jax import tasks
from pmt_jax.learning.evaluation import play
from pmt_jax.training import health
from runs import TINY, rows

RUN = (*TINY, "--method", "mappo", "--steps", 400, "--seeds", 2, "--no-cache", "--episode-starts", "together")


def each_fault(*default: str):
    """A test of every fault, of some by default."""
    faults = [x if x in default else pytest.param(x, marks=pytest.mark.full) for x in faulty.FAULTS]
    return pytest.mark.parametrize("fault", faults)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.floats(-2, 3, width=32), min_size=1, max_size=6))
def test_rounding_is_no_fault(costs: list[float]):
    found = np.asarray(out_of_range(jnp.asarray(costs, jnp.float32)))
    assert found.tolist() == [not -ROUNDING <= np.float32(x) <= np.float32(1 + ROUNDING) for x in costs]
    assert not out_of_range(jnp.float32([0, 1, 1 + 1e-7, -1e-7])).any()


@each_fault("lcostbig", "lnan", "linfonan")
def test_what_one_step_of_each_kind_does(fault: str, tmp_path: pathlib.Path):
    """Only what is not finite outside of `info` ends the episode and costs; a cost out of range stays as it is."""
    vector = VectorEnv(tasks.make(str(faulty.write(tmp_path, fault))), 3)
    step = jax.jit(vector.step)
    state = vector.reset(jax.random.key(0))
    for t in range(1, 16):
        state, outcome = step(state, jnp.zeros((3, 2, 2)))
        faulty_now, not_finite = t == 15, t == 15 and fault in faulty.NOT_FINITE
        assert (np.asarray(outcome.non_finite) == not_finite).all()
        assert (np.asarray(outcome.terminated) == not_finite).all()
        assert (np.asarray(outcome.cost_out_of_range) == (faulty_now and fault in faulty.OUT_OF_RANGE)).all()
    cost = 1.0 if fault in faulty.NOT_FINITE else faulty.OUT_OF_RANGE.get(fault, 0.0)
    assert (np.asarray(outcome.cost) == cost).all()
    assert np.isfinite(outcome.reward).all() and np.isfinite(outcome.next_obs).all()


@each_fault("lnan")
def test_an_evaluation_counts_them(fault: str, tmp_path: pathlib.Path):
    found = play(tasks.make(str(faulty.write(tmp_path, fault))), lambda env, t: jnp.zeros((2, 2, 2)), 2)
    assert found["non_finite"].tolist() == [float(fault in faulty.NOT_FINITE)] * 2
    assert found["cost_out_of_range"].tolist() == [float(fault in faulty.OUT_OF_RANGE)] * 2
    assert found["episode_length"].tolist() == [15 if fault in faulty.NOT_FINITE else 25] * 2
    assert np.isnan(found["info/position"]).all() == (fault == "linfonan")


@pytest.mark.parametrize(
    "fault",
    [pytest.param(x, marks=pytest.mark.full if x == "lcostbig" else pytest.mark.slow) for x in faulty.OUT_OF_RANGE],
)
def test_costs_out_of_range_stop_the_run(fault: str, tmp_path: pathlib.Path, cli):
    file, out, worst = faulty.write(tmp_path, fault), tmp_path / "run", faulty.OUT_OF_RANGE[fault]
    code, text, err = cli("train", file, *RUN, "--log-interval", 1, "--out", out)
    assert code == 1 and not err
    assert (
        "stopped: 4 of the 100 environment steps of seed 1 up to step 100 had a cost outside [0, 1], the worst "
        f"{worst:g}; scale or clip the costs of task 'lane'" in text
    )
    assert "note: 8 of 200 steps had a cost outside [0, 1]" in text
    assert [(row["cost_out_of_range"], row["worst_cost"]) for row in rows(out)] == [(4, worst)] * 2
    assert all("cost outside [0, 1]" in row["broken"] for row in rows(out))


@pytest.mark.full
def test_a_long_row_does_not_hide_a_run_that_is_lost(tmp_path: pathlib.Path, cli):
    """No update of the rest of the row could matter."""
    file, out = faulty.write(tmp_path, "lcostbig"), tmp_path / "run"
    code, text, _ = cli("train", file, *RUN, "--steps", 10**9, "--log-interval", 10**6, "--out", out)
    assert code == 1 and "of seed 0 up to step 100 had a cost outside [0, 1], the worst 50" in text


@pytest.mark.parametrize(
    "fault", [pytest.param(x, marks=pytest.mark.full if x == "lnan" else pytest.mark.slow) for x in faulty.NOT_FINITE]
)
def test_steps_that_are_not_finite_are_reported_everywhere(fault: str, tmp_path: pathlib.Path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file, out = faulty.write(tmp_path, fault), tmp_path / "run"
    code, text, _ = cli("train", file, *RUN, "--eval-interval", 4, "--eval-episodes", 3, "--out", out)
    count = sum(row["non_finite"] for row in rows(out))
    what = "were not finite: reward 0, cost 1, end of the episode"
    assert code == 0 and count > 0
    said = f"{count} of 800 steps {what}; 6 of 90 steps in evaluations {what}. Check the task's observations"
    assert f"note: {said}" in text
    assert [row["eval/non_finite"] for row in rows(out)[-2:]] == [1.0, 1.0]
    code, text, _ = cli("table", out)
    assert code == 0 and f"mappo on lane: {said}" in text
    code, text, _ = cli("eval", out, "--episodes", 2)
    assert code == 0 and text.count(f"note: 2 of 30 steps {what}") == 2 and "non_finite" not in text
    code, text, _ = cli("report", out, "--episodes", 2, "-o", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert code == 0 and f"{count} of 800 steps {what}" in page and f"2 of 30 steps {what}" in page
    code, text, _ = cli("train", file, *RUN, "--eval-interval", 4, "--eval-episodes", 3, "--out", out, "--resume")
    assert code == 0 and f"note: {said}" in text  # the rows of both sessions count


@pytest.mark.full
def test_what_is_only_logged_changes_nothing_else(tmp_path: pathlib.Path, cli):
    out = tmp_path / "run"
    code, text, _ = cli("train", faulty.write(tmp_path, "linfonan"), *RUN, "--out", out)
    assert code == 0 and "note:" not in text
    for row in rows(out):
        assert (row["non_finite"], row["terminations"], row["episode_length"]) == (0, 0, 25)
        assert row["info/position"] is None


def test_a_task_that_keeps_the_contract_is_not_accused(whole: pathlib.Path, cli):
    assert all(row["non_finite"] == row["cost_out_of_range"] == 0 and row["worst_cost"] is None for row in rows(whole))
    assert "steps were not finite" not in cli("table", whole)[1] and "note:" not in cli("eval", whole)[1]


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.integers(0, 9), min_size=1, max_size=4), st.lists(st.integers(0, 9), min_size=1, max_size=4))
def test_counts_are_sums_and_unknown_values_count_nothing(broke: list[int], evaluated: list[int]):
    metrics = {
        "non_finite": [*broke, math.nan],
        "eval/cost_out_of_range": [*evaluated, None],
        "eval/episode_length": [5],
    }
    found = health.count_faults(metrics, 2)
    assert found["non_finite"] == sum(broke) and found["eval/cost_out_of_range"] == 2 * sum(evaluated)
    sentence = health.faults(found, 100)
    assert (f"{sum(broke)} of 100 steps were not finite" in sentence) == (sum(broke) > 0)
    assert (f"{2 * sum(evaluated)} of 10 steps in evaluations had a cost" in sentence) == (sum(evaluated) > 0)


def test_an_evaluation_with_costs_out_of_range_stops_the_seed():
    class Setup:
        trials = None

    row = {"seed": 3, "step": 100, "task": "lane", "eval/cost_out_of_range": 2.5}
    said = health.diagnose_evaluation(Setup(), row)  # pyright: ignore[reportArgumentType]
    assert said and said.startswith(
        "2.5 steps an episode in the evaluation of seed 3 at step 100 had a cost outside [0"
    )
    for unknown in (0.0, math.nan):
        assert health.diagnose_evaluation(Setup(), row | {"eval/cost_out_of_range": unknown}) is None  # pyright: ignore[reportArgumentType]
