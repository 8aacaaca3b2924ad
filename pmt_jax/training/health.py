"""Whether a seed can still train: losses that are not finite, critics that diverge, steps that broke."""

from __future__ import annotations

import collections
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..config.settings import HYPER_FIELDS
from ..learning.constraint import in_unit
from ..learning.setup import Setup
from .metrics import LOSSES, Row

MOST = 0.5  # share of a row's steps that may be quarantined
MAX_RETURN = 1e8  # of a critic, in units of the reward (cost) of a step
MAX_UNIT = 1e12  # of costs, beyond which squares of returns overflow
FAULTS = {  # columns that count steps, and what these did
    "non_finite": "were not finite: reward 0, cost 1, end of the episode",
    "cost_out_of_range": "had a cost outside [0, 1]",
}
NO_ROOM = "the warp engine had no room for all contacts or constraints"


def overflow(setup: Setup, rows: list[Row]) -> str | None:
    """What is wrong, if the physics lost contacts."""
    share = max(row[setup.overflow] for row in rows) if setup.overflow else 0.0
    if not share:
        return None
    return (
        f"{NO_ROOM} in {share:.2g} of the steps up to step {rows[0]['step']:,}, which are wrong; take another "
        "--physics, or give make_engine more `contacts`"
    )


def unshared(row: Row, spread: float) -> str | None:
    """What is wrong, if agents' costs of a step differ by `spread` though their task declares that they share costs."""
    if not spread > 0:
        return None
    return (
        f"task '{row['task']}' has shares_cost = True, but its agents' costs differ by up to {spread:.2g} in a step "
        f"up to step {row['step']:,}, which no column shows; leave shares_cost out"
    )


def diagnose(setup: Setup, index: int, row: Row, finite: bool, steps: int) -> str | None:
    """Why a seed cannot train on after this row; None if it can.

    Args:
      index: of the seed, from 0.
      finite: whether all its weights and moments are.
      steps: environment steps of the row.
    """
    share = row["non_finite"] / steps
    whose = "" if setup.trials else f"of seed {row['seed']} "
    where = f"{whose}at step {row['step']:,}"
    if share > MOST:
        return (
            f"{share:.0%} of the environment steps {where} were not finite; check the observations, rewards, costs and "
            f"states of task '{row['task']}'"
        )
    if row["cost_out_of_range"]:
        return (
            f"{row['cost_out_of_range']:,} of the {steps:,} environment steps {whose}up to step {row['step']:,} had a "
            f"cost outside [0, 1], the worst {row['worst_cost']:g}; scale or clip the costs of task '{row['task']}'"
        )
    lost = [name for name in LOSSES if not math.isfinite(row[name])]
    if lost or not finite:
        what = f"{lost[0]} {where} is {row[lost[0]]}" if lost else f"a weight {where} is not finite"
        return f"{what}; {_cause(setup, index, share)}"
    return _divergence(setup, index, row, where)


def diagnose_evaluation(setup: Setup, row: Row) -> str | None:
    """Why a seed cannot train on after the evaluation in this row; None if it can, or none was made."""
    if not row["eval/cost_out_of_range"] > 0:
        return None
    whose = "" if setup.trials else f"of seed {row['seed']} "
    return (
        f"{row['eval/cost_out_of_range']:g} steps an episode in the evaluation {whose}at step {row['step']:,} had a "
        f"cost outside [0, 1]; scale or clip the costs of task '{row['task']}'"
    )


def count_faults(metrics: Mapping[str, Any], episodes: float) -> collections.Counter[str]:
    """How many steps broke the contract of tasks, by the names in FAULTS, `eval/` before those of evaluations.

    Args:
      metrics: rows' values by column, numbers or arrays; what is unknown is nan, None or missing.
      episodes: of an evaluation of one seed.
    """

    def total(name: str) -> float:
        return float(np.nansum(np.asarray(metrics.get(name), float)))

    found = {name: total(name) for name in FAULTS}
    found |= {f"eval/{name}": total(f"eval/{name}") * episodes for name in (*FAULTS, "episode_length")}
    return collections.Counter({name: round(count) for name, count in found.items() if count})


def faults(counts: Mapping[str, int], steps: int) -> str:
    """What `count_faults` found, in a sentence; empty if there were no faults.

    Args:
      steps: of training, of all seeds.
    """
    every = {"": steps, "eval/": counts.get("eval/episode_length", 0)}
    where = {"": "", "eval/": " in evaluations"}
    found = [
        f"{counts[prefix + name]:,} of {every[prefix]:,} steps{where[prefix]} {what}"
        for prefix in every
        for name, what in FAULTS.items()
        if counts.get(prefix + name)
    ]
    return f"{'; '.join(found)}. Check the task's observations, rewards, costs and states" if found else ""


def _cause(setup: Setup, index: int, share: float) -> str:
    """The likeliest reason for a loss that is not finite; steps with actions that are not finite are not either."""
    extreme = ", ".join(f"{name} = {value:g}" for name, value in _extreme_settings(setup, index).items())
    if extreme:
        return f"single precision cannot train with {extreme}"
    if share:
        return f"{share:.1%} of the environment steps were not finite: check the task's observations, rewards and costs"
    return "training diverged: try smaller learning rates (actor_lr, critic_lr, emotion_lr)"


def _extreme_settings(setup: Setup, index: int) -> dict[str, float]:
    """The seed's settings that overflow in single precision."""
    hyper = jax.device_get(setup.vmap_arguments[0])
    values = {name: np.asarray(getattr(hyper, name)) for name in HYPER_FIELDS if name != "cost_limit"}
    own = {name: float(x[index] if x.ndim else x) for name, x in values.items()}
    usual = {name: 1.0 if name.endswith("_lr") and name != "lambda_lr" else 1e6 for name in own}
    found = {name: x for name, x in own.items() if usual[name] < x < math.inf}
    tiny = {"cost_limit": min(setup.limits_of_seeds[index].each)} if _cost_unit(setup, index) > MAX_UNIT else {}
    return found | tiny


def _divergence(setup: Setup, index: int, row: Row, where: str) -> str | None:
    for critic, what in (("critic", "reward"), ("cost_critic", "cost")):
        mean, std, step = (row[name] for name in (f"{critic}/return_mean", f"{critic}/return_std", f"step_{what}"))
        largest = max(abs(mean), std)
        if largest <= MAX_RETURN * max(1.0, abs(step)):
            continue
        unit = _cost_unit(setup, index) if what == "cost" else 1.0
        if largest > MAX_RETURN * max(1.0, abs(step)) * max(1.0, unit):
            return (
                f"the {critic} {where} diverged: its returns are {mean:.2g} +- {std:.2g}, where a step's "
                f"{what} is {step * unit:.2g}; try a smaller critic_lr, gamma or gae_lambda"
            )
    return None


def _cost_unit(setup: Setup, index: int) -> float:
    """What a cost of 1 is to the seed's cost critic, which counts in units of the limit; of several costs the most."""
    hyper = setup.vmap_arguments[0]
    own = jax.tree.map(lambda x: x[index], hyper) if jnp.ndim(hyper.clip) else hyper
    return float(jnp.max(in_unit(setup, own, jnp.ones(()))))
