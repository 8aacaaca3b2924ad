"""Numbers in sentences: what stored runs say, as `within:FILE:METHOD:LIMIT`.

FILE and METHOD may be several, joined by +, METHOD and LIMIT may be *, and any further word must be in a run's label
or be its task.
The seeds of all these runs are pooled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pmt_jax.errors import UsageError
from pmt_jax.studies.rows import TableRow
from pmt_jax.tasks import did_you_mean

from .. import records
from . import runs

VALUES: dict[str, Callable[[Sequence[TableRow]], str]] = {
    "within": lambda rows: f"{sum((row.beyond <= 0).sum() for row in rows)}",  # seeds within the limit
    "seeds": lambda rows: f"{sum(row.beyond.size for row in rows)}",
    "reward": lambda rows: f"{np.concatenate([row.score('reward') for row in rows]).mean():,.0f}",
}


def number(mark: str) -> str:
    """The number that a mark in a sentence stands for.

    Raises:
      UsageError: an unknown value or file, or no such run.
    """
    what, *given = mark.split(":")
    if what not in VALUES:
        raise UsageError(f"unknown value '{what}'{did_you_mean(what, VALUES)}")
    if len(given) < 3:
        raise UsageError(f"'{mark}' does not fit: expected {what}:FILE:METHOD:LIMIT")
    files, method, limit, *words = given
    stored = runs.load(records.RESULTS / f"{files}.json")
    found = [run for run in stored if method == "*" or run["method"] in method.split("+")]
    found = [run for run in found if limit in ("*", f"{run['cost_limit']:g}")]
    found = [run for run in found if set(words) <= {run["task"], *run["label"].split()}]
    if not found:
        raise UsageError(f"no run of {files} is '{':'.join(given[1:])}'")
    return VALUES[what]([runs.row_of(run) for run in found])
