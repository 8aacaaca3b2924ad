"""The metrics of a run: what each of them means, and the rows of metrics.jsonl that hold them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from ..learning.evaluation import interval
from ..learning.setup import Setup
from ..limits import WORST, Limits, base, judged, of_agents
from .history import Row

Reduction = Literal["mean", "episodes", "sum", "loss", "worst"]


class Metric(NamedTuple):
    """A column of metrics.jsonl.

    Attributes:
      unit: of its values.
      definition: what it measures, over the updates of one row.
      reduction: how the updates of a row become one value. `mean` leaves out what is not finite, `loss` does not: a
        loss that was not finite even once must show. `episodes` weighs each update by the episodes that ended in it.
        `worst` is the one farthest from [0, 1].
    """

    unit: str
    definition: str
    reduction: Reduction = "mean"


METRICS: dict[str, Metric] = {
    "step": Metric("steps", "environment steps of one seed, over all its environments"),
    "seed": Metric("", "the seed that the row is of"),
    "task": Metric("", "the task's name"),
    "method": Metric("", "the method's name"),
    "cost_limit": Metric("cost", "allowed undiscounted cost of one agent per episode"),
    "broken": Metric("", "why the seed stopped training; null while it trains"),
    "seconds": Metric("s", "wall time spent training since the run began, without compiling, over all its sessions"),
    "episode_reward": Metric(
        "reward", "undiscounted sum of the team's reward over an episode, mean over the episodes that ended", "episodes"
    ),
    "episode_cost": Metric("cost", "the same of one agent's cost, mean over agents", "episodes"),
    "episode_cost_worst": Metric(
        "cost", "the same of the agent whose cost is highest, where agents do not share costs"
    ),
    "episode_length": Metric("steps", "control steps of an episode, mean over the episodes that ended", "episodes"),
    "episodes": Metric("", "episodes that ended", "sum"),
    "terminations": Metric("", "episodes ended by the task's rule, or by its limit if `time_limit = terminate`", "sum"),
    "violation_rate": Metric("", "share of steps with a cost above 0 for some agent"),
    "within_limit": Metric(
        "", "share of the episodes that ended in which each cost of each agent is within its limit", "episodes"
    ),
    "episode_cost_beyond": Metric(
        "cost",
        "how far the agent that is furthest beyond the limit is beyond it, 0 of an episode within it, mean over the "
        "episodes that ended; of several costs the sum",
        "episodes",
    ),
    "step_reward": Metric("reward", "reward of a control step"),
    "step_cost": Metric("cost", "cost of a control step, mean over agents"),
    "true_episode_cost": Metric("cost", "episode_cost before `cost_seen`: what the costs were", "episodes"),
    "true_episode_cost_worst": Metric("cost", "the same of the agent whose cost is highest"),
    "true_violation_rate": Metric("", "violation_rate of what the costs were"),
    "true_step_cost": Metric("cost", "step_cost of what the costs were"),
    "non_finite": Metric("steps", "steps that were not finite and were quarantined: reward 0, cost 1, reset", "sum"),
    "cost_out_of_range": Metric("steps", "steps with a cost outside [0, 1]; they stop the seed", "sum"),
    "worst_cost": Metric("cost", "the cost farthest outside [0, 1]; null if all are within", "worst"),
    "lambda": Metric("", "the multiplier, with the gains of PID, mean over agents and costs; 0 without one"),
    "cost_excess": Metric(
        "limits",
        "how far the estimated episode cost is beyond the limit less `cost_margin`, as a share of that, of the agent "
        "and cost furthest beyond",
    ),
    "limit_lowered": Metric("limits", "by how much MACPO keeps below the limit less `cost_margin`, mean"),
    "critic/loss": Metric("", "clipped squared error in normalised units, in an update's last epoch", "loss"),
    "critic/grad_norm": Metric("", "norm of the gradient before clipping, in an update's last epoch"),
    "critic/explained_variance": Metric("", "1 - variance of the critic's error / variance of the returns"),
    "critic/return_mean": Metric("reward", "running mean of the returns, which the critic normalises by"),
    "critic/return_std": Metric("reward", "running standard deviation of the returns"),
    "actor/loss": Metric("", "the policy's loss, in an update's last epoch", "loss"),
    "actor/grad_norm": Metric("", "norm of the gradient before clipping, in an update's last epoch"),
    "actor/entropy": Metric("nats", "entropy of the policy, in an update's last epoch"),
    "actor/std": Metric("action", "standard deviation of the actions, mean over an agent's entries"),
    "actor/clipped": Metric("", "share of rows whose weighted probability ratio is outside the clip interval"),
    "actor/kl_per_agent": Metric("nats", "KL(old, new) of an update, mean over the batch, agents and updates"),
    "actor/share_of_step": Metric("", "share of an update's step that `kl_max` kept"),
    "actor/penalty": Metric("", "P3O's penalty before its weight, in an update's last epoch"),
    "actor/case": Metric("", "which case of the trust-region problem was solved"),
    "actor/reach": Metric("limits", "most that a step of the trust region promises to take off the cost"),
    "actor/line_search_steps": Metric("", "steps of the line search that were tried in vain"),
    "fear/loss": Metric("", "loss of the fear network, in an update's last epoch"),
    "fear/grad_norm": Metric("", "norm of the gradient before clipping, in an update's last epoch"),
    "fear/brier": Metric("", "mean squared error of fear against the costs of a batch not learned from yet"),
    "fear/ece": Metric("", "expected calibration error of fear, over ten equal bins"),
    "fear/on_costly": Metric("", "mean fear where a cost followed"),
    "fear/on_safe": Metric("", "mean fear where no cost followed"),
    "regret/loss": Metric("", "loss of the regret networks, in an update's last epoch"),
    "regret/grad_norm": Metric("", "norm of the gradient before clipping, in an update's last epoch"),
    "regret/on_costly": Metric("", "mean regret of an action entry on costly steps"),
    "regret/on_safe": Metric("", "mean probability of regret of an action entry on steps without cost"),
    "regret/weight_mean": Metric("", "mean of the weight that regret puts on the probability ratio"),
    "regret/weight_std": Metric("", "standard deviation of that weight"),
}
METRICS |= {
    name.replace("critic/", "cost_critic/", 1): metric._replace(unit=metric.unit.replace("reward", "limits"))
    for name, metric in METRICS.items()
    if name.startswith("critic/")
}
LOSSES = tuple(name for name, metric in METRICS.items() if metric.reduction == "loss")


def describe(name: str) -> Metric:
    """What a column of metrics.jsonl means; `info/...` is the task's own, `eval/...` is of an evaluation.

    `.../0` is of the first cost, mean over agents; `.../agent_0` and `.../agent_0/cost_0` are of the first agent.

    Raises:
      KeyError: there is no such metric.
    """
    if name.startswith("eval/"):
        measure = name.removeprefix("eval/").removesuffix("/ci95")
        of = describe(measure)
        what = "half-width of the 95 % interval of" if name.endswith("/ci95") else "mean over evaluation episodes of"
        return Metric(of.unit, f"{what} {measure}, mean actions; null in rows without an evaluation")
    if name.startswith("info/"):
        return Metric("", f"the task's own `{name.removeprefix('info/')}`, mean per control step")
    return METRICS[base(name)]


def make_rows(setup: Setup, step: int, metrics: Mapping[str, np.ndarray]) -> list[Row]:
    """A chunk's metrics [seeds, updates, ...] as one row per seed; each of episodes weighs the same."""
    episodes = np.asarray(metrics["episodes"])
    config = setup.config
    return [
        {
            "step": step,
            "seed": config.seed + i,
            "task": setup.vector.spec.name,
            "method": setup.label,
            **limits.columns,
            "broken": None,
            **_worst_of_row({name: _reduce(name, np.asarray(x[i]), episodes[i]) for name, x in metrics.items()}),
        }
        for i, limits in enumerate(setup.limits_of_seeds)
    ]


def _worst_of_row(row: Row) -> Row:
    """The same, but the worst agent is that of the row: each update may have another, so their mean is too high."""
    worst = [name for name in row if name.endswith(WORST)]
    return row | {name: float(np.max(of_agents(row, name.removesuffix(WORST)))) for name in worst}


def judged_cost(row: Row, prefix: str) -> tuple[float, float]:
    """What a row's cost is judged by, and the limit of that: of several agents or costs, the largest excess, and 0.

    Args:
      prefix: `eval/` to judge the evaluation, else nothing.
    """
    limits = Limits.of_row(row)
    names = judged(row, f"{prefix}episode_cost", len(limits.each))
    if names == [[f"{prefix}episode_cost"]]:
        return row[f"{prefix}episode_cost"], limits.total
    return float(limits.excess([[row[name] for name in costs] for costs in names])), 0.0


def without_metrics(row: Row, reason: str) -> Row:
    """The row of a seed that trains no more: what names it, and nan for all that was measured."""
    named = ("step", "seed", "task", "method", "seconds")
    kept = {name: row[name] for name in named if name in row} | Limits.of_row(row).columns
    return {**dict.fromkeys(row, math.nan), **kept, "broken": reason}


def _reduce(name: str, values: np.ndarray, episodes: np.ndarray) -> float | int:
    """One value of those of updates [U], in each of which so many `episodes` [U] ended."""
    metric = METRICS.get(base(name))
    reduction = metric.reduction if metric else "mean"
    if reduction == "sum":
        return int(values.sum())
    if reduction == "loss":
        return float(values.mean())
    seen = np.isfinite(values)
    if reduction == "worst" and seen.any():
        return float(values[seen][np.abs(values[seen] - 0.5).argmax()])
    weights = episodes[seen] if reduction == "episodes" else None
    return float(np.average(values[seen], weights=weights)) if seen.any() else math.nan


def seed_intervals(results: Mapping[str, np.ndarray]) -> list[dict[str, tuple[float, float]]]:
    """Of metrics [seeds, episodes]: each seed's means and half-widths of their 95 % intervals."""
    seeds = len(next(iter(results.values())))
    return [{name: interval(np.asarray(x[i])) for name, x in results.items()} for i in range(seeds)]


def evaluation_columns(results: Mapping[str, tuple[float, float]]) -> Row:
    """`eval/NAME` and its interval's half-width `eval/NAME/ci95` of one seed's evaluation."""
    means = {f"eval/{name}": mean for name, (mean, _) in results.items()}
    return means | {f"eval/{name}/ci95": half for name, (_, half) in results.items()}
