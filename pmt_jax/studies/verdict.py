"""What the end of a run says of its limit: by how many seeds it was kept, and what to do where it was not."""

from __future__ import annotations

import pathlib
import shlex
from collections.abc import Sequence

import numpy as np

from ..config.methods import METHODS
from .run_log import RunLog, read

NEAR = 2.0  # times the limit: costs beyond that are not near it
FALLING = 0.05  # share by which costs fell between the last two tenths of the steps, if they still fall
AT_BOUND = 0.98  # share of lambda_max
MOST_PARTS = 5  # of a list of seeds
STRONGER = {  # what weighs a cost more
    "lagrangian": "--lambda-lr",
    "pid": "--lambda-lr",
    "penalty": "--lambda-max",
    "trust_region": "--limit-lr",
}


def lines(folder: pathlib.Path) -> list[str]:
    """One to three lines about the run in `folder`, which has ended; none if it has no metrics."""
    log = read(folder, note=lambda _: None)
    if log is None:
        return []
    by_training, deployed = log.excess, log.deployed
    by_mean = None if deployed is None else deployed.excess
    said = [_kept(log, by_training, by_mean)]
    beyond = [i for i, x in enumerate(by_training) if x > 0]
    if beyond:
        said.append(_advice(log, beyond))
    if beyond and by_mean is not None and not (by_mean > 0).any() and np.isfinite(by_mean).all():
        said.append("what is deployed acts without noise and keeps the limit")
    elif (by_training <= 0).all() and by_mean is not None and (by_mean > 0).any():
        said.append("mean actions are beyond it where sampled ones are not: raise --cost-margin, or deploy with noise")
    return said


def _kept(log: RunLog, by_training: np.ndarray, by_mean: np.ndarray | None) -> str:
    source = "evaluations" if log.evaluated else "training episodes, with noise"
    where = f"in the last tenth of the steps ({source})"
    unknown = not log.broken and np.isnan(by_training).all()
    parts = [f"unknown {where}, as no episode ended" if unknown else f"kept {_count(by_training, where)}"]
    if by_mean is not None:
        parts.append(("kept " if unknown else "") + _count(by_mean, "under mean actions"))
    true = " on true costs" if log.judged_cost.startswith("true_") else ""
    return f"limit {log.limits_on(log.judged_cost)}{true}: {'; '.join(parts)}"


def _count(excess: np.ndarray, where: str) -> str:
    seeds = "seeds" if len(excess) > 1 else "seed"
    worst = np.max(excess, initial=-np.inf, where=np.isfinite(excess))
    far = f", the worst {worst:.3g} beyond" if worst > 0 else ""
    return f"by {int((excess <= 0).sum())} of {len(excess)} {seeds} {where}{far}"


def _advice(log: RunLog, beyond: Sequence[int]) -> str:
    """The first reason that applies to seeds `beyond` the limit, which these are, and what to do."""
    constraint = _constraint(log)
    if constraint == "none":
        return f"{log.method} has no constraint; train one that has: --method mappo_l or f4sg"
    limit, seeds = log.limits_on(log.judged_cost).total, np.array(log.seeds)[beyond]
    bound = log.settings.get("lambda_max", np.inf)
    cost = log.metrics[log.judged_cost][beyond]
    before, last = (_mean(cost, log.steps, begin) for begin in (0.8, 0.9))
    held = (_multiplier(log)[beyond] >= AT_BOUND * bound) & (constraint in ("lagrangian", "pid"))
    if held.any():
        return f"{_named(seeds[held])}: the multiplier is at its bound, lambda_max = {bound:g}; raise --lambda-max"
    falling = before - last > FALLING * np.abs(before)
    if falling.any():
        more = f"--steps {2 * int(log.steps[-1]):g} --out {shlex.quote(str(log.folder))} --resume"
        fell = f"costs were still falling ({before[falling].mean():.3g} to {last[falling].mean():.3g})"
        return f"{_named(seeds[falling])}: {fell}; train on: {more}"
    far = last > NEAR * limit
    if far.any():
        return _far(cost[far], _named(seeds[far]), limit, constraint)
    return f"{_named(seeds)}: costs stay about the limit; a higher --cost-margin holds them below it"


def _named(seeds: np.ndarray) -> str:
    """Seeds [S] in order, "seeds 3, 5 to 9", shortened where they are many."""
    runs = np.split(seeds, np.flatnonzero(np.diff(seeds) > 1) + 1)
    parts = [f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs]
    many = f" and others, {len(seeds)} in all" if len(parts) > MOST_PARTS else ""
    return f"seed{'s' * (len(seeds) > 1)} {', '.join(parts[:MOST_PARTS])}{many}"


def _far(cost: np.ndarray, whose: str, limit: float, constraint: str) -> str:
    """What to do with seeds whose costs [S, rows] end far beyond the limit."""
    lowest, flag = np.nanmin(cost), STRONGER.get(constraint)
    near = "never came" if lowest > NEAR * limit else "came, but did not stay,"
    advice = f"raise {flag}, or train longer" if flag else "train longer"
    return f"{whose}: costs {near} near the limit (lowest row {lowest:.3g}); {advice}"


def _constraint(log: RunLog) -> str:
    """The method's; of one that is not in the table, what its metrics show."""
    if log.method in METHODS:
        return METHODS[log.method].constraint
    return "trust_region" if "limit_lowered" in log.metrics else "lagrangian" if np.any(_multiplier(log)) else "none"


def _multiplier(log: RunLog) -> np.ndarray:
    """[S] the largest multiplier of any agent at the end; nan if the method has none."""
    each = [x for name, x in log.metrics.items() if name == "lambda" or name.startswith("lambda/")]
    return np.max([_mean(x, log.steps, 0.9) for x in each], axis=0) if each else np.full(len(log.seeds), np.nan)


def _mean(values: np.ndarray, steps: np.ndarray, begin: float) -> np.ndarray:
    """[S] means over a tenth of the steps that begins at a share of them; nan where nothing is known."""
    chosen = values[:, (steps > begin * steps[-1]) & (steps <= (begin + 0.1) * steps[-1] + 0.5)]
    known = np.isfinite(chosen)
    total = np.where(known, chosen, 0.0).sum(1)
    return np.where(known.any(1), total / np.maximum(known.sum(1), 1), np.nan)
