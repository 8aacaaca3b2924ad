"""A sweep's hidden folder `.group-N`: a program, in which several points train side by side as the trials of one run.

.group-1/points/NAME.toml    the settings of each point
.group-1/run/                their common run folder, which counts the seeds of all points through from 0
"""

from __future__ import annotations

import pathlib
from typing import Any

from ..config.load import load_config
from ..config.settings import Config
from ..files import Note, read_rows, to_stderr
from ..limits import KEY, Limits
from .points import Points


def point_files(folder: pathlib.Path) -> list[pathlib.Path]:
    """The settings of each point of a program, in the order of their trials."""
    return sorted((folder / "points").glob("*.toml"), key=lambda file: file.stem)


def points(folder: pathlib.Path) -> Points:
    """The points of a program, in the same order."""
    return {file.stem: load_config(file) for file in point_files(folder)}


def settings_file(point: pathlib.Path) -> pathlib.Path:
    """Where the settings of a sweep's point are: in its own folder, or with the program that trains it."""
    begun = (group / "points" / f"{point.name}.toml" for group in point.parent.glob(".group-*"))
    return next((file for file in (point / "config.toml", *begun) if file.is_file()), point / "config.toml")


def rows(folder: pathlib.Path, group: Points, note: Note = to_stderr) -> dict[str, list[dict[str, Any]]]:
    """{point: rows}, the metrics so far of each point of a program, as a run of its own would have written them."""
    every = read_rows(folder / "run" / "metrics.jsonl", note=note)
    found, first = {}, 0
    for name, config in group.items():
        trials = range(first, first + config.seeds)
        theirs = [row for row in every if row.get("seed") in trials]
        found[name] = [row | _own_limits(row, config) | _own_seed(row, config.seed - first) for row in theirs]
        first = trials.stop
    return found


def _own_limits(row: dict[str, Any], config: Config) -> dict[str, float]:
    """The limits that a point's settings say, which rows of several points know in single precision only."""
    own = Limits.configured(config, len(Limits.of_row(row).each)) if KEY in row else None
    return own.columns if own else {}


def _own_seed(row: dict[str, Any], offset: int) -> dict[str, Any]:
    """What a row says of its trial, said of the point's seed: in `broken`, too."""
    trial, broken = row["seed"], row.get("broken")
    seed = trial + offset
    return {"seed": seed, "broken": broken and broken.replace(f"of seed {trial} ", f"of seed {seed} ")}
