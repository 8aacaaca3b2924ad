"""Draws the harm done while training, a dot a seed: python -m docs.figures.harm makes docs/harm_by_task.png."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from bench import records
from bench.tables import study
from pmt_jax.studies.plot import METHOD_COLOURS

from . import style

FILE = pathlib.Path(__file__).parents[1] / "harm_by_task.png"
RESULT = records.RESULTS / "fear_h200+fear_voltage_33.json"
APART = 0.17  # of the two methods' rows from the middle of a task's


def draw() -> None:
    """A row a task, from the least harm to the most, on a logarithmic axis: MAPPO-L above, F4SG below."""
    found = sorted(study.pairs(RESULT), key=lambda pair: -_harm(pair[0]).mean())
    with rc_context(style.FONT):
        figure = Figure(figsize=(10, 4.2), layout="constrained")
        axis = figure.subplots()
        for row, pair in enumerate(found):
            for run, above in zip(pair, (APART, -APART), strict=True):
                _seeds(axis, run, row + above, named=row == 0)
        names = [name.replace("`", "").removeprefix("velocity_") for name in study.line_names(found)]
        axis.set_yticks(range(len(found)), names)
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter(ScalarFormatter())
        axis.set_xlabel("costly steps of 1,000 while training, noticed or not")
        axis.set_title("Harm while learning, a costly step in 33 noticed", loc="left", fontsize=12, fontweight="bold")
        figure.legend(loc="outside right upper", frameon=False, handletextpad=0.1)
        figure.savefig(FILE, dpi=110)


def _harm(run: Any) -> study.Scores:
    return study.measures(run)["training"]


def _seeds(axis: Any, run: Any, height: float, named: bool) -> None:
    """The seeds of a method on a task, and their mean."""
    harm, colour = _harm(run), METHOD_COLOURS[run["method"]]
    axis.scatter(harm, np.full(len(harm), height), color=colour, s=22, alpha=0.45, lw=0)
    label = style.NAMES[run["method"]] if named else None
    axis.scatter(harm.mean(), height, color=colour, s=110, edgecolor="white", lw=1.2, zorder=3, label=label)


if __name__ == "__main__":
    draw()
    print(f"docs/{FILE.name}")
