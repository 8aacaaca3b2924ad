"""Draws docs/study.png: true cost and reward at the end against how seldom harm is felt, from bench/results.

python -m docs.figures.study
"""

from __future__ import annotations

import pathlib

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench import records, runs, study
from pmt_jax.studies.plot import METHOD_COLOURS
from pmt_jax.studies.statistics import mean_interval

DOCS = pathlib.Path(__file__).parents[1]
PANELS = {"end": "true cost of an episode at the end", "reward": "reward of an episode at the end"}


def draw(found: list[runs.Run], file: pathlib.Path) -> None:
    """Two panels: means over seeds with 95 % intervals, one line a method; other starts of lambda are open marks."""
    figure = Figure(figsize=(9.5, 3.9), layout="constrained")
    for axis, (name, title) in zip(figure.subplots(1, 2), PANELS.items(), strict=True):
        for method in ("mappo_l", "f4sg", "r4sg", "mixed", "macpo"):
            _line(axis, [run for run in found if run["method"] == method], name)
        axis.set(xscale="log", xlabel="share of costly steps that are felt, p", title=title)
        axis.set_xticks([0.01, 0.03, 0.1, 1], ["0.01", "0.03", "0.1", "1"])
        axis.invert_xaxis()
        axis.spines[["top", "right"]].set_visible(False)
        if name == "end":
            axis.set(yscale="log")
            axis.set_yticks([3, 10, 30, 100], ["3", "10", "30", "100"])
            axis.axhline(10, color="#808182", linewidth=1, linestyle="--")
            axis.text(0.4, 8.6, "limit", color="#808182", fontsize=8)
        else:
            axis.legend(frameon=False, fontsize=8, loc="lower left")
    figure.savefig(file, dpi=140)


def _line(axis: Axes, cells: list[runs.Run], name: str) -> None:
    """One method's cells; of MAPPO-Lagrangian those with another start of lambda by themselves."""
    cells = sorted(cells, key=lambda run: runs.curves(run).settings["cost_seen"])
    method = cells[0]["method"]
    usual = [run for run in cells if runs.curves(run).settings["lambda_init"] == 2]
    for group, marker, label in ((usual, "o", study.NAMES[method]), ([c for c in cells if c not in usual], "s", None)):
        aside = 1.05 ** (list(study.NAMES).index(method) - 2)  # so that intervals do not hide each other
        shares = [runs.curves(run).settings["cost_seen"] * aside for run in group]
        scores = [study.measures(run)[name] for run in group]
        middle = np.array([x.mean() for x in scores])
        ends = np.array([mean_interval(x) for x in scores]).reshape(-1, 2).T
        errors = np.abs(ends - middle) if len(group) else None
        axis.errorbar(
            shares,
            middle,
            errors,
            color=METHOD_COLOURS[method],
            marker=marker,
            markersize=5,
            markerfacecolor="none" if marker == "s" else None,
            linestyle="-" if marker == "o" else "none",
            capsize=2,
            label=label,
        )
    for run, x in zip(cells, (study.measures(run)[name].mean() for run in cells), strict=True):
        settings = runs.curves(run).settings
        if settings["lambda_init"] != 2:
            text = f"lambda from {settings['lambda_init']:g}"
            axis.annotate(text, (settings["cost_seen"], x), xytext=(6, -3), textcoords="offset points", fontsize=7)


if __name__ == "__main__":
    draw(runs.load(records.RESULTS / "study_ant_2x4_h200.json"), DOCS / "study.png")
    print("docs/study.png")
