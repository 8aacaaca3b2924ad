"""Figures over few runs that one lucky seed cannot carry (Agarwal et al., 2021, arXiv 2108.13264), in plain NumPy.

Scores come as strata: one sequence of runs per task, each run one number. A resample draws runs with replacement
within every task, so that no task drops out of a resample.

Example:
  >>> float(iqm([1.0, 2.0, 3.0, 100.0]))
  2.5
  >>> probability_of_improvement([[2.0, 3.0]], [[1.0, 2.0]])
  0.875
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

RESAMPLES = 10_000
LEVEL = 0.95

Strata = Sequence[ArrayLike]  # one [runs] per task; tasks may have different numbers of runs
Statistic = Callable[..., NDArray[np.float64]]  # (scores [..., n], axis=-1) -> [...]; np.mean is one


def iqm(scores: ArrayLike, axis: int | None = None) -> Any:
    """Interquartile mean, in the scores' unit: robust as the median, efficient as the mean.

    The lowest and the highest quarter of the scores (rounded down: none of three, one of five) are cut off.

    Args:
      scores: [...]; axis: along which, or None for all scores together.

    Returns:
      [...] without `axis`; a scalar for None.
    """
    ordered = np.sort(np.asarray(scores, float), axis)
    ordered = ordered if axis is None else np.moveaxis(ordered, axis, -1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(-1)


def bootstrap_interval(
    strata: Strata, statistic: Statistic = iqm, level: float = LEVEL, resamples: int = RESAMPLES, seed: int = 0
) -> tuple[float, float]:
    """The stratified bootstrap's percentile interval of `statistic` over all scores together.

    Args:
      strata: scores [runs] of every task, in one unit (normalise them first if tasks differ in theirs).
      statistic: (scores [resamples, n], axis=-1) -> [resamples].
      level: the share of resamples that the interval covers.
      seed: the same scores give the same interval.

    Returns:
      (low, high), in the scores' unit; both the score itself where there is but one.
    """
    rng = np.random.default_rng(seed)
    drawn = np.concatenate([_resample(rng, scores, resamples) for scores in strata], axis=-1)
    return _percentiles(statistic(drawn, axis=-1), level)


def probability_of_improvement(ours: Strata, theirs: Strata) -> float:
    """How likely a run of ours scores higher than a run of theirs on a task drawn at random; ties count half.

    The mean over tasks of U / (runs of ours * runs of theirs), with Mann and Whitney's U.

    Args:
      ours, theirs: scores [runs] of the same tasks in the same order; their units may differ from task to task.
    """
    pairs = zip(ours, theirs, strict=True)
    return float(np.mean([_share_of_wins(np.asarray(x, float), np.asarray(y, float)) for x, y in pairs]))


def improvement_interval(
    ours: Strata, theirs: Strata, level: float = LEVEL, resamples: int = RESAMPLES, seed: int = 0
) -> tuple[float, float]:
    """The stratified bootstrap's percentile interval of `probability_of_improvement`; both sides are resampled."""
    rng = np.random.default_rng(seed)
    pairs = zip(ours, theirs, strict=True)
    wins = [_share_of_wins(_resample(rng, x, resamples), _resample(rng, y, resamples)) for x, y in pairs]
    return _percentiles(np.mean(wins, axis=0), level)


def _resample(rng: np.random.Generator, scores: ArrayLike, resamples: int) -> NDArray[np.float64]:
    """[resamples, runs] drawn with replacement from scores [runs]."""
    scores = np.asarray(scores, float)
    return rng.choice(scores, (resamples, scores.size))


def _share_of_wins(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """[...] the share of pairs from x [..., n] and y [..., m] with x > y; ties count half."""
    x, y = x[..., :, None], y[..., None, :]
    return ((x > y) + 0.5 * (x == y)).mean((-2, -1))


def _percentiles(values: NDArray[np.float64], level: float) -> tuple[float, float]:
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
