"""`pmt plot`: training curves of runs, pooled over runs that differ in nothing but their seeds."""

from __future__ import annotations

import dataclasses
import io
import math
import pathlib
import tomllib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..config.settings import Config
from ..errors import UsageError, optional
from ..files import read_rows, writing
from .table import SAME_IN_A_ROW, plain

POINTS = 100  # of a curve
PANELS = {
    "episode_reward": "reward of an episode",
    "episode_cost": "cost of an episode (dashed: limit)",
    "violation_rate": "share of steps with a cost",
    "lambda": "multiplier",
}
EMOTIONS = {
    "fear/brier": "fear: Brier score (0 is perfect)",
    "fear/ece": "fear: calibration error",
    "fear/on_costly": "fear of steps that cost",
    "fear/on_safe": "fear of steps that do not",
    "regret/on_costly": "regret at steps that cost",
    "regret/on_safe": "regret at safe steps, were they costly",
    "regret/weight_mean": "regret: mean weight of a ratio",
    "regret/weight_std": "regret: spread of the weights",
}
COLOURS = ("#2f7fb5", "#e0861a", "#2f9e77", "#c8503f", "#8d6bb8", "#9a7b4f", "#d264a8", "#7f8a91")
SEEDS_AND_LENGTH = (*SAME_IN_A_ROW, "steps", "num_updates")  # settings in which repetitions of a run may differ
IDENTITY = {"step", "seed", "task", "method", "cost_limit"}  # what every row of a run says of itself
ENDINGS = (".png", ".svg", ".pdf")
INK = "#808182"  # stands for the reader's own text colour in pictures inside pages


@dataclasses.dataclass(frozen=True)
class Curves:
    """The figures of one run, or of several that differ in nothing but seeds.

    Attributes:
      names: of the run folders.
      task, method, cost_limit: what was trained, and the limit on an episode's cost.
      settings: {setting: value}, the options of the task as env.NAME.
      seeds: [S].
      steps: [P] environment steps of one seed.
      figures: {name: [S, P]}, nan where unknown.
      seconds: the longest wall time, s.
    """

    names: tuple[str, ...]
    task: str
    method: str
    cost_limit: float
    settings: dict[str, Any]
    seeds: tuple[int, ...]
    steps: np.ndarray
    figures: dict[str, np.ndarray]
    seconds: float


def read(folder: pathlib.Path, names: Iterable[str] = (*PANELS, *EMOTIONS)) -> Curves:
    """The figures `names` of a run folder, as far as it has them, averaged into at most POINTS points.

    Lines cut off in the middle are left out; where a step stands twice, the later line counts.

    Raises:
      UsageError: the folder has no metrics.jsonl, or nothing in it yet.
    """
    rows = _rows(folder)
    if not rows:
        raise UsageError(f"{folder} has no figures yet: its metrics.jsonl is empty; wait for the first chunk")
    last = rows[max(rows)]
    steps = np.array(sorted({step for step, _ in rows}))
    seeds = tuple(sorted({seed for _, seed in rows}))
    groups = np.array_split(np.arange(len(steps)), min(POINTS, len(steps)))
    table = [[rows.get((step, seed), {}) for step in steps.tolist()] for seed in seeds]
    figures = {}
    for name in names:
        if any(name in row for row in rows.values()):
            values = np.array([[_number(row.get(name)) for row in one] for one in table])
            figures[name] = _averaged(values, groups)
    return Curves(
        names=(folder.name,),
        task=last["task"],
        method=last["method"],
        cost_limit=last["cost_limit"],
        settings=_settings(folder),
        seeds=seeds,
        steps=np.array([steps[group[-1]] for group in groups]),
        figures=figures,
        seconds=max(_number(row.get("seconds")) for row in rows.values()),
    )


def _rows(folder: pathlib.Path) -> dict[tuple[int, int], dict[str, Any]]:
    """{(step, seed): row} of a metrics.jsonl."""
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a run folder: there is no such folder")
    try:
        rows = read_rows(folder / "metrics.jsonl", missing_ok=False)
    except OSError as error:
        raise UsageError(
            f"{folder} has no figures to draw: cannot read its metrics.jsonl ({error.strerror})"
        ) from error
    return {(row["step"], row["seed"]): row for row in rows if IDENTITY <= row.keys()}


def _number(x: Any) -> float:
    return float(x) if isinstance(x, int | float) else math.nan


def _averaged(values: np.ndarray, groups: list[np.ndarray]) -> np.ndarray:
    """[S, groups] means over what is known in each group of columns of `values` [S, R]."""
    known = np.isfinite(values)
    starts = [group[0] for group in groups]
    count = np.add.reduceat(known, starts, axis=1, dtype=int)
    total = np.add.reduceat(np.where(known, values, 0.0), starts, axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _settings(folder: pathlib.Path) -> dict[str, Any]:
    try:
        settings = tomllib.loads((folder / "config.toml").read_text())
    except (OSError, tomllib.TOMLDecodeError):
        return {}
    options = settings.pop("env", {})
    return settings | {f"env.{name}": value for name, value in options.items()}


def pool(runs: Sequence[Curves]) -> list[Curves]:
    """Joins runs that differ in nothing but their seeds and length; shorter ones are nan beyond their end."""
    alike: dict[str, list[Curves]] = {}
    for run in runs:
        varied = {name: x for name, x in run.settings.items() if name not in SEEDS_AND_LENGTH}
        alike.setdefault(repr((run.task, run.method, run.cost_limit, varied or run.names)), []).append(run)
    return [_joined(group) for group in alike.values()]


def _joined(runs: list[Curves]) -> Curves:
    steps = max((run.steps for run in runs), key=lambda steps: steps[-1])
    names = sorted({name for run in runs for name in run.figures})
    return dataclasses.replace(
        runs[0],
        names=tuple(name for run in runs for name in run.names),
        seeds=tuple(seed for run in runs for seed in run.seeds),
        steps=steps,
        figures={name: np.concatenate([_at_steps(run, name, steps) for run in runs]) for name in names},
        seconds=max(run.seconds for run in runs),
    )


def _at_steps(run: Curves, name: str, steps: np.ndarray) -> np.ndarray:
    """[S, P] a figure at other steps, straight lines between what is known; nan outside of it."""
    values = run.figures.get(name, np.full((len(run.seeds), len(run.steps)), np.nan))
    if np.array_equal(run.steps, steps):
        return values
    result = np.full((len(values), len(steps)), np.nan)
    for row, one in zip(result, values, strict=True):
        known = np.isfinite(one)
        if known.any():
            row[:] = np.interp(steps, run.steps[known], one[known], left=np.nan, right=np.nan)
    return result


def labels(runs: Sequence[Curves]) -> list[str]:
    """What tells each run from the others of its task: the method, and settings that others of it have otherwise."""

    def value(run: Curves, name: str) -> str:  # a run of before a setting came to be has its default
        return plain(run.settings.get(name, getattr(Config, name, "default")))

    result = []
    for run in runs:
        alike = [other for other in runs if (other.task, other.method) == (run.task, run.method)]
        names = {name for other in alike for name in other.settings} - set(SEEDS_AND_LENGTH)
        varied = [name for name in sorted(names) if len({value(other, name) for other in alike}) > 1]
        words = [f"{name} = {value(run, name)}" for name in varied]
        if len(alike) > 1 and not words:
            words = [", ".join(run.names)]
        result.append(", ".join([run.method, *words]))
    return result


def plot(folders: Sequence[pathlib.Path], out: pathlib.Path) -> None:
    """Draws the curves of run folders into `out` (.png, .svg or .pdf): a row of panels a task, a colour a method.

    Raises:
      UsageError: a folder without figures, another ending, matplotlib missing, or `out` that cannot be written.
    """
    if out.suffix not in ENDINGS:
        raise UsageError(f"cannot write {out}: its ending must be .png, .svg or .pdf")
    optional("matplotlib", "render")
    draw(pool([read(folder) for folder in folders]), out)


def draw(runs: Sequence[Curves], out: pathlib.Path) -> None:
    """Like `plot`, of runs already read."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    tasks = list(dict.fromkeys(run.task for run in runs))
    names = panels(runs, PANELS | EMOTIONS)
    columns = min(4, len(names))
    deep = -(-len(names) // columns)
    named = [labels([run for run in runs if run.task == task]) for task in tasks]
    entry = 1 + 0.065 * max(len(label) for task in named for label in task)  # inches, at the legend's size of letters
    wide = max(3.1 * columns, entry)
    legend_columns = min(4, int(wide / entry))
    high = 2.5 * deep + 0.16 * (max(map(len, named)) // legend_columns)
    with rc_context({"font.size": 9, "svg.fonttype": "none"}), writing(out) as partial:
        figure = Figure(figsize=(wide, high * len(tasks) + 0.4), layout="constrained")
        rows = figure.subfigures(len(tasks), 1, squeeze=False)[:, 0]
        for row, task in zip(rows, tasks, strict=True):
            chosen = [run for run in runs if run.task == task]
            axes = row.subplots(deep, columns, squeeze=False).ravel()
            for axis, name in zip(axes, names, strict=False):
                _panel(axis, chosen, name)
            for axis in axes[len(names) :]:
                axis.set_axis_off()
            row.suptitle(f"{task}: mean of the seeds, band from lowest to highest", fontsize=9)
            handles = axes[0].get_legend_handles_labels()
            row.legend(*handles, loc="outside lower center", ncols=legend_columns, frameon=False, fontsize=8)
        figure.savefig(partial, dpi=110, format=out.suffix[1:])


def panels(runs: Sequence[Curves], wanted: dict[str, str]) -> list[str]:
    """The figures that any run knows; the cost's also where no episode has ended yet."""
    return [name for name in wanted if any(np.isfinite(run.figures.get(name, np.nan)).any() for run in runs)]


def _panel(axis: Any, runs: Sequence[Curves], name: str) -> None:
    """One figure of runs of one task over environment steps."""
    from matplotlib.ticker import EngFormatter

    for i, (run, label) in enumerate(zip(runs, labels(runs), strict=True)):
        values = run.figures.get(name, np.full((1, len(run.steps)), np.nan))
        known = np.isfinite(values).any(0)
        low, mid, high = (f(values[:, known], axis=0) for f in (np.nanmin, np.nanmean, np.nanmax))
        look = {"color": COLOURS[i % len(COLOURS)], "ls": ("-", "--", ":", "-.")[i // len(COLOURS) % 4]}
        seeds = f"{len(run.seeds)} seed{'s' * (len(run.seeds) != 1)}"
        axis.plot(run.steps[known], mid, lw=1.4, label=f"{label} ({seeds})", **look)
        if len(values) > 1:
            axis.fill_between(run.steps[known], low, high, alpha=0.18, color=look["color"], lw=0)
    if name == "episode_cost":
        limit = runs[0].cost_limit
        axis.axhline(limit, color=INK, ls="--", lw=1)
        axis.set_yscale("symlog", linthresh=max(limit, 1.0))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_ylim(bottom=0)
    axis.set_title((PANELS | EMOTIONS)[name], fontsize=9)
    axis.set_xlabel("environment steps of a seed", fontsize=8)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.grid(alpha=0.25, lw=0.6)
    axis.spines[["top", "right"]].set_visible(False)


def inline(runs: Sequence[Curves], name: str) -> str:
    """A panel as SVG for a page, in the reader's own text colour."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    inks = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color", "grid.color")
    style: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": f"{runs[0].task} {name}", "font.size": 10}
    with rc_context(dict.fromkeys(inks, INK) | style):
        figure = Figure(figsize=(3.6, 2.5), layout="constrained", facecolor="none")
        axis = figure.subplots()
        axis.set_facecolor("none")
        _panel(axis, runs, name)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :].replace(INK, "currentColor")
