"""Runs as a table: method x (reward, cost, violation rate), with intervals over seeds, beside the paper's numbers.

A run's figure is one number per seed: its mean over the last tenth of the steps, of the evaluations made there
(`eval/...` in metrics.jsonl: whole episodes under mean actions) where the run made any, else of the training episodes
that ended there (sampled actions). A row pools the seeds of all runs that share task, method and settings.
"""

from __future__ import annotations

import dataclasses
import json
import math
import pathlib
import re
import tomllib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..config.methods import METHODS
from ..config.settings import Config, load_config
from ..errors import UsageError
from ..files import read_rows
from ..tasks import did_you_mean
from . import statistics

LAST = 0.1
FIGURES = {
    "reward": "episode_reward",
    "cost": "episode_cost",
    "violation rate": "violation_rate",
    "outside": "info/outside",
    "CR": "info/totally_controllable_ratio",
    "PL": "info/total_line_loss",
}
LOSSES = ("actor/loss", "critic/loss", "cost_critic/loss")  # null where training went astray: no figures then
FORMATS = ("text", "markdown", "latex", "json")
SAME_IN_A_ROW = ("seed", "seeds", "log_interval", "eval_interval", "eval_episodes")  # do not change what is learned


@dataclasses.dataclass(frozen=True)
class Row:
    """The seeds of all runs with the same task, method and settings.

    Attributes:
      task, method: their names; settings: what differs from other rows of the same task, as `name=value`.
      cost_limit: allowed cost of one agent per episode.
      steps: environment steps per seed (the fewest, where runs differ).
      source: `evaluation` or `training`, what the figures are taken from.
      figures: {column: [seeds]} in the task's units; nan where a seed has none.
    """

    task: str
    method: str
    settings: str
    cost_limit: float
    steps: int
    source: str
    figures: dict[str, np.ndarray]

    @property
    def label(self) -> str:
        """The method, and what sets it apart."""
        return " ".join(filter(None, (self.method, self.settings)))

    @property
    def rank(self) -> tuple[bool, float]:
        """Sorts the best first: by reward within the cost limit, then by cost beyond it; nan last."""
        reward, cost = (float(statistics.iqm(self.figures[name])) for name in ("reward", "cost"))
        safe = cost <= self.cost_limit
        key = -reward if safe else cost
        return (not safe, math.inf if math.isnan(key) else key)


# ---------------------------------------------------------------------------------------------------------------------
# From run folders to rows


@dataclasses.dataclass(frozen=True)
class _Found:
    """One run folder: its settings, and per seed its figures."""

    folder: pathlib.Path
    config: Config
    task: str
    cost_limit: float
    steps: int
    source: str
    figures: dict[int, dict[str, float]]


def find_runs(paths: Sequence[pathlib.Path]) -> list[pathlib.Path]:
    """The run folders among and below `paths`; hidden folders are left out.

    Raises:
      UsageError: one of them holds none.
    """
    found: list[pathlib.Path] = []
    for path in paths:
        inside = sorted(f.parent for f in path.rglob("metrics.jsonl") if (f.parent / "config.toml").is_file())
        inside = [f for f in inside if not any(part.startswith(".") for part in f.relative_to(path).parts)]
        if not inside:
            raise UsageError(f"{path} holds no run: no folder in it has a config.toml and a metrics.jsonl")
        found += [f for f in inside if f not in found]
    return found


def rows(folders: Sequence[pathlib.Path]) -> list[Row]:
    """One row per task, method and settings, in the order of the tasks' names and of METHODS.

    Raises:
      UsageError: a folder holds no rows, or two runs of one row have trained the same seed.
    """
    groups: dict[tuple[str, str, str], list[_Found]] = {}
    for found in map(_read, folders):
        groups.setdefault((found.task, found.config.method, _essence(found.config)), []).append(found)
    result = []
    for (task, method, _), runs in groups.items():
        rivals = [g[0].config for (t, m, _), g in groups.items() if (t, m) == (task, method)]
        result.append(_pool(task, runs, _differing(runs[0].config, rivals)))
    return in_order(result)


def in_order(rows: Sequence[Row]) -> list[Row]:
    """Sorted by task, then as METHODS is; methods that are not in it last."""
    order = list(METHODS)
    return sorted(rows, key=lambda row: (row.task, order.index(row.method) if row.method in order else len(order)))


def _read(folder: pathlib.Path) -> _Found:
    log = read_rows(folder / "metrics.jsonl", missing_ok=False)
    if not log:
        raise UsageError(f"{folder} has no figures yet: its metrics.jsonl is empty")
    last = log[-1]
    steps = last["step"]
    log = [row for row in log if row["step"] > (1 - LAST) * steps]
    evaluated = any(row.get("eval/episode_reward") is not None for row in log)
    prefix = "eval/" if evaluated else ""
    names = {column: prefix + name for column, name in FIGURES.items() if prefix + name in last}
    figures = {}
    for seed in {row["seed"] for row in log}:
        mine = [row for row in log if row["seed"] == seed]
        sound = all(mine[-1].get(loss, 0) is not None for loss in LOSSES)
        figures[seed] = {
            column: _mean([row[name] for row in mine]) if sound else math.nan for column, name in names.items()
        }
    source = "evaluation" if evaluated else "training"
    config = load_config(folder / "config.toml")
    return _Found(folder, config, last["task"], last["cost_limit"], steps, source, figures)


def _mean(values: Sequence[float | None]) -> float:
    known = [x for x in values if x is not None]
    return sum(known) / len(known) if known else math.nan


def _essence(config: Config) -> str:
    """Settings that make runs different, as a text to compare."""
    kept = [f.name for f in dataclasses.fields(config) if f.name not in SAME_IN_A_ROW]
    return repr([(name, getattr(config, name)) for name in kept])


def _differing(config: Config, rivals: Sequence[Config]) -> str:
    names = [f.name for f in dataclasses.fields(config) if f.name not in SAME_IN_A_ROW]
    apart = [n for n in names if len({repr(getattr(rival, n)) for rival in rivals}) > 1]
    return " ".join(f"{n}={plain(getattr(config, n))}" for n in apart)


def plain(value: Any) -> str:
    """A setting's value, numbers as short as they can be."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _pool(task: str, runs: Sequence[_Found], settings: str) -> Row:
    """The seeds of runs that share everything else.

    Raises:
      UsageError: a seed stands in two of them, or some were evaluated while training and others not.
    """
    owner: dict[int, _Found] = {}
    for run in runs:
        for seed in run.figures:
            if seed in owner:
                both = f"{owner[seed].folder} and {run.folder}"
                raise UsageError(f"seed {seed} counts twice: {both} are the same run; leave one of them out")
            owner[seed] = run
    if len({run.source for run in runs}) > 1:
        raise UsageError(
            f"{runs[0].folder} and {runs[-1].folder} cannot share a row: only one was evaluated in training"
        )
    columns = [column for column in FIGURES if all(column in f for run in runs for f in run.figures.values())]
    figures = {c: np.asarray([owner[seed].figures[seed][c] for seed in sorted(owner)]) for c in columns}
    first = runs[0]
    steps = min(run.steps for run in runs)
    return Row(task, first.config.method, settings, first.cost_limit, steps, first.source, figures)


# ---------------------------------------------------------------------------------------------------------------------
# From rows to figures


def paper() -> dict[str, Any]:
    """The paper's tables and numbers (paper.toml): `[tables]`, then one table of numbers per task."""
    return tomllib.loads((pathlib.Path(__file__).parent / "paper.toml").read_text())


def summarise(table: Sequence[Row], baseline: str | None = None) -> list[dict[str, Any]]:
    """Every row as plain data: {column: {iqm, low, high}}, `better` than the baseline, and the `paper`'s numbers.

    Args:
      baseline: a row's label, or a method with no more than one row per task.

    Raises:
      UsageError: no row, or several of one task, are called so.
    """
    numbers = paper()["tasks"]
    rivals = _baselines(table, baseline) if baseline else {}
    result = []
    for row in table:
        data: dict[str, Any] = {"task": row.task, "method": row.method, "settings": row.settings}
        data |= {"seeds": len(row.figures["reward"]), "steps": row.steps, "source": row.source}
        data |= {"cost_limit": row.cost_limit, **{column: _estimate(x) for column, x in row.figures.items()}}
        rivals_here = [rivals[row.task]] if rivals.get(row.task, row) is not row else []
        data["better"] = {c: _improvement([row], rivals_here, c) for c in ("reward", "cost")} if rivals_here else None
        given = numbers.get(row.task, {})
        data["paper"] = {"table": given.get("table"), **given.get(row.method, {})}
        result.append(data)
    return result


def overall(table: Sequence[Row], baseline: str) -> dict[str, dict[str, Any]]:
    """By label, the probability of improvement over all tasks that have the baseline, for rows that stand in all."""
    rivals = _baselines(table, baseline)
    result = {}
    for label in dict.fromkeys(row.label for row in table):
        mine = [row for row in table if row.label == label and row.task in rivals]
        ours = {row.task: row for row in mine if row is not rivals[row.task]}
        if len(rivals) > 1 and set(ours) == set(rivals):
            pair = list(ours.values()), [rivals[task] for task in ours]
            result[label] = {column: _improvement(*pair, column) for column in ("reward", "cost")}
    return result


def _baselines(table: Sequence[Row], baseline: str) -> dict[str, Row]:
    """The row that the others are held against, of every task that has it."""
    result: dict[str, Row] = {}
    for task in dict.fromkeys(row.task for row in table):
        here = [row for row in table if row.task == task]
        chosen = [row for row in here if row.label == baseline] or [row for row in here if row.method == baseline]
        if len(chosen) > 1:
            listing = ", ".join(f"'{row.label}'" for row in chosen)
            raise UsageError(f"'{baseline}' means several rows of {task}: {listing}; name one of them")
        if chosen:
            result[task] = chosen[0]
    if not result:
        raise UsageError(f"no row is called '{baseline}'{did_you_mean(baseline, {row.label for row in table})}")
    return result


def _estimate(scores: np.ndarray) -> dict[str, float | None]:
    """Interquartile mean and 95 % bootstrap interval over seeds; None where a seed has no figure."""
    if not np.isfinite(scores).all():
        return {"iqm": None, "low": None, "high": None}
    low, high = statistics.bootstrap_interval([scores])
    return {"iqm": float(statistics.iqm(scores)), "low": low, "high": high}


def _improvement(ours: Sequence[Row], theirs: Sequence[Row], column: str) -> dict[str, float | None]:
    """Probability of more reward, or of less cost, with its 95 % interval; None where a seed has no figure."""
    sign = -1 if column == "cost" else 1
    x, y = ([sign * row.figures[column] for row in side] for side in (ours, theirs))
    if not all(np.isfinite(scores).all() for scores in (*x, *y)):
        return {"probability": None, "low": None, "high": None}
    low, high = statistics.improvement_interval(x, y)
    return {"probability": statistics.probability_of_improvement(x, y), "low": low, "high": high}


# ---------------------------------------------------------------------------------------------------------------------
# From figures to text


def render(table: Sequence[Row], form: str = "text", baseline: str | None = None) -> str:
    """The table with what its figures mean, as text, markdown, latex or json.

    Raises:
      UsageError: an unknown format or baseline.
    """
    if form not in FORMATS:
        raise UsageError(f"unknown format '{form}'{did_you_mean(form, FORMATS)}")
    data = summarise(table, baseline)
    together = overall(table, baseline) if baseline else {}
    if form == "json":
        everything = {"rows": data, "baseline": baseline, "all_tasks": together, "notes": _notes(data, baseline, {})}
        return json.dumps(everything, indent=1) + "\n"
    head, body = _cells(data, baseline)
    write = {"text": _text, "markdown": _markdown, "latex": _latex}[form]
    return write(head, body, _notes(data, baseline, together))


def _cells(data: Sequence[dict[str, Any]], baseline: str | None) -> tuple[list[str], list[list[str]]]:
    columns = [column for column in FIGURES if any(column in row for row in data)]
    papers = [column for column in columns if any(column in row["paper"] for row in data)]
    head = ["task", "method", "seeds", "steps", *columns, "limit"]
    head += ["P(more reward)", "P(less cost)"] if baseline else []
    head += [f"paper {column}" for column in papers]
    body = []
    for row in data:
        line = [row["task"], f"{row['method']} {row['settings']}".strip(), str(row["seeds"]), f"{row['steps']:,}"]
        line += [_interval(row.get(column), "iqm") for column in columns] + [f"{row['cost_limit']:g}"]
        if baseline:
            line += [_interval((row["better"] or {}).get(column), "probability") for column in ("reward", "cost")]
        body.append(line + [f"{row['paper'][column]:g}" if column in row["paper"] else "-" for column in papers])
    return head, body


def _interval(figure: dict[str, float | None] | None, middle: str) -> str:
    if figure is None or figure[middle] is None:
        return "-"
    return f"{figure[middle]:.4g} [{figure['low']:.4g}, {figure['high']:.4g}]"


def _notes(data: Sequence[dict[str, Any]], baseline: str | None, together: dict[str, dict[str, Any]]) -> list[str]:
    """What the figures are, in sentences."""
    sources = {
        "training": "training episodes (sampled actions)",
        "evaluation": "evaluation episodes (mean actions)",
    }
    used = " or, where a run made them, ".join(sources[s] for s in sources if any(row["source"] == s for row in data))
    notes = [
        f"A seed's figure is its mean over the last tenth of its steps, of {used}.",
        "reward: undiscounted, of the team, per episode; cost: undiscounted, of one agent (mean over agents), per "
        "episode; limit: the cost allowed; violation rate: share of steps with a cost above 0 for some agent.",
        "Interquartile mean over seeds [95 % stratified bootstrap interval]; -: unknown, or not finite for some seed.",
    ]
    if any("outside" in row for row in data):
        notes.append("outside: share of steps beyond a wall; walls do not block, and behind their bands nothing costs.")
    if any("CR" in row for row in data):
        notes.append("CR: share of steps with every bus in the band; PL: losses in lines, MW.")
    if baseline:
        notes.append(f"P: probability that a seed of the row does better than a seed of {baseline}; ties count half.")
    for label, better in together.items():
        reward, cost = (_interval(better[column], "probability") for column in ("reward", "cost"))
        notes.append(f"All tasks together, {label}: P(more reward) {reward}, P(less cost) {cost}.")
    tables = sorted({f"{row['task']}: {row['paper']['table']}" for row in data if row["paper"]["table"]})
    if tables:
        notes.append(f"paper: as far as its numbers are known here, means over 5 seeds ({', '.join(tables)}).")
    return notes


def _text(head: list[str], body: list[list[str]], notes: list[str]) -> str:
    widths = [max(len(line[i]) for line in (head, *body)) for i in range(len(head))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in (head, *body)]
    rule = "  ".join("-" * width for width in widths)
    return "\n".join(line.rstrip() for line in [lines[0], rule, *lines[1:], "", *notes]) + "\n"


def _markdown(head: list[str], body: list[list[str]], notes: list[str]) -> str:
    lines = ["| " + " | ".join(line) + " |" for line in (head, *body)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:], "", *notes]) + "\n"


def _latex(head: list[str], body: list[list[str]], notes: list[str]) -> str:
    def escaped(cells: Sequence[str]) -> str:
        return " & ".join(re.sub(r"([_%&#])", r"\\\1", cell) for cell in cells) + r" \\"

    comments = [f"% {note}" for note in notes]
    top = [r"\begin{tabular}{ll" + "r" * (len(head) - 2) + "}", r"\toprule", escaped(head), r"\midrule"]
    return "\n".join([*comments, *top, *map(escaped, body), r"\bottomrule", r"\end{tabular}"]) + "\n"
