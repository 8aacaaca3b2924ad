"""Draws docs/NAME.png, two curves over training of the runs in a file of bench/results: reward and cost, or CR and PL.

python -m docs.figures.curves          all of them
python -m docs.figures.curves table2   some
"""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench import records
from bench.tables import runs
from pmt_jax.studies import plot
from pmt_jax.studies.run_log import Group

from . import style

DOCS = pathlib.Path(__file__).parents[1]
FIGURES = {  # the picture's result, and which of its tasks
    "table1_ant_2x4": ("table1_ant_2x4_h200", "ant_2x4"),
    "table2": ("table2_h200", "hand_over_2x6"),
    "table3_voltage_33": ("table3_voltage_33", "voltage_33"),
    "velocity_half_cheetah_2x3": ("velocity_recipe_h200", "velocity_half_cheetah_2x3"),
    "grid_33": ("table3_voltage_33", "voltage_33"),
    "harm": ("fear_h200", "ant_2x4"),
}
PANELS = {"episode_reward": "reward of an episode", "episode_cost": "cost of an episode"}
GRID_PANELS = {  # Fig. 3 of the paper
    "info/totally_controllable_ratio": "CR, share of steps in the band",
    "info/total_line_loss": "PL, power lost in lines (MW)",
}
HARM_PANELS = {"true_step_cost": "share of steps that cost, noticed or not", "episode_reward": "reward of an episode"}


def draw(shown: Sequence[Group], file: pathlib.Path, panels: Mapping[str, str] = PANELS) -> None:
    """Two panels of one task: the mean over seeds with the method's name next to it, and the seeds' range in a band."""
    with rc_context(style.FONT):
        figure = Figure(figsize=(10, 4.2), layout="constrained")
        for axis, (name, title) in zip(figure.subplots(1, 2), panels.items(), strict=True):
            last = max(int(run.steps[-1]) for group in shown for run in group.runs)
            ends = [
                _line(axis, group, name, last, banded=len(shown) <= plot.MOST_BANDS, pid=_pid_beside_none(group, shown))
                for group in shown
            ]
            style.over_steps(axis, title, last)
            if name == "episode_cost":
                plot.cost_axis(axis, shown, name)
                axis.set_ylabel("linear up to the limit, then log" if axis.get_yscale() == "symlog" else "")
                style.name_limit(axis, shown[0].runs[0].limits.total)
            style.label_lines(axis, ends)
        seeds = max(len(group.seeds) for group in shown)
        band = f"mean of {seeds} seeds" + (
            ", band from the lowest to the highest" if len(shown) <= plot.MOST_BANDS else ""
        )
        figure.suptitle(f"{shown[0].task}: {band}", x=0.01, ha="left", fontsize=11)
        figure.savefig(file, dpi=110)


def _pid_beside_none(group: Group, shown: Sequence[Group]) -> bool:
    """Whether its multiplier has PID and that of another group of the same method has not."""
    pid = {runs.has_pid(other.method, other.runs[0].settings) for other in shown if other.method == group.method}
    return len(pid) == 2 and runs.has_pid(group.method, group.runs[0].settings)


def _line(axis: Any, group: Group, name: str, last: int, banded: bool, pid: bool) -> tuple[str, float]:
    """Draws a method's mean over seeds, dotted to the `last` step if it stopped early; returns its name and end.

    With dashes if its multiplier has PID and the same method without has a line, too.
    """
    steps, values = plot.curve(group, name)
    known = np.isfinite(values).any(0)
    low, mean, high = (f(values[:, known], axis=0) for f in (np.nanmin, np.nanmean, np.nanmax))
    colour = plot.METHOD_COLOURS[group.method]
    axis.plot(steps[known], mean, color=colour, lw=2, ls="--" if pid else "-")
    if steps[known][-1] < 0.98 * last:
        axis.hlines(mean[-1], steps[known][-1], last, color=colour, lw=1, ls=":")
    if banded:
        axis.fill_between(steps[known], low, high, color=colour, alpha=0.18, lw=0)
    return f"{group.method} pid" if pid else group.method, float(mean[-1])


def main(names: list[str]) -> None:
    """Draws the pictures of these names, or all."""
    for name in names or FIGURES:
        result, task = FIGURES[name]
        found = [run for run in runs.load(records.RESULTS / f"{result}.json") if run["task"] == task]
        found = [run for run in found if run.get("label", run["method"]) == run["method"]]  # none with other settings
        panels = {"grid_33": GRID_PANELS, "harm": HARM_PANELS}.get(name, PANELS)
        draw(plot.pooled([runs.curves(run) for run in found]), DOCS / f"{name}.png", panels)
        print(f"docs/{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
