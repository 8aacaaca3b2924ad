"""Training curves of run folders as a compact JSON, and a picture of such files.

python -m bench.curves runs/ant --json bench/results/ant_2x4_r4sg.json --png docs/ant_2x4_r4sg.png
python -m bench.curves --from bench/results/ant_2x4_r4sg.json --png docs/ant_2x4_r4sg.png

The picture is that of `pmt plot`, which draws run folders as they are. The block `<!-- bench: curves:ant_2x4_r4sg -->`
of a document becomes the table of that file (bench/render.py).
"""

from __future__ import annotations

import argparse
import json
import pathlib
import tomllib
from typing import Any

import numpy as np

from pmt_jax.errors import UsageError
from pmt_jax.studies import plot, table

FIGURES = ("episode_reward", "episode_cost", "violation_rate", "lambda", "episode_length")


def compact(folder: pathlib.Path) -> dict[str, Any]:
    """A run's curves per seed, its figures in a table, and what it takes to make it again.

    Curves are {name: [seeds][points]}, None where unknown; `table` is {column: [seeds]}, see `pmt_jax.studies.table`.
    """
    curves, (row,) = plot.read(folder, FIGURES), table.rows([folder])
    figures = {name: [[_rounded(x) for x in seed] for seed in curves.figures[name]] for name in FIGURES}
    return {
        "steps": curves.steps.tolist(),
        "seeds": list(curves.seeds),
        **figures,
        "table": {column: [_rounded(x) for x in seeds] for column, seeds in row.figures.items()},
        "source": row.source,
        "task": curves.task,
        "method": curves.method,
        "cost_limit": curves.cost_limit,
        "seconds": curves.seconds,
        "versions": json.loads((folder / "versions.json").read_text()),
        "config": (folder / "config.toml").read_text(),
    }


def _rounded(x: float) -> float | None:
    return float(f"{x:.6g}") if np.isfinite(x) else None


def curves(stored: dict[str, Any]) -> plot.Curves:
    """The inverse of `compact`."""
    return plot.Curves(
        names=(stored["task"],),
        task=stored["task"],
        method=stored["method"],
        cost_limit=stored["cost_limit"],
        settings=tomllib.loads(stored["config"]),
        seeds=tuple(stored["seeds"]),
        steps=np.array(stored["steps"]),
        figures={name: np.array(stored[name], float) for name in FIGURES},
        seconds=stored["seconds"],
    )


def markdown(file: pathlib.Path) -> str:
    """The runs of a JSON file as a table, without the sentences below it that say what its figures mean.

    Raises:
      UsageError: the file is not there, or is not what `compact` makes.
    """
    try:
        stored = json.loads(file.read_text())
        rows = [_row(run) for run in stored]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{file} holds no runs that bench.curves wrote ({type(error).__name__}: {error})") from None
    return table.render(table.in_order(rows), "markdown").split("\n\n")[0]


def _row(run: dict[str, Any]) -> table.Row:
    figures = {column: np.array(seeds, float) for column, seeds in run["table"].items()}
    return table.Row(run["task"], run["method"], "", run["cost_limit"], max(run["steps"]), run["source"], figures)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=pathlib.Path)
    parser.add_argument("--from", dest="source", type=pathlib.Path, help="a JSON file written earlier")
    parser.add_argument("--json", type=pathlib.Path)
    parser.add_argument("--png", type=pathlib.Path)
    arguments = parser.parse_args()
    runs = json.loads(arguments.source.read_text()) if arguments.source else [compact(f) for f in arguments.folders]
    if arguments.json:
        arguments.json.write_text(json.dumps(runs) + "\n")
    if arguments.png:
        plot.draw([curves(run) for run in runs], arguments.png)


if __name__ == "__main__":
    main()
