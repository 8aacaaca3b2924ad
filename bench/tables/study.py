"""The tables of docs/results/study.md: stored runs whose costly steps are noticed with a probability."""

from __future__ import annotations

import functools
import pathlib
import tomllib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmt_jax.formats import markdown
from pmt_jax.studies.statistics import holm, u_test

from . import runs

Scores = NDArray[np.float64]  # [seeds]

NAMES = {"mappo_l": "MAPPO-L", "f4sg": "F4SG", "r4sg": "R4SG", "mixed": "Mixed", "macpo": "MACPO"}


def measures(run: runs.Run) -> dict[str, Scores]:
    """The three measures of each seed: true cost at the end and per 1,000 steps of training, reward at the end."""
    columns = {"end": runs.TRUE, "training": runs.TRUE_WHILE_TRAINING, "reward": "reward"}
    return {name: np.array(run["table"][column], float) for name, column in columns.items()}


def settings(run: runs.Run) -> dict[str, Any]:
    """The run's settings; those that are newer than it have what was done before."""
    return {"cost_seen": 1.0} | runs.OLD | _config(run["config"])


@functools.cache  # a table asks for the settings of a run many times
def _config(text: str) -> dict[str, Any]:
    return tomllib.loads(text)


def share(run: runs.Run) -> float:
    """The probability with which a costly step is noticed."""
    return settings(run)["cost_seen"]


def unsafe(run: runs.Run, own: dict[str, Scores]) -> str:
    """How many seeds end beyond the limit."""
    return f"{(own['end'] > run['cost_limit'] / share(run)).sum()} of {len(own['end'])}"


def as_probe(file: pathlib.Path) -> str:
    """Probes of F4SG against MAPPO-L with the same settings, at the same p and limit.

    p of each comparison is corrected over all comparisons of the file, those of the three measures together.
    """
    found = sorted(runs.load(file), key=lambda run: (share(run), -_limit(run), _recipe(run), _rank(run)))
    scores = [measures(run) for run in found]
    pairs = [(i, j) for j, run in enumerate(found) if (i := _same_settings(found, run)) is not None]
    order = ("training", "end", "reward")
    p = holm([u_test(scores[j][name], scores[i][name]) for i, j in pairs for name in order])
    corrected = {j: p[3 * k : 3 * k + 3] for k, (_, j) in enumerate(pairs)}
    body = []
    for j, (run, own) in enumerate(zip(found, scores, strict=True)):
        line = [f"{share(run):g}", f"{_limit(run):g}", f"{NAMES[run['method']]}, {RECIPES[_recipe(run)]}"]
        line += [mean_sd(own["training"]), mean_sd(own["end"]), f"{np.median(own['end']):.1f}", mean_sd(own["reward"])]
        body.append([*line, unsafe(run, own), ", ".join(map(p_value, corrected[j])) if j in corrected else "-"])
    head = ["p", "limit", "method, settings", "true cost per 1,000 steps, training", "true cost at the end", "median"]
    return markdown([*head, "reward", "seeds beyond the limit", "corrected p: training, end, reward"], body)


RECIPES = (
    "as in the study",
    "`max_grad_norm` inf",
    "`cost_value_clip` inf",
    "`cost_value_clip` and `max_grad_norm` inf",
    "PID for tight limits",
)


def _recipe(run: runs.Run) -> int:
    """Which of RECIPES the run has."""
    mine = settings(run)
    uncut, unclipped = (np.isinf(mine[name]) for name in ("max_grad_norm", "cost_value_clip"))
    return 4 if mine["lambda_rule"] == "pid" else 2 * int(unclipped) + int(uncut)


def _limit(run: runs.Run) -> float:
    """The limit of true costs: the team notices a share of them."""
    return run["cost_limit"] / share(run)


def _rank(run: runs.Run) -> int:
    return list(NAMES).index(run["method"])


def _same_settings(found: Sequence[runs.Run], run: runs.Run) -> int | None:
    """Where the MAPPO-L is that an F4SG is compared with."""
    wanted = "mappo_l", share(run), _limit(run), _recipe(run)
    like = [i for i, x in enumerate(found) if (x["method"], share(x), _limit(x), _recipe(x)) == wanted]
    return like[0] if like and run["method"] == "f4sg" else None


def as_weights(file: pathlib.Path) -> str:
    """How far regret's weight on the ratio is from 1: a row for each run with regret, means over its seeds."""
    body = []
    for run in sorted(runs.load(file), key=lambda run: (run["task"], -share(run), _rank(run))):
        mean, std = (np.array(run["diagnostics"].get(f"regret/weight_{x}", ())) for x in ("mean", "std"))
        if std.size:
            line = [run["task"], f"{share(run):g}", NAMES[run["method"]]]
            body.append([*line, f"{mean.min():.4f} to {mean.max():.4f}", f"{std.max():.4f}", f"{std[-1]:.4f}"])
    head = [
        "task",
        "p",
        "method",
        "mean of the weight, lowest to highest chunk",
        "its standard deviation, highest chunk",
    ]
    return markdown([*head, "last chunk"], body)


def mean_sd(x: Scores) -> str:
    spec = ".0f" if abs(x.mean()) >= 100 else ".1f"
    return f"{x.mean():{spec}} +- {x.std(ddof=1):{spec}}"


def p_value(value: float) -> str:
    return "< .001" if value < 0.001 else f"{value:.3f}".lstrip("0") if value < 1 else "1"


KINDS: dict[str, Callable[[pathlib.Path], str]] = {"weights": as_weights, "probe": as_probe}
