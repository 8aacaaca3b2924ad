"""Training runs as compact results: what a table, a picture and a repetition of a run need, and no more."""

from __future__ import annotations

import collections
import functools
import json
import pathlib
import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pmt_jax.config.methods import METHODS
from pmt_jax.errors import UsageError
from pmt_jax.formats import markdown, number
from pmt_jax.limits import Limits
from pmt_jax.studies import plot, program_folder, table
from pmt_jax.studies.rows import TableRow, in_order, place, rows
from pmt_jax.studies.run_log import RunLog, groups, read_all
from pmt_jax.studies.statistics import iqm
from pmt_jax.tasks import columns

from .. import records

Run = dict[str, Any]

CURVES = ("episode_reward", "episode_cost", "violation_rate", "lambda", "episode_length")
TRUE_CURVES = ("true_episode_cost", "true_step_cost")  # runs of before cost_seen have none
# Stored as means over seeds.
DIAGNOSTICS = ("fear/", "regret/", "actor/case", "actor/entropy", "actor/std", "cost_critic/explained_variance")
# Settings in which runs of one sample may differ: they change no number of the learner, or only the seeds.
OF_A_SAMPLE = {"seed", "seeds", "steps", "physics", "log_interval", "eval_interval", "eval_episodes"}
OF_MEAN_ACTIONS = "of mean actions: "  # in the last evaluation
TRUE = "true cost"  # also of steps that the learner did not observe
TRUE_WHILE_TRAINING = "true cost per 1,000 steps while training"
BEYOND = "beyond"  # the limit, of the agent and cost furthest beyond; older files have none


def store(folders: Sequence[pathlib.Path], out: pathlib.Path, same_end: bool = False, points: int = plot.POINTS) -> int:
    """Writes the run folders among and below `folders` into a JSON file; returns how many there are.

    Args:
      same_end: all runs are read as if they had ended at the last step that every one of them reached.
      points: the most points of a curve, means over the rows between them. Tables come from all rows.
    """
    logs = read_all(folders)
    if same_end:
        end = min(log.steps[-1] for log in logs)
        logs = [log.until(end) for log in logs]
    found = [_compact(run, points) | {"label": group.label} for group in groups(logs) for run in group.runs]
    out.write_text(json.dumps(found, separators=(",", ":")) + "\n")
    return len(found)


def load(files: pathlib.Path) -> list[Run]:
    """The runs of a JSON file, or of several whose names a + joins.

    Raises:
      UsageError: one is not there, or is not what `store` makes.
    """
    return [run for name in files.stem.split("+") for run in _load(files.with_stem(name))]


def _load(file: pathlib.Path) -> list[Run]:
    try:
        found = json.loads(file.read_text())
        for run in found:
            row_of(run)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{file} holds no stored runs ({type(error).__name__}: {error})") from None
    return found


def _compact(log: RunLog, points: int) -> Run:
    """A run's curves per seed, its figures in a table, and what it takes to make it again.

    Curves are {name: [seeds][points]}, None where unknown; `diagnostics` are means over seeds [points], also of what
    the task reports; `table` is {column: [seeds]}, see `pmt_jax.studies.table`, and what the last evaluation found, the
    one that ended the run if there was one.
    """
    found, (row,) = log.thinned(points), rows([log])
    scores = dict(row.scores)
    if "true_step_cost" in log.metrics:
        scores |= {TRUE_WHILE_TRAINING: 1000 * np.nanmean(log.metrics["true_step_cost"], axis=1)}
    evaluated = np.isfinite(log.metrics.get("eval/episode_cost", np.empty((0, 0)))).any(0)
    if evaluated.any():
        last = np.flatnonzero(evaluated)[-1]
        scores |= {f"{OF_MEAN_ACTIONS}{x}": log.metrics[f"eval/episode_{x}"][:, last] for x in ("cost", "reward")}
    scores |= {f"{OF_MEAN_ACTIONS}{x}": row.deployed[x] for x in ("cost", "reward", BEYOND) if x in row.deployed}
    scores[BEYOND] = row.beyond
    names = [name for name in (*CURVES, *TRUE_CURVES) if name in found.metrics]
    kept = (*DIAGNOSTICS, *(f"info/{name}" for name in columns(found.task)))
    diagnostics = {name: x.mean(0) for name, x in found.metrics.items() if name.startswith(kept)}
    return {
        "steps": found.steps.tolist(),
        "seeds": list(found.seeds),
        **{name: [[_rounded(x, 5) for x in seed] for seed in found.metrics[name]] for name in names},
        "diagnostics": {name: [_rounded(x) for x in mean] for name, mean in diagnostics.items()},
        "table": {column: [_rounded(x) for x in seeds] for column, seeds in scores.items()},
        "source": row.source,
        "task": found.task,
        "method": found.method,
        "cost_limit": found.limits.total,
        "limits": list(found.limits.each),
        "seconds": float(np.nanmax(log.metrics["seconds"])),
        "versions": log.versions,
        "commit": (records.git("rev-parse", "--short", "HEAD") or "unknown").strip(),
        "config": program_folder.settings_file(log.folder).read_text(),
    }


def _rounded(x: float, digits: int = 6) -> float | None:
    return float(f"{x:.{digits}g}") if np.isfinite(x) else None


def curves(run: Run) -> RunLog:
    """A stored run as `pmt plot` has it; each seed has the mean over seeds of what was stored as such."""
    known = {name: np.array(run[name], float) for name in (*CURVES, *TRUE_CURVES) if name in run}
    means = {name: np.array(mean, float) for name, mean in run.get("diagnostics", {}).items()}
    return RunLog(
        folder=pathlib.Path(run["task"]),
        task=run["task"],
        method=run["method"],
        limits=_limits(run),
        settings=tomllib.loads(run["config"]),
        seeds=tuple(run["seeds"]),
        steps=np.array(run["steps"]),
        metrics=known | {name: np.tile(mean, (len(run["seeds"]), 1)) for name, mean in means.items()},
    )


def as_paper(file: pathlib.Path) -> str:
    """A line a run: mean ± standard deviation over seeds, as the paper has it, then the paper's own figures."""
    shown = in_order([row_of(run) for run in load(file)])
    found = table.summarise(shown)
    measured = [name for name in ("reward", "cost", "CR", "PL") if name in found[0]]
    published = [name for name in measured if any(name in row["paper"] for row in found)]
    head = ["method", *measured, "seeds within", "worst seed", *(f"paper {name}" for name in published)]
    several = len({row["cost_limit"] for row in found}) > 1
    body = []
    for label, row in zip((row.label for row in shown), found, strict=True):
        line = [label + (f", limit {row['cost_limit']:g}" if several else "")]
        line += [_mean_std(row[name]["mean"], row[name]["std"]) for name in measured]
        line += [f"{round(row['within'] * row['seeds'])} of {row['seeds']}", number(row["worst"], ".2f")]
        line += [_mean_std(*row["paper"][name]) if name in row["paper"] else "-" for name in published]
        body.append(line)
    return markdown(head, body)


def as_summary(files: pathlib.Path) -> str:
    """Methods by tasks: mean reward / cost, and how many seeds keep the limit; a + joins the names of several files.

    A method has its label where it has several settings in a task, and `-` where it has not run.
    """
    found = _summaries(files)
    often = collections.Counter((task, row.method) for (task, _), (row, _) in found.items())
    cells = {
        (task, row.method if often[task, row.method] == 1 else label): (row, text)
        for (task, label), (row, text) in found.items()
    }
    tasks, methods = (list(dict.fromkeys(name)) for name in zip(*cells, strict=True))
    limits = {row.task: row.limits for row, _ in cells.values()}
    head = ["", *(f"`{task}` (limit {limits[task]})" for task in tasks)]
    words = {cell: text for cell, (_, text) in cells.items()}
    return markdown(head, [[f"`{name}`", *(words.get((task, name), "-") for task in tasks)] for name in methods])


def as_overview(files: pathlib.Path) -> str:
    """As `summary`, but tasks by methods, and of the methods with a multiplier only those whose multiplier has PID."""
    cells = {
        (task, row.method): text
        for (task, _), (row, text) in _summaries(files).items()
        if row.settings or not has_multiplier(row.method)
    }
    methods = sorted(dict.fromkeys(name for _, name in cells), key=place)
    body = [
        [f"`{task}`", *(cells.get((task, method), "-") for method in methods)]
        for task in dict.fromkeys(task for task, _ in cells)
    ]
    return markdown(["", *(f"`{method}`" for method in methods)], body)


def _summaries(files: pathlib.Path) -> dict[tuple[str, str], tuple[TableRow, str]]:
    """{(task, label): a row, and its mean reward / cost and how many seeds keep the limit} of files that a + joins."""
    stored = [load(files.with_stem(name)) for name in files.stem.split("+")]
    found = [row for each in stored for row in in_order([row_of(run) for run in each])]
    words = [
        f"{number(x['reward']['mean'], ',.4g')} / {number(x['cost']['mean'], '.3g')}, "
        f"{round(x['within'] * x['seeds'])} of {x['seeds']}"
        for x in table.summarise(found)
    ]
    often = collections.Counter((row.task, row.label) for row in found)
    if doubled := [f"{label} on {task}" for (task, label), count in often.items() if count > 1]:
        raise UsageError(f"{files}: several runs of {doubled[0]}, of which a table of methods by tasks can show one")
    return {(row.task, row.label): (row, text) for row, text in zip(found, words, strict=True)}


def as_printed(file: pathlib.Path) -> str:
    """Methods by tasks, of what a command of ours printed: reward with its interval / cost, and seeds within.

    Above it the runs of the command, and how long they took together; also those of commands that were only timed.
    """
    report = json.loads(file.read_text())
    printed = report["rows"]
    tasks, methods = (list(dict.fromkeys(row[name] for row in printed)) for name in ("task", "method"))
    limits = {row["task"]: row["limit"] for row in printed}
    words = {}
    for row in printed:
        reward, low, high = row["reward"]
        seeds = f"{row['within']} of {row['seeds']}"
        words[row["task"], row["method"]] = f"{reward:,.0f} [{low:,.0f}, {high:,.0f}] / {row['cost'][0]:.3g}, {seeds}"
    steps = round(printed[0]["steps"] / 1e6)
    made = [report | {"runs": sum(row["seeds"] for row in printed)}, *report.get("timed", [])]
    took = "; ".join(
        f"`{one['command']}`, {one['runs']} runs of {steps} M steps in {one['seconds'] / 60:.1f} minutes on "
        f"{one['devices']} x {one['device']}"
        for one in made
    )
    head = ["", *(f"`{task}` (limit {limits[task]:g})" for task in tasks)]
    body = [[f"`{method}`", *(words.get((task, method), "-") for task in tasks)] for method in methods]
    return f"{took}, all compiling included:\n\n{markdown(head, body)}"


@functools.cache  # each run is compared with each
def _settings(config: str) -> dict[str, Any]:
    return tomllib.loads(config)


def settings(run: Run) -> dict[str, Any]:
    """A run's settings and its task's options."""
    stored = _settings(run["config"])
    return stored | stored.get("env", {})


def shared(run: Run) -> dict[str, str]:
    """What runs of one sample have in common: their settings, written out."""
    return {name: repr(x) for name, x in sorted(settings(run).items()) if name not in OF_A_SAMPLE | {"env"}}


def _mean_std(*mean_and_std: float | None) -> str:
    """As `mean±std`; some report no standard deviation. "-" if a seed broke, which has no score."""
    if mean_and_std[0] is None:
        return "-"
    digits = 2 if abs(mean_and_std[0]) >= 1 else 4
    return "±".join(f"{x:,.{digits}f}" for x in mean_and_std)


def has_pid(method: str, settings: Mapping[str, Any]) -> bool:
    """Whether a run's multiplier follows PID; the setting is there for methods without one, too."""
    return has_multiplier(method) and any(settings.get(gain) for gain in ("lambda_kp", "lambda_kd"))


def has_multiplier(method: str) -> bool:
    """Whether it is one of ours with a multiplier."""
    return method in METHODS and METHODS[method].constraint == "lagrangian"


def row_of(run: Run) -> TableRow:
    """A stored run as a row of a table, which tells a multiplier with PID from one without."""
    settings = "pid" if has_pid(run["method"], tomllib.loads(run.get("config", ""))) else ""
    scores = _scores(run)
    place = run["task"], run["method"], settings, _limits(run), max(run["steps"]), run["source"]
    return TableRow(*place, scores, excess=scores.get(BEYOND))


def _limits(run: Run) -> Limits:
    return Limits(tuple(run.get("limits", [run["cost_limit"]])))


def _scores(run: Run) -> dict[str, np.ndarray]:
    """{column: [seeds]} of a stored run's table, nan where a seed broke."""
    return {column: np.array(seeds, float) for column, seeds in run["table"].items()}


def as_mean_actions(file: pathlib.Path) -> str:
    """A line a run: seeds within, mean cost and interquartile mean reward, each of training episodes; of mean actions.

    Costs are the worst agent's where agents differ. Task and limit have a column if there are several.
    """
    found = sorted(load(file), key=lambda run: (run["task"], run["cost_limit"], place(run["method"])))
    about = [name for name in ("task", "cost_limit") if len({run[name] for run in found}) > 1]
    body = []
    for run in found:
        label = " ".join(word for word in run["label"].split() if not word.startswith("cost_limit="))
        line = [*(f"{run[name]:g}" if name == "cost_limit" else run[name] for name in about), label]
        row = row_of(run)
        of_mean, of_mean_reward = (row.scores[f"{OF_MEAN_ACTIONS}{name}"] for name in ("cost", "reward"))
        judged = f"{OF_MEAN_ACTIONS}{BEYOND}"
        beyond = row.scores[judged] if judged in row.scores else of_mean - run["cost_limit"]
        within = f"{(row.beyond <= 0).sum()}; {(beyond <= 0).sum()} of {beyond.size}"
        cost = f"{row.score('worst agent').mean():.2f}; {of_mean.mean():.2f}"
        reward = f"{iqm(row.scores['reward']):,.4g}; {iqm(of_mean_reward):,.4g}"
        body.append([*line, within, cost, reward])
    measured = [f"{name}: noise; mean actions" for name in ("seeds within", "cost", "reward")]
    return markdown((*(name.removeprefix("cost_") for name in about), "method", *measured), body)


KINDS: dict[str, Callable[[pathlib.Path], str]] = {
    "mean_actions": as_mean_actions,
    "paper": as_paper,
    "summary": as_summary,
    "overview": as_overview,
    "printed": as_printed,
}
