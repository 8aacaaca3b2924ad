"""Results of benches against older ones: which figures became better or worse, and by how much.

A figure is told from its name's ending (bench/records.py): rates should be large, seconds and bytes small; a few shares
should be large too, and mean more than rates where a machine was busy. Only results of the same kind of device are
compared, on a CPU also of the same CPU and number of threads.
"""

from __future__ import annotations

import collections
import json
import pathlib
import subprocess
from collections.abc import Iterable
from typing import Any, NamedTuple

from pmt_jax.errors import UsageError

Report = dict[str, Any]

RESULTS = pathlib.Path(__file__).parent / "results"
LESS, SHARES = ("_seconds", "_gb", "_mb"), ("ratio", "of_plain_x_threads", "gpu_busy", "efficiency")
# What says what a row is about, in the order in which it is said; everything else in a row was measured.
SUBJECT = ("task", "case", "policy", "what", "method", "scaling", "changes", "physics", "solver", "precision")
SIZES = ("devices", "seeds", "num_envs", "rollout_length", "batch", "steps")
WORSE = 0.9  # repeats scatter by about a tenth even on an idle machine


class Change(NamedTuple):
    """A figure then and now; `ratio` is above 1 where it became better, whichever way that is."""

    figure: str
    old: float
    new: float
    ratio: float


def more_is_better(name: str) -> bool:
    return name.endswith("_second") or name in SHARES


def label(row: dict[str, Any]) -> str:
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


def kind(report: Report) -> tuple[Any, ...]:
    """What must be the same for figures to be compared."""
    machine = report.get("machine", {})
    return (report["device"], machine.get("cpu"), machine.get("threads")) if on_cpu(report) else (report["device"],)


def on_cpu(report: Report) -> bool:
    return report["device"] == "cpu"


def changes(old: Report, new: Report) -> list[Change]:
    """Every figure that both have, worst first."""
    before, after = figures(old), figures(new)
    found = []
    for (about, name), value in after.items():
        if (then := before.get((about, name))) is not None:
            ratio = value / then if more_is_better(name) else then / value
            found.append(Change(f"{about}: {name}", then, value, ratio))
    return sorted(found, key=lambda change: change.ratio)


def describe(name: str, old: Report | None, new: Report) -> str:
    """The comparison of one bench, for people."""
    if old is None:
        return f"{name}: nothing older to compare with"
    if kind(old) != kind(new):
        then, now = (", ".join(str(x or "unknown") for x in kind(report)) for report in (old, new))
        return f"{name}: not compared, since the older figures are of {then}, these of {now}"
    found = changes(old, new)
    worse = sum(change.ratio < WORSE for change in found)
    load = f"; load average {new['load_average'][0]:g}" if "load_average" in new else ""
    lines = [f"{name}: {len(found)} figures, {worse} worse by more than a tenth (above 1 is better{load})"]
    for change in found:
        mark = "  <- worse" if change.ratio < WORSE else ""
        lines.append(f"  {change.ratio:6.2f} x  {change.figure}: {change.old:,.6g} -> {change.new:,.6g}{mark}")
    return "\n".join(lines)


def load(source: str) -> dict[str, Report]:
    """Results by name: of a JSON file, of a folder, or as committed in a git revision.

    Raises:
      UsageError: it is none of these.
    """
    path = pathlib.Path(source)
    if path.is_dir():
        return _reports((p.stem, p.read_text()) for p in sorted(path.glob("*.json")))
    if path.is_file():
        return _reports([(path.stem, path.read_text())])
    if (listed := _git("ls-tree", "--name-only", source, "results/")) is None:
        raise UsageError(f"'{source}' is neither a file of results, a folder of them nor a git revision")
    names = [name for name in listed.splitlines() if name.endswith(".json")]
    return _reports((pathlib.Path(name).stem, _git("show", f"{source}:./{name}") or "") for name in names)


def _reports(texts: Iterable[tuple[str, str]]) -> dict[str, Report]:
    """Those of `texts` that `records.write` wrote."""
    parsed = ((name, json.loads(text)) for name, text in texts)
    return {name: report for name, report in parsed if isinstance(report, dict) and {"rows", "device"} <= set(report)}


def _git(*words: str) -> str | None:
    """What git says in this folder; None where it fails or is missing."""
    try:
        done = subprocess.run(["git", *words], cwd=RESULTS.parent, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout if done.returncode == 0 else None
