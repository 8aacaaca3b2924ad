"""Two runs side by side: the numbers are those of textbooks, and what cannot be compared is refused in a sentence."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest
import scipy.stats

from by_hand import made, row, written
from pmt_jax.studies import statistics

OURS, THEIRS = [18.0, 17.5, 18.2, 17.9], [17.0, 17.5, 16.2]


@pytest.fixture
def runs(tmp_path: pathlib.Path) -> pathlib.Path:
    made(tmp_path / "f4sg", "lane", "f4sg", {i: [x, 0.5] for i, x in enumerate(OURS)})
    made(tmp_path / "mappo_l", "lane", "mappo_l", {i: [x, 0.8 + i] for i, x in enumerate(THEIRS)})
    made(tmp_path / "parts" / "a", "lane", "mappo_l", {0: [THEIRS[0], 0.8]})
    made(tmp_path / "parts" / "b", "lane", "mappo_l", {1: [THEIRS[1], 1.8], 2: [THEIRS[2], 2.8]}, seed=1)
    made(tmp_path / "kinds" / "a", "lane", "f4sg", {0: [1, 0]})
    made(tmp_path / "kinds" / "b", "lane", "happo", {0: [1, 0]})
    made(tmp_path / "noisy", "noisy", "f4sg", {0: [1, 0]})
    return tmp_path


def test_the_figures_are_those_of_the_statistics(runs: pathlib.Path, cli):
    code, out, _ = cli("compare", runs / "f4sg", runs / "mappo_l", "-o", runs / "curves.svg")
    assert code == 0 and (runs / "curves.svg").stat().st_size > 1000
    head, _, reward, cost, within, *_ = out.splitlines()
    assert "f4sg (4 seeds)" in head and "mappo_l (3 seeds)" in head
    low, high = scipy.stats.ttest_ind(OURS, THEIRS, equal_var=False).confidence_interval()
    assert f"{np.mean(OURS) - np.mean(THEIRS):.4g} [{low:.4g}, {high:.4g}]" in reward
    assert f"{11.5 / 12:.4g} [" in reward and "1 [" in cost and cost.startswith("cost (limit 1)")
    assert "4 of 4" in within and "1 of 3" in within


def test_seeds_may_lie_in_several_folders(runs: pathlib.Path, cli):
    whole, parts = (cli("compare", runs / "f4sg", runs / name)[1] for name in ("mappo_l", "parts"))
    assert whole == parts


def test_seeds_that_broke_have_no_score_and_keep_no_limit(runs: pathlib.Path, cli):
    written(runs / "broken", [row(10, 0, 1.0, episode_cost=0.5), row(10, 1, None, episode_cost=None, broken="nan")])
    out = cli("compare", runs / "f4sg", runs / "broken")[1].splitlines()
    assert out[2].split()[-1] == "-" and "1 of 2" in out[4]


@pytest.mark.parametrize(
    ("second", "said"),
    [
        ("noisy", "f4sg is a run of lane and {runs}/noisy of noisy; compare runs of one task"),
        ("f4sg", "are the same run; name two"),
        ("kinds", "holds 2 kinds of runs (happo on lane, f4sg on lane); name one"),
        ("nowhere", "there is no such folder"),
    ],
)
def test_what_cannot_be_compared(second: str, said: str, runs: pathlib.Path, cli):
    code, out, err = cli("compare", runs / "f4sg", runs / second)
    assert code == 2 and said.format(runs=runs) in err and err.count("\n") == 1 and not out


def test_intervals_of_differences():
    assert statistics.difference_interval([1, 1], [0, 0]) == (1, 1)
    assert np.isnan(statistics.difference_interval([1], [0, 1])).all()
    low, high = statistics.share_difference_interval(56, 70, 48, 80)  # the example of Newcombe (1998)
    assert (round(low, 4), round(high, 4)) == (0.0524, 0.3339)
