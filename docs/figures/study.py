"""Draws docs/study.png, true cost and reward at the end against how seldom harm is observed, and docs/study_curves.png,
the same over training at p = 0.03; from bench/results.

python -m docs.figures.study
"""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench import records
from bench.tables import runs, study
from pmt_jax.studies.plot import INK, METHOD_COLOURS
from pmt_jax.studies.statistics import mean_interval

from . import style

DOCS = pathlib.Path(__file__).parents[1]
PANELS = {"end": "true cost of an episode", "reward": "reward of an episode"}
SHOWN = ("mappo_l", "f4sg", "r4sg", "mixed", "macpo")
# Where a method's name stands next to its last mark in either panel: points to the right and up, and its alignment.
PLACES = {
    "end": {"r4sg": (-4, 10, "right"), "mixed": (-6, -11, "right"), "macpo": (-9, 0, "right")},
    "reward": {"r4sg": (-8, -12, "right"), "mixed": (-9, 0, "right"), "macpo": (-9, 6, "right")},
}


def draw(found: list[runs.Run], file: pathlib.Path) -> None:
    """Two panels: means over seeds with 95 % intervals, one line a method; other starts of lambda are open marks."""
    with rc_context(style.FONT):
        figure = Figure(figsize=(10, 4.4), layout="constrained")
        for axis, (name, title) in zip(figure.subplots(1, 2), PANELS.items(), strict=True):
            for method in SHOWN:
                _line(axis, [run for run in found if run["method"] == method], name)
            axis.set_title(title, loc="left", fontsize=12, fontweight="bold")
            axis.set(xscale="log", xlabel="probability that a costly step is observed")
            axis.set_xticks([0.01, 0.03, 0.1, 1], ["0.01", "0.03", "0.1", "1"])
            axis.set_xlim(1.25, 0.0045)
            if name == "end":
                axis.set(yscale="log")
                axis.set_yticks([3, 10, 30, 100], ["3", "10", "30", "100"])
                axis.axhline(10, color=INK, lw=1.2, ls="--")
                axis.text(0.36, 10.2, "limit 10", color=INK, fontsize=9, va="bottom")
        seeds = len(found[0]["seeds"])
        figure.suptitle(
            f"ant_2x4 at the end: mean of {seeds} seeds, bars: 95 % interval", x=0.01, ha="left", fontsize=11
        )
        figure.savefig(file, dpi=110)


def _line(axis: Any, cells: list[runs.Run], name: str) -> None:
    """One method's cells with its name; of MAPPO-Lagrangian those with another start of lambda by themselves."""
    cells = sorted(cells, key=lambda run: -study.share(run))
    method = cells[0]["method"]
    colour = METHOD_COLOURS[method]
    usual = [run for run in cells if study.settings(run)["lambda_init"] == 2]
    aside = 1.05 ** (SHOWN.index(method) - 2)  # so that intervals do not hide each other
    for group, marker in ((usual, "o"), ([cell for cell in cells if cell not in usual], "s")):
        shares = [study.share(run) * aside for run in group]
        scores = [study.measures(run)[name] for run in group]
        middle = np.array([x.mean() for x in scores])
        ends = np.array([mean_interval(x) for x in scores]).reshape(-1, 2).T
        axis.errorbar(
            shares,
            middle,
            np.abs(ends - middle) if len(group) else None,
            color=colour,
            marker=marker,
            markersize=6,
            markerfacecolor="none" if marker == "s" else None,
            linestyle="-" if marker == "o" else "none",
            lw=2,
            capsize=2,
        )
        for run, x, y in zip(group, shares, middle, strict=True):
            if marker == "s":
                text = f"multiplier from {study.settings(run)['lambda_init']:g}"
                axis.annotate(text, (x, y), (9, 0), textcoords="offset points", color=colour, va="center", fontsize=8)
            elif run is group[-1]:
                *xytext, side = PLACES[name].get(method, (9, 0, "left"))
                text = style.NAMES[method]
                at = {"textcoords": "offset points", "ha": side, "va": "center"}
                axis.annotate(text, (x, y), xytext, color=colour, fontweight="bold", **at)


CURVES = {"true_episode_cost": PANELS["end"], "episode_reward": PANELS["reward"]}


def draw_curves(found: list[runs.Run], file: pathlib.Path, seen: float = 0.03) -> None:
    """Two panels of the cells of one p, lambda from 2: means over seeds while training, bands of one deviation."""
    cells = [run for run in found if study.share(run) == seen and study.settings(run)["lambda_init"] == 2]
    with rc_context(style.FONT):
        figure = Figure(figsize=(10, 4.4), layout="constrained")
        for axis, (name, title) in zip(figure.subplots(1, 2), CURVES.items(), strict=True):
            ends = [_curve(axis, run, name) for run in cells]
            style.over_steps(axis, title, max(run["steps"][-1] for run in cells))
            if name == "true_episode_cost":
                axis.set(yscale="log", ylim=(3, 500))
                axis.set_yticks([3, 10, 30, 100, 300], ["3", "10", "30", "100", "300"])
                axis.axhline(10, color=INK, lw=1.2, ls="--")
                style.name_limit(axis, 10)
            style.label_lines(axis, ends)
        seeds, share = len(cells[0]["seeds"]), f"a costly step is observed with probability {seen:g}"
        title = f"ant_2x4, {share}: mean of {seeds} seeds, band: standard deviation"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        figure.savefig(file, dpi=110)


def _curve(axis: Any, run: runs.Run, name: str) -> tuple[str, float]:
    """Draws a cell's mean over seeds and its band; returns the method and where the line ends."""
    steps, values = np.array(run["steps"]), np.array(run[name], float)
    known = np.isfinite(values).all(0)
    mean, spread = values[:, known].mean(0), values[:, known].std(0, ddof=1)
    colour = METHOD_COLOURS[run["method"]]
    axis.plot(steps[known], mean, color=colour, lw=2)
    axis.fill_between(steps[known], np.maximum(mean - spread, 0.0), mean + spread, color=colour, alpha=0.15, lw=0)
    return run["method"], float(mean[-1])


if __name__ == "__main__":
    cells = runs.load(records.RESULTS / "study_ant_2x4_h200.json")
    draw(cells, DOCS / "study.png")
    draw_curves(cells, DOCS / "study_curves.png")
    print("docs/study.png and docs/study_curves.png")
