"""The cells of the study of limits, with the settings that its trials choose (preregistration.md).

`cells(TRIAL, FOLDERS)` reads a trial's folders, as the queue of a lease does when it has ended. As a script:
choose.py multiplier|macpo FOLDER..., which prints them.
"""

from __future__ import annotations

import math
import pathlib
import sys
from collections.abc import Sequence
from typing import NamedTuple

import macpo_fear  # noqa: F401  # adds the method to the table, so that its runs can be read
from jobs import MACPO, WITH_MULTIPLIER, WITH_TRUST_REGION

from pmt_jax.studies.run_log import RunLog, read_all


class Trial(NamedTuple):
    """Mean cost and reward of the last tenth of the steps, and how many seeds are within the limit."""

    cost: float
    reward: float
    within: int


def cells(trial: str, folders: Sequence[pathlib.Path]) -> dict[str, str]:
    """{name: command} of the cells of `trial`."""
    logs = read_all(folders)
    return _with_multiplier(logs) if trial == "multiplier" else _with_trust_region(logs)


def _with_multiplier(logs: Sequence[RunLog]) -> dict[str, str]:
    """Of the half-lives with mean costs of at most 0.7 at a limit of 1 and 0.15 at 0.2 the one with the highest reward
    at 1; if none has, the one with the least sum of cost divided by limit.
    """
    trials: dict[float, dict[float, Trial]] = {}
    for log in logs:
        trials.setdefault(float(log.settings["kl_half_life"]), {})[float(log.cost_limit)] = _trial(log)
    print(trials, flush=True)
    meet = [half_life for half_life, at in trials.items() if at[1.0].cost <= 0.7 and at[0.2].cost <= 0.15]
    if meet:
        best = max(meet, key=lambda half_life: trials[half_life][1.0].reward)
    else:
        best = min(trials, key=lambda half_life: sum(one.cost / limit for limit, one in trials[half_life].items()))
    return {name: f"{command} --kl-half-life={best:g}" for name, command in WITH_MULTIPLIER.items()}


def _with_trust_region(logs: Sequence[RunLog]) -> dict[str, str]:
    """Of the forms with a mean reward of at least 1,220 (of all, if none has) the one with the most seeds within 1;
    if equal, the lowest mean cost.
    """
    trials = {(str(log.settings["method"]), float(log.settings["kl_limit"])): _trial(log) for log in logs}
    print(trials, flush=True)
    earn = [form for form, trial in trials.items() if trial.reward >= 1220] or list(trials)
    method, kl_limit = min(earn, key=lambda form: (-trials[form].within, trials[form].cost))
    form = f"--method={method} --kl-limit={kl_limit:g}"
    return {name: f"{MACPO[method]} {command} {form}" for name, command in WITH_TRUST_REGION.items()}


def _trial(log: RunLog) -> Trial:
    cost, reward = log.final("episode_cost"), log.final("episode_reward")
    assert cost is not None and reward is not None, f"{log.folder} has no costs or rewards"
    mean = float(cost.mean())
    # A seed that broke has nan: its form is not to be chosen.
    return Trial(mean if math.isfinite(mean) else math.inf, float(reward.mean()), int((cost <= log.cost_limit).sum()))


if __name__ == "__main__":
    for name, command in cells(sys.argv[1], [pathlib.Path(folder) for folder in sys.argv[2:]]).items():
        print(name, command)
