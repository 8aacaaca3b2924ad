"""Draws reward against cost at the end of training, a dot a seed, from bench/results.

python -m docs.figures.tradeoff    docs/tradeoff.png of the README's tasks, docs/toys.png of the toys
"""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench import records
from bench.tables import runs
from pmt_jax import load_config
from pmt_jax.studies.plot import INK, METHOD_COLOURS, cost_ticks

from . import style

DOCS = pathlib.Path(__file__).parents[1]
FIGURES = {
    "tradeoff": ("table1_ant_2x4_h200", "recipe_ant_4x2_h200", "table2_h200", "table3_voltage_33"),  # the README's
    "toys": ("toys",),
}


def _by_task(files: tuple[str, ...]) -> dict[str, list[runs.Run]]:
    """The runs with each method's own settings, by task."""
    found = [run for name in files for run in runs.load(records.RESULTS / f"{name}.json")]
    usual = [run for run in found if _is_usual(run)]
    return {task: [run for run in usual if run["task"] == task] for task in dict.fromkeys(r["task"] for r in usual)}


def _is_usual(run: runs.Run) -> bool:
    """Whether what sets the run apart from others in its file is its method's default."""
    config = load_config(run["task"], method=run["method"])
    apart = (word.split("=") for word in run.get("label", run["method"]).split()[1:])
    return all(str(getattr(config, name, None)) == value for name, value in apart)


def draw(files: tuple[str, ...], file: pathlib.Path) -> None:
    """One panel a task: the seeds of each method, their mean with its name, and the limit."""
    tasks = _by_task(files)
    with rc_context(style.FONT):
        figure = Figure(figsize=(3.4 * len(tasks), 3.9), layout="constrained")
        panels = figure.subplots(1, len(tasks), squeeze=False)[0]
        for panel, (task, found) in zip(panels, tasks.items(), strict=True):
            _panel(panel, found)
            panel.set_title(task, loc="left", fontsize=12, fontweight="bold")
            panel.set_xlabel("cost of an episode")
        panels[0].set_ylabel("reward of an episode")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=7, frameon=False, handletextpad=0.1)
        figure.savefig(file, dpi=110)


def _panel(panel: Any, found: list[runs.Run]) -> None:
    limit = found[0]["cost_limit"]
    for run in found:
        colour, scores = METHOD_COLOURS[run["method"]], run["table"]
        panel.scatter(scores["cost"], scores["reward"], color=colour, s=18, alpha=0.5, lw=0)
        mean = np.mean(scores["cost"]), np.mean(scores["reward"])
        panel.scatter(*mean, color=colour, s=80, edgecolor="white", lw=1, zorder=3, label=style.NAMES[run["method"]])
    top = max(max(run["table"]["cost"]) for run in found)
    panel.set_xscale("symlog", linthresh=limit)
    panel.set_xticks(ticks := cost_ticks(limit, top), [f"{tick:g}" for tick in ticks])
    panel.set_xticks([], minor=True)
    panel.set_xlim(-0.06 * limit, 1.2 * max(top, limit))
    panel.axvline(limit, color=INK, ls="--", lw=1.2)
    panel.text(limit, 1.0, f"limit {limit:g} ", transform=panel.get_xaxis_transform(), color=INK, ha="right", va="top")


if __name__ == "__main__":
    for name, files in FIGURES.items():
        draw(files, DOCS / f"{name}.png")
        print(f"docs/{name}.png")
