"""What all figures of the documents share: names and colours of methods, and labels that stand next to their lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import EngFormatter

from bench.tables import study
from pmt_jax.studies.plot import INK, METHOD_COLOURS

NAMES = {method: method.upper().replace("_L", "-L").replace("_", " ") for method in METHOD_COLOURS} | study.NAMES
NAMES |= {f"{method} pid": f"{name} PID" for method, name in NAMES.items()} | {"mappo_l pid": "PID"}
DANGER = "#f6d5c3"  # a pale vermilion, where a step costs
WALL = "#404040"
GAP = 0.075  # of an axis' height, between two labels
FONT: dict[Any, Any] = {"font.size": 11, "axes.spines.top": False, "axes.spines.right": False}


def label_lines(axis: Any, ends: Sequence[tuple[str, float]]) -> None:
    """Writes each method's name to the right of `axis` at the height where its line ends, moved apart where they meet.

    Args:
      ends: (name in NAMES, y in data) pairs; the axis' limits and scale must be final.
    """
    to_axis = axis.transData + axis.transAxes.inverted()
    heights = sorted((float(to_axis.transform((axis.get_xlim()[1], y))[1]), y, method) for method, y in ends)
    places = np.array([min(max(height, 0.0), 1.0) for height, _, _ in heights])
    for _ in range(max(200, len(places) ** 2)):  # neighbours that are too near push each other away
        for low in range(len(places) - 1):
            lack = GAP - (places[low + 1] - places[low])
            if lack > 1e-4:
                places[low : low + 2] += (-lack / 2, lack / 2)
        places = np.clip(places, 0.0, 1.0) if len(places) * GAP < 1 else places
    for place, (height, _, method) in zip(places, heights, strict=True):
        colour = METHOD_COLOURS[method.split()[0]]
        axis.plot([1.0, 1.04], [height, place], transform=axis.transAxes, color=colour, lw=0.8, clip_on=False)
        axis.text(1.05, place, NAMES[method], transform=axis.transAxes, color=colour, va="center", fontweight="bold")


def over_steps(axis: Any, title: str, last: int) -> None:
    """A panel of curves while training, to the `last` step of a seed."""
    axis.set_title(title, loc="left", fontsize=12, fontweight="bold")
    axis.set_xlabel("environment steps of a seed")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.set_xlim(0, last)


def name_limit(axis: Any, limit: float) -> None:
    """Writes the limit above its line in a panel whose y axis is cost."""
    where = axis.get_yaxis_transform()
    axis.text(0.99, limit, f"limit {limit:g}", transform=where, color=INK, fontsize=9, ha="right", va="bottom")
