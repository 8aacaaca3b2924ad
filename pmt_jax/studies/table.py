"""`pmt table`: method x (reward, cost, violation rate), with intervals over seeds, next to the paper's numbers."""

from __future__ import annotations

import json
import math
import pathlib
import tomllib
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import formats
from ..errors import UsageError
from ..formats import number
from ..limits import KEY
from ..tasks import did_you_mean
from . import effects, statistics
from .rows import Column, TableRow, compared, shown

FORMATS = (*formats.WRITERS, "json")
DEPLOYED = {"reward": Column("reward", "episode_reward"), "cost": Column("cost", "episode_cost", 0)}
UNDER_MEAN = [f"mean-action {name}" for name in (*DEPLOYED, "seeds within")]


def render(table: Sequence[TableRow], layout: str = "text", baseline: str | None = None, test: bool = False) -> str:
    """The table with what its numbers mean.

    Args:
      layout: text, markdown, latex or json.
      baseline: a row's label, or a method with no more than one row per task, that the others are held against.
      test: also print p values.

    Raises:
      UsageError: an unknown format or baseline, or a test without a baseline.
    """
    if layout not in FORMATS:
        raise UsageError(f"unknown format '{layout}'{did_you_mean(layout, FORMATS)}")
    if test and not baseline:
        raise UsageError("--test compares with a baseline: name a row with --baseline, like --baseline mappo_l")
    data = summarise(table, baseline)
    together = effects.overall(table, baseline) if baseline else {}
    notes = _notes(table, data, baseline, test)
    if layout == "json":
        everything = {"rows": data, "baseline": baseline, "all_tasks": together, "notes": notes}
        return json.dumps(everything, indent=1) + "\n"
    for label, better in together.items():
        listed = ", ".join(f"P({name}) {_interval(found, 'probability')}" for name, found in better.items())
        notes.append(f"All tasks together, {label}: {listed}.")
    return formats.write(*_cells(table, data, baseline, test), layout, notes)


def cells(table: Sequence[TableRow]) -> tuple[list[str], list[list[str]], list[str]]:
    """The table without a baseline: its head, its lines, and what its numbers mean."""
    data = summarise(table)
    return *_cells(table, data, None, False), _notes(table, data, None, False)


# ---------------------------------------------------------------------------------------------------------------------
# From rows to numbers


def paper() -> dict[str, Any]:
    """The paper's tables and numbers (paper.toml): `[tables]`, then one table of numbers per task."""
    return tomllib.loads((pathlib.Path(__file__).parent / "paper.toml").read_text())


def summarise(table: Sequence[TableRow], baseline: str | None = None) -> list[dict[str, Any]]:
    """Every row as plain data.

    Returns:
      {column: {iqm, low, high, mean, std}}, the share of seeds `within` the limit, the `worst` seed's cost, `better`
      than the baseline, with which `p`, and the `paper`'s numbers.

    Raises:
      UsageError: no row, or several of one task, have the baseline's name.
    """
    numbers = paper()["tasks"]
    comparisons = effects.with_baseline(table, baseline) if baseline else {}
    result = []
    for row in table:
        cost, against = row.score(compared(table)[1]), comparisons.get((row.task, row.label))
        given = numbers.get(row.task, {})
        data: dict[str, Any] = {"task": row.task, "method": row.method, "settings": row.settings}
        data |= {"seeds": len(cost), "steps": row.steps, "source": row.source, KEY: _finite(row.limits.total)}
        data |= {c.name: _estimate(row.scores[c.name], c) for c in shown(table) if c.name in row.scores}
        data |= {"within": float((row.beyond <= 0).mean()), "worst": _finite(cost.max())}
        if row.deployed:
            measured = {name: _estimate(row.deployed[name], DEPLOYED[name]) for name in DEPLOYED}
            beyond = row.deployed["beyond"][row.deployed["evaluated"]]  # a seed that broke is not within
            data["mean_actions"] = {**measured, "within": int((beyond <= 0).sum()), "seeds": len(beyond)}
        data |= {"better": against and against.better, "p": against and against.p}
        reported = given.get(row.method, {})
        data["paper"] = {"table": given.get("table"), "source": given.get("source"), "rerun": {}, **reported}
        result.append(data)
    return result


def _estimate(scores: np.ndarray, column: Column) -> dict[str, float | None]:
    """Averages over seeds, and the IQM's 95 % interval; None where a seed has no score, or one seed no interval."""
    low, high = statistics.iqm_interval(scores)
    if math.isfinite(low):
        low, high = max(low, column.low), min(high, column.high)
    std = float(scores.std(ddof=1)) if len(scores) > 1 else math.nan
    found = {"iqm": statistics.iqm(scores), "low": low, "high": high, "mean": float(scores.mean()), "std": std}
    return {name: _finite(x) for name, x in found.items()}


def _finite(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


# ---------------------------------------------------------------------------------------------------------------------
# From numbers to text


def _cells(
    table: Sequence[TableRow], data: Sequence[dict[str, Any]], baseline: str | None, test: bool
) -> tuple[list[str], list[list[str]]]:
    columns = [column.name for column in shown(table)]
    reported = {"paper": [row["paper"] for row in data], "rerun": [row["paper"]["rerun"] for row in data]}
    papers = [(who, column) for who in reported for column in columns if any(column in row for row in reported[who])]
    better = effects.names(compared(table)) if baseline else ()
    head = ["task", "method", "seeds", "steps", *columns, "limit", "seeds within", "worst seed"]
    ended = any(row.deployed for row in table)
    head += UNDER_MEAN * ended
    head += [f"P({name})" for name in better] + [f"p ({name})" for name in better if test]
    head += [f"{who} {column}" for who, column in papers]
    body = []
    for i, row in enumerate(data):
        within = f"{round(row['within'] * row['seeds'])}/{row['seeds']}"
        line = [row["task"], f"{row['method']} {row['settings']}".strip(), str(row["seeds"]), f"{row['steps']:,}"]
        line += [_interval(row.get(column), "iqm") for column in columns]
        line += [table[i].limit_on(compared(table)[1]), within, number(row["worst"])]
        line += _under_mean(row.get("mean_actions")) * ended
        line += [_interval((row["better"] or {}).get(name), "probability") for name in better]
        line += [number((row["p"] or {}).get(name), ".2g") for name in better if test]
        given = (reported[who][i].get(column) for who, column in papers)
        body.append(line + [" ± ".join(format(part, ".2f") for part in x) if x else "-" for x in given])
    return head, body


def _under_mean(measured: dict[str, Any] | None) -> list[str]:
    """The cells of UNDER_MEAN."""
    if not measured:
        return ["-"] * len(UNDER_MEAN)
    return [*(_interval(measured[name], "iqm") for name in DEPLOYED), f"{measured['within']}/{measured['seeds']}"]


def _interval(estimate: dict[str, float | None] | None, middle: str) -> str:
    """An average and its interval; - for what is unknown."""
    if estimate is None or estimate[middle] is None:
        return "-"
    ends = "-" if estimate["low"] is None else f"{number(estimate['low'])}, {number(estimate['high'])}"
    return f"{number(estimate[middle])} [{ends}]"


def _notes(table: Sequence[TableRow], data: Sequence[dict[str, Any]], baseline: str | None, test: bool) -> list[str]:
    """What the numbers are, in sentences."""
    sources = {"training": "training episodes (sampled actions)", "evaluation": "evaluation episodes (mean actions)"}
    used = " or, where a run made them, ".join(sources[s] for s in sources if any(row.source == s for row in table))
    notes = [
        f"A seed's score is its mean over the last tenth of its steps, of {used}.",
        "; ".join(column.note for column in shown(table) if column.note) + ".",
        "limit: the cost allowed; seeds within: seeds whose cost is within it; worst seed: the highest cost of a seed."
        + " Of several costs, which are added, each must be within its own limit."
        * any(len(r.limits.each) > 1 for r in table),
        "Interquartile mean over seeds, below four the mean [95 % studentised interval]; -: unknown, or not finite for "
        "some seed; [-]: one seed has no interval.",
    ]
    if any(row.deployed for row in table):
        notes.append(
            "mean-action: the last policies in the evaluation that ended the run, 64 whole episodes a seed without "
            "noise, as one deploys them; cost and seeds within by the worst agent."
        )
    notes += [f"{row.label} on {row.task}: {row.faults}." for row in table if row.faults]
    if baseline:
        notes.append(f"P: probability that a seed of the row does better than a seed of {baseline}; ties count half.")
    if test:
        notes.append(f"p: two-sided Mann-Whitney U test against {baseline}, Holm's correction over a task's rows.")
    tables = sorted({f"{row['task']}: {row['paper']['table']}" for row in data if row["paper"]["table"]})
    if tables:
        notes.append(f"paper: mean ± standard deviation of 5 seeds, as far as known here ({', '.join(tables)}).")
    notes += [f"{', '.join(tasks)}, paper: {source}." for source, tasks in _sources(data).items()]
    return notes


def _sources(data: Sequence[dict[str, Any]]) -> dict[str, list[str]]:
    """The sources of reported values that are not the paper's own, each with the tasks of its rows."""
    tasks: dict[str, dict[str, None]] = {}
    for row in data:
        reported = row["paper"]
        if reported["source"] and (reported["rerun"] or reported.keys() - {"table", "source", "rerun"}):
            tasks.setdefault(reported["source"], {})[row["task"]] = None
    return {source: list(found) for source, found in tasks.items()}
