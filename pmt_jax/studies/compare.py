"""`pmt compare`: two runs of one task, seeds of one against seeds of the other."""

from __future__ import annotations

import dataclasses
import math
import pathlib

import numpy as np

from .. import formats
from ..errors import UsageError
from . import plot, statistics
from .rows import TableRow, compared, rows
from .run_log import Group, groups, read_all

NOTES = (
    "A seed's score is its mean over the last tenth of its steps.",
    "Scores are means over seeds [95 %, Student; of costs cut at 0].",
    "difference: the first less the second [95 %, Welch; of shares Newcombe].",
    "P: probability that a seed of the first has more reward (less cost) than one of the second; ties half [Newcombe].",
    "-: a seed has no score; [-]: one seed has no interval.",
)


def compare(first: pathlib.Path, second: pathlib.Path, picture: pathlib.Path | None = None) -> str:
    """The comparison as text: reward, cost and the share of seeds within the limit, one line each.

    Args:
      first, second: run folders, or folders of runs that differ in nothing but their seeds.
      picture: where the curves of both are drawn (.png, .svg or .pdf).

    Raises:
      UsageError: a folder holds no run or several, the tasks differ, or only one of the two was evaluated in training.
    """
    if picture:
        plot.check_ending(picture)
    (ours, our_group), (theirs, their_group) = _side(first), _side(second)
    if first.resolve() == second.resolve():
        raise UsageError(f"{first} and {second} are the same run; name two")
    if ours.task != theirs.task:
        raise UsageError(f"{first} is a run of {ours.task} and {second} of {theirs.task}; compare runs of one task")
    if ours.source != theirs.source:
        raise UsageError(f"cannot compare {first} with {second}: only one of them was evaluated in training")
    names = _names(ours, theirs, first, second)
    if picture:
        named = zip(names, (our_group, their_group), strict=True)
        curves = [dataclasses.replace(group, settings=name[len(group.method) + 1 :]) for name, group in named]
        plot.draw(curves, picture)
    head = [ours.task, *(f"{name} ({len(row.beyond)} seeds)" for name, row in zip(names, (ours, theirs), strict=True))]
    head += ["difference", "P"]
    reward, cost = compared([ours, theirs])
    body = [_line(reward, ours.score(reward), theirs.score(reward), 1)]
    body += [_line(f"{cost} (limit {_both(ours, theirs, cost)})", ours.score(cost), theirs.score(cost), -1, least=0)]
    body += [_within(ours.beyond, theirs.beyond)]
    return formats.write(head, body, "text", NOTES)


def _side(path: pathlib.Path) -> tuple[TableRow, Group]:
    """The one kind of run at or below `path`: its scores, and its curves."""
    logs = read_all([path])
    found = rows(logs)
    if len(found) > 1:
        listing = ", ".join(f"{row.label} on {row.task}" for row in found[:4])
        raise UsageError(f"{path} holds {len(found)} kinds of runs ({listing}); name one, or take pmt table for all")
    return found[0], groups([log.thinned(plot.POINTS) for log in logs])[0]


def _names(ours: TableRow, theirs: TableRow, first: pathlib.Path, second: pathlib.Path) -> list[str]:
    """What sets the two apart: their methods, or else their folders too."""
    if ours.method != theirs.method:
        return [ours.method, theirs.method]
    return [f"{ours.method} {path}" for path in (first, second)]


def _both(ours: TableRow, theirs: TableRow, cost: str) -> str:
    limits = dict.fromkeys(row.limit_on(cost) for row in (ours, theirs))
    return " and ".join(limits)


def _line(name: str, x: np.ndarray, y: np.ndarray, sign: int, least: float = -math.inf) -> list[str]:
    """A measure's scores [seeds] of both sides, of which more (sign 1) or less (-1) is better, and none below `least`.

    The intervals of means are cut there, as those of the table are; a difference may have either sign.
    """
    intervals = [statistics.mean_interval(side) for side in (x, y)]
    cells = [_cell(float(s.mean()), (max(low, least), high)) for s, (low, high) in zip((x, y), intervals, strict=True)]
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return [name, *cells, "-", "-"]
    difference = _cell(float(x.mean() - y.mean()), statistics.difference_interval(x, y))
    return [name, *cells, difference, _better(sign * x, sign * y)]


def _within(ours: np.ndarray, theirs: np.ndarray) -> list[str]:
    """The share of seeds whose cost is within the limit; a seed without a score is not."""
    x, y = (np.asarray(beyond <= 0, float) for beyond in (ours, theirs))
    interval = statistics.share_difference_interval(int(x.sum()), x.size, int(y.sum()), y.size)
    difference = _cell(float(x.mean() - y.mean()), interval)
    counts = [f"{int(side.sum())} of {side.size}" for side in (x, y)]
    return ["seeds within the limit", *counts, difference, _better(x, y)]


def _better(x: np.ndarray, y: np.ndarray) -> str:
    return _cell(statistics.probability_of_improvement([x], [y]), statistics.improvement_interval([x], [y]))


def _cell(middle: float, interval: statistics.Interval) -> str:
    if not math.isfinite(middle):
        return "-"
    ends = ", ".join(f"{x:.4g}" for x in interval) if math.isfinite(interval[0]) else "-"
    return f"{middle:.4g} [{ends}]"
