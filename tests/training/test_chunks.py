"""Chunks end soon, whatever a row is, and no number depends on where they end."""

from __future__ import annotations

import pathlib
import signal

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pmt_jax import load_config
from pmt_jax.training import chunks
from runs import ARGUMENTS, STEPS, TINY, assert_same_run, rows

LONG = ("lane", *TINY, "--method", "mappo", "--seeds", 2, "--no-cache")
LONG += ("--log-interval", 10**6, "--steps", 1400)  # one row, of 14 updates
relaxed = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


@relaxed
@given(
    interval=st.integers(1, 10**7),
    updates=st.integers(1, 300),
    speeds=st.lists(st.floats(0, 1e4), min_size=1, max_size=9),
)
def test_a_plan_covers_every_update_once_and_ends_soon(interval: int, updates: int, speeds: list[float]):
    config = load_config("lane", num_envs=2, rollout_length=5, minibatches=1, steps=10 * updates, log_interval=interval)
    assert config.num_updates == updates
    done, seconds, ends = 0, None, []
    while done < updates:
        n, end = chunks.plan(config, done, seconds), chunks.row_end(config, done)
        assert 1 <= n <= min(end - done, chunks.most(config))
        assert n == 1 if seconds is None else n == 1 or n * seconds <= chunks.SECONDS
        done, seconds = done + n, speeds[done % len(speeds)]
        ends += [done] if done == end else []
    assert ends == [*range(interval, updates, interval), updates]


def test_steps_are_not_multiplied_by_the_interval():
    for interval in (1, 3, 7, 10**6):
        sizes = {"num_envs": 8, "rollout_length": 25, "minibatches": 1, "log_interval": interval}
        assert load_config("lane", steps=2000, **sizes).num_updates == 10
        assert load_config("lane", steps=2001, **sizes).num_updates == 11


@relaxed
@given(cuts=st.lists(st.integers(1, 5), min_size=1, max_size=6), room=st.integers(0, 3))
def test_a_row_is_the_same_however_it_is_cut(cuts: list[int], room: int):
    loss = np.random.default_rng(0).normal(size=(2, sum(cuts))).astype(np.float32)
    row, done = chunks.OpenRow(), 0
    for n in cuts:
        padded = np.concatenate([loss[:, done : done + n], np.zeros((2, room), np.float32)], axis=1)
        done += n
        row = row.then(n, {"loss": padded, "finite": np.array([True, done < sum(cuts)])})
        assert chunks.OpenRow.of(row.metrics).updates == row.updates == done
    np.testing.assert_array_equal(row.metrics["loss"], loss)
    assert row.metrics["finite"].tolist() == [True, False]


@pytest.mark.parametrize("length", [1, pytest.param(2, marks=pytest.mark.full)])
def test_rows_and_states_do_not_depend_on_the_chunks(
    length: int, whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch
):
    """`whole` had one update first, as nothing was known of its speed, and then what was left of each row."""
    monkeypatch.setattr(chunks, "plan", lambda config, done, _: min(length, chunks.row_end(config, done) - done))
    assert cli("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "run")[0] == 0
    assert_same_run(tmp_path / "run", whole)


@pytest.mark.full
def test_a_run_that_is_stopped_within_a_row_goes_on_with_the_row(tmp_path: pathlib.Path, cli, monkeypatch):
    """Of a row as long as the run, in chunks of 5 updates and, stopped after the second and fourth, of 3."""
    monkeypatch.setattr(chunks, "plan", lambda config, done, _: min(5, 14 - done))
    assert cli("train", *LONG, "--out", tmp_path / "whole")[0] == 0
    assert [row["step"] for row in rows(tmp_path / "whole")] == [1400, 1400]

    def plan(config: object, done: int, _: object) -> int:
        if done in (3, 9):
            signal.raise_signal(signal.SIGTERM)
        return min(3, 14 - done)

    monkeypatch.setattr(chunks, "plan", plan)
    command = ("train", *LONG, "--out", tmp_path / "run")
    code, text, _ = cli(*command)
    assert code == 128 + signal.SIGTERM and "interrupted after 600 steps; saved" in text
    assert rows(tmp_path / "run") == []
    code, text, _ = cli(*command, "--resume")
    assert code == 128 + signal.SIGTERM and "resuming after 600 steps" in text and "lost" not in text
    code, text, _ = cli(*command, "--resume")
    assert code == 0 and "resuming after 1,200 steps" in text
    assert_same_run(tmp_path / "run", tmp_path / "whole")
    assert cli("eval", tmp_path / "run", "--episodes", 2)[0] == 0
