"""Robust figures over few runs: numbers worked by hand, and laws."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from pmt_jax.studies import statistics

scores = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=8)


def test_interquartile_mean_by_hand():
    assert statistics.iqm([5.0]) == 5
    assert statistics.iqm([1, 2, 6]) == 3  # fewer than four: the mean
    assert statistics.iqm([1000, 1, 3, 2, -500]) == 2  # five: one off each end
    assert statistics.iqm([[0, 1, 2, 3], [4, 5, 6, 100]]) == (2 + 3 + 4 + 5) / 4  # two tasks together


@given(scores)
def test_interquartile_mean_is_scipys_trimmed_mean(x: list[float]):
    np.testing.assert_allclose(statistics.iqm(x), scipy.stats.trim_mean(x, 0.25), atol=1e-9)


def test_probability_of_improvement_by_hand():
    better = statistics.probability_of_improvement
    assert better([[2, 3]], [[1, 2]]) == (1 + 0.5 + 1 + 1) / 4
    assert better([[2, 3], [0, 0, 0]], [[1, 2], [1]]) == (0.875 + 0) / 2  # tasks weigh the same, runs may differ
    with pytest.raises(ValueError):
        better([[1, 2]], [[1], [2]])


@given(scores, scores)
def test_probability_of_improvement_is_mann_whitneys(x: list[float], y: list[float]):
    p = statistics.probability_of_improvement([x], [y])
    np.testing.assert_allclose(p, scipy.stats.mannwhitneyu(x, y, method="asymptotic").statistic / len(x) / len(y))
    np.testing.assert_allclose(p + statistics.probability_of_improvement([y], [x]), 1)


def test_bootstrap_of_two_scores_by_hand():
    """A resample of {0, 1} has the mean 0, 1/2, 1 with probability 1/4, 1/2, 1/4."""
    assert statistics.bootstrap_interval([[0, 1]]) == (0, 1)
    assert statistics.bootstrap_interval([[0, 1]], level=0.4) == (0.5, 0.5)
    # Two tasks of one run each: a stratified resample is always the scores themselves.
    assert statistics.bootstrap_interval([[0], [1]]) == (0.5, 0.5)


@settings(max_examples=25, deadline=None)
@given(st.lists(scores, min_size=1, max_size=3), st.floats(-100, 100))
def test_bootstrap_laws(strata: list[list[float]], shift: float):
    low, high = statistics.bootstrap_interval(strata, resamples=200)
    everything = np.concatenate(strata)
    assert everything.min() - 1e-9 <= low <= high <= everything.max() + 1e-9
    moved = statistics.bootstrap_interval([np.add(x, shift) for x in strata], resamples=200)
    np.testing.assert_allclose(moved, (low + shift, high + shift), atol=1e-8)
    assert statistics.bootstrap_interval(strata, resamples=200) == (low, high)
    p = statistics.improvement_interval(strata, strata, resamples=200)
    assert 0 <= p[0] <= p[1] <= 1


def test_bootstrap_covers_the_mean_about_as_often_as_it_says():
    rng = np.random.default_rng(1)
    hits = [low <= 0 <= high for low, high in (_normal_interval(rng) for _ in range(200))]
    assert 0.85 < np.mean(hits) < 0.99  # 0.95 in the limit of many runs; 20 here


def _normal_interval(rng: np.random.Generator) -> tuple[float, float]:
    return statistics.bootstrap_interval([rng.normal(size=20)], np.mean, resamples=500)


def test_improvement_is_certain_where_every_run_is_better():
    assert statistics.improvement_interval([[3, 4, 5]], [[0, 1, 2]]) == (1, 1)


def test_needs_no_jax():
    code = "import pmt_jax.studies.statistics, sys; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
