"""The evaluation that ends every run: whole episodes under mean actions, which is what one deploys.

`evaluation.jsonl` in the run folder has a line for each seed that still trains: its last policy's means over so many
`episodes`, with the half-widths of their 95 % intervals as `NAME/ci95`. `pmt eval RUN --deterministic --episodes 64`
computes the same.
"""

from __future__ import annotations

import json
import math
import pathlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..files import Note, read_rows, replace_text, to_stderr
from .history import Row

if TYPE_CHECKING:  # JAX, which tables do without
    from ..learning.setup import Setup

FILE = "evaluation.jsonl"
EPISODES = 64  # of each seed


def episodes(setup: Setup) -> int:
    """How many episodes a seed is evaluated on: what all devices that share its environments can share."""
    parts = setup.mesh.devices.shape[1] if setup.mesh else 1
    return -(-EPISODES // parts) * parts


def rows(setup: Setup, step: int, results: Mapping[str, Any], left_out: set[int]) -> list[Row]:
    """The lines of evaluation.jsonl.

    Args:
      step: environment steps that each seed was trained for.
      results: metrics [seeds, episodes].
      left_out: indices of seeds that broke.
    """
    from .metrics import seed_intervals

    named = {"step": step, "task": setup.vector.spec.name, "method": setup.label, "actions": "mean"}
    found = []
    for i, (measured, limits) in enumerate(zip(seed_intervals(results), setup.limits_of_seeds, strict=True)):
        if i in left_out:
            continue
        figures = {name: mean for name, (mean, _) in measured.items()}
        figures |= {f"{name}/ci95": half for name, (_, half) in measured.items()}
        of_seed = {"seed": setup.config.seed + i, "episodes": len(next(iter(results.values()))[i])}
        known = {name: x if math.isfinite(x) else None for name, x in figures.items()}
        found.append({**named, **of_seed, **limits.columns, **known})
    return found


def write(folder: pathlib.Path, rows: list[Row]) -> None:
    """Replaces what `folder` has; nothing is written where no seed is left."""
    if rows:
        replace_text(folder / FILE, "".join(json.dumps(row) + "\n" for row in rows))


def read(folder: pathlib.Path, step: int, note: Note = to_stderr) -> list[Row]:
    """The lines in `folder` that are of the policies after `step`; none if it was not evaluated there."""
    return [row for row in read_rows(folder / FILE, note=note) if row.get("step") == step]
