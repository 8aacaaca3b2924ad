"""`pmt plot`: training curves, pooled over runs that differ in nothing but their seeds."""

from __future__ import annotations

import io
import math
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import UsageError
from ..files import Note, writing
from ..limits import WORST
from ..tasks import columns
from .rows import in_order, same
from .run_log import Group, RunLog, groups, read_all

POINTS = 100  # of a curve
TRAINING = {
    "episode_reward": "reward of an episode",
    "episode_cost": "cost of an episode (dashed: limit)",
    f"episode_cost{WORST}": "cost of the worst agent (dashed: limit)",
    "violation_rate": "share of steps with a cost",
    "lambda": "multiplier",
    "true_episode_cost": "true cost of an episode (dashed: limit)",
    f"true_episode_cost{WORST}": "true cost of the worst agent (dashed: limit)",
    "true_violation_rate": "share of steps with a true cost",
    "true_step_cost": "true cost of a step",
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
COSTS = tuple(name for name in TRAINING if "episode_cost" in name)

# Okabe and Ito's colours, which the colour-blind tell apart, on white and on black; one for each method, everywhere.
BLUE, RED, GREEN, ORANGE = "#0072b2", "#d55e00", "#009e73", "#e69f00"
PURPLE, SKY, GREY = "#cc79a7", "#56b4e9", "#7f7f7f"
METHOD_COLOURS = {
    "mappo": GREY,
    "happo": SKY,
    "mappo_l": BLUE,
    "macpo": PURPLE,
    "f4sg": RED,
    "r4sg": GREEN,
    "mixed": ORANGE,
    # Methods that are not the paper's have shades of the same.
    "ippo": "#b3b3b3",
    "ippo_l": "#003f63",
    "mappo_pid": "#66c2e8",
    "crpo": "#8c4a75",
    "p3o": "#8a3d00",
    "focops": "#00553d",
    "f4sg_letter": "#f2a477",
    "r4sg_letter": "#73c9b0",
}
OTHER_COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY, GREY)  # of settings of one method, of methods not in METHODS
DASHES = ("", "6 2", "1.5 2", "6 2 1.5 2")  # in line widths, as SVG has them
MOST_BANDS = 3  # curves in a panel; more are lines, with the spread over seeds next to them
ENDINGS = (".png", ".svg", ".pdf")
INK = "#808182"  # stands for the reader's own text colour in pictures inside pages


class Look(NamedTuple):
    """How a curve is drawn: its colour, and its dashes in line widths (none for a solid line)."""

    colour: str
    dashes: str = ""


def plot(folders: Sequence[pathlib.Path], out: pathlib.Path, note: Note | None = None) -> None:
    """Draws the curves of run folders into `out` (.png, .svg or .pdf): a row of panels a task, a colour a method.

    Args:
      note: called with a sentence for each folder that is left out.

    Raises:
      UsageError: a folder that cannot be read, no run at all, another ending, or `out` that cannot be written.
    """
    check_ending(out)
    draw(pooled(read_all(folders, note), note), out)


def check_ending(out: pathlib.Path) -> None:
    """Raises UsageError if `out` is not a picture."""
    if out.suffix not in ENDINGS:
        raise UsageError(f"cannot write {out}: its ending must be .png, .svg or .pdf")


def pooled(logs: Sequence[RunLog], note: Note | None = None) -> list[Group]:
    """Runs that are the same up to seeds, as METHODS is, their curves averaged into at most POINTS points."""
    return in_order(groups([log.thinned(POINTS) for log in logs], note or print))


def looks(shown: Sequence[Group]) -> list[Look]:
    """A method has its colour and its settings have dashes; if there is only one method, settings have colours."""
    methods = list(dict.fromkeys(group.method for group in shown))
    result, seen = [], dict.fromkeys(methods, 0)
    for number, group in enumerate(shown):
        place = number if len(methods) == 1 and len(shown) > 1 else seen[group.method]
        if len(methods) == 1 and len(shown) > 1:
            result.append(Look(OTHER_COLOURS[place % len(OTHER_COLOURS)], DASHES[place // len(OTHER_COLOURS) % 4]))
        else:
            other = OTHER_COLOURS[methods.index(group.method) % len(OTHER_COLOURS)]
            result.append(Look(METHOD_COLOURS.get(group.method, other), DASHES[place % len(DASHES)]))
        seen[group.method] += 1
    return result


def label(group: Group) -> str:
    """A curve's name in a legend."""
    count = len(group.seeds)
    return f"{group.label} ({count} seed{'s' * (count != 1)})"


def caption(shown: Sequence[Group]) -> str:
    """What lines and bands mean."""
    if all(len(group.seeds) == 1 for group in shown):
        return "one seed a line"
    if len(shown) <= MOST_BANDS:
        return "mean of the seeds, band from the lowest to the highest"
    return "mean of the seeds; bars on the right reach from the lowest to the highest seed at the end"


def panels(shown: Sequence[Group], wanted: dict[str, str]) -> list[str]:
    """The metrics among `wanted` that any run has; true costs only if a run did not observe all of them."""

    def known(name: str) -> bool:
        return any(np.isfinite(run.metrics.get(name, np.nan)).any() for group in shown for run in group.runs)

    runs = [run for group in shown for run in group.runs]
    observed = all(same(run.metrics.get("true_violation_rate"), run.metrics.get("violation_rate")) for run in runs)
    return [name for name in wanted if known(name) and not (observed and name.startswith("true_"))]


def titles(shown: Sequence[Group]) -> dict[str, str]:
    """What can be drawn of training, by metric: what all tasks have, and what these declare."""
    declared = {name: c for task in {g.task for g in shown} for name, c in columns(task).items()}
    return TRAINING | {f"info/{name}": f"{c.name}: {c.definition.split(';')[0]}" for name, c in declared.items()}


def curve(group: Group, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The steps [P] of a group's longest run and a metric [S, P] there, straight lines between what is known."""
    steps = max((run.steps for run in group.runs), key=lambda steps: steps[-1])
    return steps, np.concatenate([_at_steps(run, name, steps) for run in group.runs])


def _at_steps(run: RunLog, name: str, steps: np.ndarray) -> np.ndarray:
    """[S, P] a run's metric at other steps; nan outside of what is known."""
    values = run.metrics.get(name, np.full((len(run.seeds), len(run.steps)), np.nan))
    if np.array_equal(run.steps, steps):
        return values
    result = np.full((len(values), len(steps)), np.nan)
    for row, one in zip(result, values, strict=True):
        known = np.isfinite(one)
        if known.any():
            row[:] = np.interp(steps, run.steps[known], one[known], left=np.nan, right=np.nan)
    return result


# ---------------------------------------------------------------------------------------------------------------------
# Drawing


def draw(shown: Sequence[Group], out: pathlib.Path) -> None:
    """Like `plot`, of runs already pooled."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    tasks = {task: [g for g in shown if g.task == task] for task in dict.fromkeys(g.task for g in shown)}
    for task, runs in tasks.items():
        if not panels(runs, titles(runs) | EMOTIONS):
            raise UsageError(f"there is nothing to draw of {task}: no metric of its runs is a finite number anywhere")
    sizes = [_size(groups) for groups in tasks.values()]
    wide = max(width for width, _ in sizes)
    with rc_context({"font.size": 9, "svg.fonttype": "none", "text.parse_math": False}), writing(out) as partial:
        figure = Figure(figsize=(wide, sum(height for _, height in sizes)), layout="constrained")
        parts = figure.subfigures(len(tasks), 1, squeeze=False, height_ratios=[height for _, height in sizes])[:, 0]
        for part, (task, groups) in zip(parts, tasks.items(), strict=True):
            _task_panels(part, task, groups, wide)
        figure.savefig(partial, dpi=110, format=out.suffix[1:])


def _size(shown: Sequence[Group]) -> tuple[float, float]:
    """Width and height in inches of a task's panels and legend."""
    count = len(panels(shown, titles(shown) | EMOTIONS))
    entry = _entry(shown)
    wide = max(3.1 * min(4, count), entry)
    return wide, 2.5 * -(-count // 4) + 0.4 + 0.16 * (len(shown) - 1) // min(4, int(wide / entry))


def _entry(shown: Sequence[Group]) -> float:
    """Width of the longest name in the legend, inches."""
    return 1 + 0.065 * max(len(label(group)) for group in shown)


def _task_panels(part: Any, task: str, shown: Sequence[Group], wide: float) -> None:
    wanted = titles(shown) | EMOTIONS
    names = panels(shown, wanted)
    across = min(4, len(names))
    axes = part.subplots(-(-len(names) // across), across, squeeze=False).ravel()
    for axis, name in zip(axes, names, strict=False):
        _panel(axis, shown, name, wanted[name])
    for axis in axes[len(names) :]:
        axis.set_axis_off()
    part.suptitle(f"{task}: {caption(shown)}", fontsize=9)
    handles = axes[0].get_legend_handles_labels()
    entries = max(1, min(4, int(wide / _entry(shown))))
    part.legend(*handles, loc="outside lower center", ncols=entries, frameon=False, fontsize=8)


def _panel(axis: Any, shown: Sequence[Group], name: str, title: str) -> None:
    """One metric of runs of one task over environment steps."""
    from matplotlib.ticker import EngFormatter

    end = max(int(run.steps[-1]) for group in shown for run in group.runs)
    banded = len(shown) <= MOST_BANDS
    for number, (group, look) in enumerate(zip(shown, looks(shown), strict=True)):
        steps, values = curve(group, name)
        known = np.isfinite(values).any(0)
        low, mid, high = (f(values[:, known], axis=0) for f in (np.nanmin, np.nanmean, np.nanmax))
        style = (0, tuple(map(float, look.dashes.split()))) if look.dashes else "-"
        axis.plot(steps[known], mid, lw=1.5, label=label(group), color=look.colour, ls=style)
        if len(values) > 1 and banded:
            axis.fill_between(steps[known], low, high, alpha=0.18, color=look.colour, lw=0)
        elif len(values) > 1:
            _spread(axis, end * (1.04 + 0.025 * number), values, look.colour)
    if name in COSTS:
        cost_axis(axis, shown, name)
    axis.set_title(title, fontsize=9)
    axis.set_xlabel("environment steps of a seed", fontsize=8)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.set_xticks([tick for tick in axis.get_xticks() if 0 <= tick <= 1.01 * end])
    axis.grid(alpha=0.18, lw=0.6)
    axis.spines[["top", "right"]].set_visible(False)


def _spread(axis: Any, x: float, values: np.ndarray, colour: str) -> None:
    """The seeds' means over the last tenth of a curve: a bar from the lowest to the highest, a dot at the mean."""
    last = values[:, -max(1, values.shape[1] // 10) :]
    seeds = np.array([row[np.isfinite(row)].mean() for row in last if np.isfinite(row).any()])
    if seeds.size:
        axis.plot([x, x], [seeds.min(), seeds.max()], color=colour, lw=2.2, solid_capstyle="butt")
        axis.plot([x], [seeds.mean()], color=colour, marker="o", ms=3.5, ls="")


def cost_axis(axis: Any, shown: Sequence[Group], name: str) -> None:
    """The limit as a dashed line; linear up to it, logarithmic beyond if costs are many times as high."""
    from matplotlib.ticker import FixedLocator, NullLocator

    limits = sorted({on.total for group in shown if (on := group.runs[0].limits_on(name))})
    for limit in limits:
        axis.axhline(limit, color=INK, ls="--", lw=1)
    top = max(np.nanmax(curve(group, name)[1], initial=0.0) for group in shown)
    bend = max(limits, default=0.0) or 1.0
    if top > 4 * bend:
        ticks = cost_ticks(bend, top)
        axis.set_yscale("symlog", linthresh=bend)
        axis.yaxis.set_major_locator(FixedLocator(ticks))
        axis.yaxis.set_minor_locator(NullLocator())
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_ylabel("linear up to the limit,\nlogarithmic beyond", fontsize=7)
        axis.set_ylim(top=max(top, ticks[-1]) * 1.1)
    axis.set_ylim(bottom=0)


def cost_ticks(bend: float, top: float) -> list[float]:
    """Ticks of an axis that is linear up to `bend`, then logarithmic up to `top`: 0, half, bend, 1, 2, 5, 10 ..."""
    first, last = math.floor(math.log10(bend)), math.ceil(math.log10(top))
    steps = [digit * 10.0**power for power in range(first, last + 1) for digit in (1, 2, 5)]
    beyond = [tick for tick in steps if 1.5 * bend < tick <= 1.2 * top]
    sparse = beyond if len(beyond) <= 5 else [tick for tick in beyond if f"{tick:e}".startswith("1")]
    return [0, bend / 2, bend, *sparse]


def inline(shown: Sequence[Group], name: str, title: str) -> str:
    """A panel as SVG for a page, in the reader's own text colour."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    inks = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color", "grid.color")
    style: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": f"{shown[0].task} {name}", "font.size": 10}
    style["text.parse_math"] = False  # a $ in a name is a $
    with rc_context(dict.fromkeys(inks, INK) | style):
        figure = Figure(figsize=(3.6, 2.5), layout="constrained", facecolor="none")
        axis = figure.subplots()
        axis.set_facecolor("none")
        _panel(axis, shown, name, title)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :].replace(INK, "currentColor")
