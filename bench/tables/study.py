"""The tables of docs/results/study.md: stored runs whose costly steps are noticed with a probability."""

from __future__ import annotations

import pathlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pmt_jax.formats import markdown
from pmt_jax.studies.statistics import difference_interval, holm, welch_test

from . import runs

Scores = NDArray[np.float64]  # [seeds]

NAMES = {"mappo_l": "MAPPO-L", "f4sg": "F4SG", "r4sg": "R4SG", "mixed": "Mixed", "macpo": "MACPO"}
PAIR = ("mappo_l", "f4sg")


def measures(run: runs.Run) -> dict[str, Scores]:
    """The three measures of each seed: true cost at the end and per 1,000 steps of training, reward at the end."""
    columns = {"end": runs.TRUE, "training": runs.TRUE_WHILE_TRAINING, "reward": "reward"}
    return {name: np.array(run["table"][column], float) for name, column in columns.items()}


def share(run: runs.Run) -> float:
    """The probability with which a costly step is noticed."""
    return runs.settings(run)["cost_seen"]


def unsafe(run: runs.Run, own: dict[str, Scores]) -> str:
    """How many seeds end beyond the limit."""
    return f"{(own['end'] > run['cost_limit'] / share(run)).sum()} of {len(own['end'])}"


def as_probe(files: pathlib.Path) -> str:
    """F4SG against MAPPO-L with the same settings, probability and limit of true costs; a + joins the names of files.

    The tests are Welch's, corrected by Holm over the three measures of all pairs together. d is Cohen's.
    """
    compared = [run for run in runs.load(files) if run["method"] in PAIR]
    found = sorted(compared, key=lambda run: (*_cell(run), _rank(run)))
    scores = [measures(run) for run in found]
    pairs = [j for j in range(1, len(found)) if _cell(found[j]) == _cell(found[j - 1])]  # F4SG's row, after its other
    order = ("training", "end", "reward")
    p = holm([welch_test(scores[j][name], scores[j - 1][name]) for j in pairs for name in order])
    corrected = {j: ", ".join(map(p_value, p[3 * k : 3 * k + 3])) for k, j in enumerate(pairs)}
    body = []
    for j, (run, own) in enumerate(zip(found, scores, strict=True)):
        line = [f"{share(run):g}", f"{_limit(run):g}", NAMES[run["method"]], *(mean_sd(own[name]) for name in order)]
        effect = (_effect(own["training"], scores[j - 1]["training"]), corrected[j]) if j in corrected else ("-", "-")
        body.append([*line, unsafe(run, own), *effect])
    head = ["p", "limit", "method", "harm: costly steps per 1,000, training", "true cost at the end", "reward"]
    head += ["seeds beyond the limit", "harm less MAPPO-L's [95 %], d", "corrected p: harm, cost, reward"]
    return markdown(head, body)


def _cell(run: runs.Run) -> tuple[float, float, list[tuple[str, str]]]:
    """What F4SG and MAPPO-L have in common if they are compared: p, limit and all settings but the sample's."""
    return share(run), -_limit(run), [(name, x) for name, x in runs.shared(run).items() if name != "method"]


def _effect(ours: Scores, theirs: Scores) -> str:
    """The difference of the means with its 95 % interval, and in standard deviations."""
    low, high = difference_interval(ours, theirs)
    difference = ours.mean() - theirs.mean()
    spread = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 2)
    return f"{difference:.1f} [{low:.1f}, {high:.1f}], {difference / spread if spread else 0:.1f}"


def _limit(run: runs.Run) -> float:
    """The limit of true costs: the team notices a share of them."""
    return round(run["cost_limit"] / share(run), 9)


def _rank(run: runs.Run) -> int:
    return list(NAMES).index(run["method"])


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
