"""Rows of a table against a baseline: effect sizes, and tests corrected for their number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..errors import UsageError
from ..tasks import did_you_mean
from . import statistics
from .rows import TableRow, compared

Estimate = dict[str, float | None]


class Comparison(NamedTuple):
    """A row against the baseline's, by column as `more reward`, `less cost`.

    Attributes:
      better: {name: {probability, low, high}} of a seed doing better, None if a seed has no score.
      p: {name: p} of Mann and Whitney's U test with Holm's correction over the rows of a task and the column; None
        if a seed has no score.
    """

    better: dict[str, Estimate]
    p: dict[str, float | None]


def with_baseline(rows: Sequence[TableRow], baseline: str) -> dict[tuple[str, str], Comparison]:
    """{(task, label): comparison} of every row whose task has the baseline, but the baseline itself.

    Args:
      baseline: a row's label, or a method with no more than one row per task.

    Raises:
      UsageError: no row, or several of one task, have the baseline's name.
    """
    columns = compared(rows)
    found = {}
    for task, rival in baselines(rows, baseline).items():
        ours = [row for row in rows if row.task == task and row is not rival]
        for row, p in zip(ours, tests(ours, rival, columns), strict=True):
            found[task, row.label] = Comparison(_improvements([row], [rival], columns), p)
    return found


def overall(rows: Sequence[TableRow], baseline: str) -> dict[str, dict[str, Estimate]]:
    """By label, the improvements over all tasks that have the baseline, for rows that are in all of several."""
    rivals = baselines(rows, baseline)
    result = {}
    for label in dict.fromkeys(row.label for row in rows):
        ours = {r.task: r for r in rows if r.label == label and r.task in rivals and r is not rivals[r.task]}
        if len(rivals) > 1 and set(ours) == set(rivals):
            result[label] = _improvements(list(ours.values()), [rivals[task] for task in ours], compared(rows))
    return result


def tests(ours: Sequence[TableRow], rival: TableRow, columns: tuple[str, str]) -> list[dict[str, float | None]]:
    """Each row's p against `rival`, see `Comparison`."""
    result: list[dict[str, float | None]] = [{} for _ in ours]
    for name, column in zip(names(columns), columns, strict=True):
        pairs = [_scores([row, rival], column) for row in ours]
        corrected = iter(statistics.holm([statistics.u_test(*pair) for pair in pairs if pair]))
        for p, pair in zip(result, pairs, strict=True):
            p[name] = next(corrected) if pair else None
    return result


def baselines(rows: Sequence[TableRow], baseline: str) -> dict[str, TableRow]:
    """The row that the others are held against, of every task that has it.

    Raises:
      UsageError: no row, or several of one task, have that name.
    """
    result: dict[str, TableRow] = {}
    for task in dict.fromkeys(row.task for row in rows):
        here = [row for row in rows if row.task == task]
        chosen = [row for row in here if row.label == baseline] or [row for row in here if row.method == baseline]
        if len(chosen) > 1:
            listing = ", ".join(f"'{row.label}'" for row in chosen)
            raise UsageError(f"'{baseline}' means several rows of {task}: {listing}; name one of them")
        if chosen:
            result[task] = chosen[0]
    if not result:
        raise UsageError(f"no row is called '{baseline}'{did_you_mean(baseline, {row.label for row in rows})}")
    return result


def names(columns: tuple[str, str]) -> tuple[str, str]:
    """What it means to be better in the columns of the reward and of the cost."""
    return f"more {columns[0]}", f"less {columns[1]}"


def _improvements(
    ours: Sequence[TableRow], theirs: Sequence[TableRow], columns: tuple[str, str]
) -> dict[str, Estimate]:
    result: dict[str, Estimate] = {}
    for name, column, sign in zip(names(columns), columns, (1, -1), strict=True):
        x, y = (_scores(side, column) for side in (ours, theirs))
        if x is None or y is None:
            result[name] = dict.fromkeys(("probability", "low", "high"))
            continue
        x, y = ([sign * scores for scores in side] for side in (x, y))
        low, high = statistics.improvement_interval(x, y)
        result[name] = {"probability": statistics.probability_of_improvement(x, y), "low": low, "high": high}
    return result


def _scores(rows: Sequence[TableRow], column: str) -> list[np.ndarray] | None:
    """The seeds' scores of each row; None if one has none."""
    found = [row.score(column) for row in rows]
    return found if all(np.isfinite(scores).all() for scores in found) else None
