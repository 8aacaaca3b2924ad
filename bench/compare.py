"""Results against older ones: which figures became better or worse, and by how much.

The ending of a figure's name says which way is better (bench/records.py): rates should be large, seconds and bytes
small. Only results of the same kind of device are compared, on a CPU also of the same CPU and number of threads.
"""

from __future__ import annotations

import collections
from typing import Any, NamedTuple

from .records import Record, Report

LESS = ("_seconds", "_gb", "_mb")
# What says what a row is about, in the order in which it is said; everything else in a row was measured.
SUBJECT = ("kind", "task", "name", "what", "method", "physics")
SIZES = ("threads", "devices", "workers", "seeds", "num_envs", "rollout_length")
WORSE = 0.9  # repeats scatter by about a tenth even on an idle machine


class Change(NamedTuple):
    """A figure then and now; `ratio` is above 1 if it became better, whichever way that is."""

    figure: str
    old: float
    new: float
    ratio: float


def more_is_better(name: str) -> bool:
    return name.endswith("_second")


def label(row: Record) -> str:
    """What a row is about, for people."""
    words = [str(row[name]) for name in SUBJECT if row.get(name)]
    return ", ".join([*words, *(f"{name} {row[name]:,}" for name in SIZES if name in row)])


def figures(report: Report) -> dict[tuple[str, str], float]:
    """{(what the row is about, name of the figure): value}; rows about the same thing are numbered."""
    found, met = {}, collections.Counter()
    for row in report["rows"]:
        met[about := label(row)] += 1
        about += f" #{met[about]}" if met[about] > 1 else ""
        for name, value in row.items():
            if (more_is_better(name) or name.endswith(LESS)) and isinstance(value, int | float) and value > 0:
                found[about, name] = value
    return found


def on_cpu(report: Report) -> bool:
    return report["device"] == "cpu"


def changes(old: Report, new: Report) -> list[Change]:
    """Every figure that both have, worst first."""
    before, found = figures(old), []
    for (about, name), value in figures(new).items():
        if (then := before.get((about, name))) is not None:
            ratio = value / then if more_is_better(name) else then / value
            found.append(Change(f"{about}: {name}", then, value, ratio))
    return sorted(found, key=lambda change: change.ratio)


def describe(name: str, old: Report | None, new: Report) -> str:
    """The comparison of one result, for people."""
    if old is None:
        return f"{name}: nothing older to compare with"
    if _kind(old) != _kind(new):
        then, now = (", ".join(str(x or "unknown") for x in _kind(report)) for report in (old, new))
        return f"{name}: not compared, since the older figures are of {then}, these of {now}"
    found = changes(old, new)
    worse = sum(change.ratio < WORSE for change in found)
    load = f"; load average {new['load_average'][0]:g}" if "load_average" in new else ""
    lines = [f"{name}: {len(found)} figures, {worse} worse by more than a tenth (above 1 is better{load})"]
    for change in found:
        mark = "  <- worse" if change.ratio < WORSE else ""
        lines.append(f"  {change.ratio:6.2f} x  {change.figure}: {change.old:,.6g} -> {change.new:,.6g}{mark}")
    return "\n".join(lines)


def _kind(report: Report) -> tuple[Any, ...]:
    """What must be the same for figures to be compared."""
    machine = report.get("machine", {})
    return (report["device"], machine.get("cpu"), machine.get("threads")) if on_cpu(report) else (report["device"],)
