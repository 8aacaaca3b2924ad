"""Draws docs/NAME.png, the training curves of the runs in a file of bench/results, as `pmt plot` draws run folders.

python -m docs.figures.curves          all of them
python -m docs.figures.curves table2   some
"""

from __future__ import annotations

import pathlib
import sys

from bench import records, runs
from pmt_jax.studies import plot

DOCS = pathlib.Path(__file__).parents[1]
FIGURES = {
    "table1_ant_2x4": "table1_ant_2x4_h200",
    "table1_ant_4x2": "table1_ant_4x2_h200",
    "table2": "table2_h200",
    "table3_voltage_33": "table3_voltage_33_h200",
    "table3_voltage_141": "table3_voltage_141_h200",
    "ant_2x4_r4sg": "ant_2x4_r4sg",
    "hand_over_training": "hand_over_training",
}


def main(names: list[str]) -> None:
    """Draws the pictures of these names, or all."""
    for name in names or FIGURES:
        found = runs.load(records.RESULTS / f"{FIGURES[name]}.json")
        plot.draw(plot.pooled([runs.curves(run) for run in found]), DOCS / f"{name}.png")
        print(f"docs/{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
