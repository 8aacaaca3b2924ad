"""The cells of the study of limits, with the settings that its trials choose (docs/appendix/preregistration.md).

`cells(FOLDER)` reads the trial of spread episodes below FOLDER, as the queue of a lease does when it has ended. As a
script: choose.py FOLDER, which prints them.
"""

from __future__ import annotations

import json
import math
import pathlib
import sys
from collections.abc import Iterable
from typing import NamedTuple

import macpo_fear  # noqa: F401  # adds the method to the table, so that its runs can be read
from jobs import AT_TEN

from pmt_jax.studies.run_log import RunLog, read_all

RESULTS = pathlib.Path(__file__).parents[2] / "bench/results"
ANT = "train paper/ant_2x4 --seeds=20 --cost-margin=0.5"
SPREAD = "--episode-starts=spread"
AVERAGE = "--cost-estimate=average --lambda-max=100"
PMT = ".ci/lease/macpo_fear.py"  # `pmt` that has this method, too
MACPO = ("method", "kl_limit", "limit_lr", "cost_estimate")  # what its trials vary


class Trial(NamedTuple):
    """Mean cost and reward of the last tenth of the steps, and how many seeds are within 1."""

    cost: float
    reward: float
    within: int


def cells(folder: pathlib.Path) -> tuple[dict[str, str], dict[str, str]]:
    """{name: command} of what runs next, at 0.2 and 1, then at 10, and of what may wait: MACPO if no trial kept 1."""
    logs = [log for log in read_all([folder]) if log.settings["episode_starts"] == "spread"]
    end = min(log.steps[-1] for log in logs)
    logs = [log.until(end) for log in logs]
    print(f"the trial is read at step {end:,}")
    multiplier = _multiplier([log for log in logs if log.method == "mappo_l"])
    macpo = _macpo([log for log in logs if log.method in ("macpo", "macpo_fear")])
    found = {
        f"limits/{method}-{limit}": f"-m pmt_jax {ANT} --method={method} --seed=480 --cost-limit={limit} {multiplier}"
        for limit in ("0.2", "1", "10")
        for method in ("mappo_l", "f4sg")
    }
    own = {f"limits/macpo-{limit}": f"{PMT} {ANT} {macpo} --seed=440 --cost-limit={limit}" for limit in ("1", "0.2")}
    return (found, own) if macpo == AT_TEN else (own | found, {})


def _multiplier(logs: Iterable[RunLog]) -> str:
    """The rule: of those whose mean cost is at most 0.7 at a limit of 1 and 0.15 at 0.2 the highest reward at 1.

    If there is none, the least sum of mean cost divided by limit.
    """
    trials = _floors()
    for log in logs:
        trials.setdefault(_flags(log), {})[log.cost_limit] = _trial(log)
    trials = {flags: trial for flags, trial in trials.items() if len(trial) == 2}
    for flags, trial in trials.items():
        print(f"{flags}: {trial}")
    safe = [flags for flags, trial in trials.items() if trial[1.0].cost <= 0.7 and trial[0.2].cost <= 0.15]
    if safe:
        chosen = max(safe, key=lambda flags: trials[flags][1.0].reward)
    else:
        chosen = min(trials, key=lambda flags: trials[flags][1.0].cost + trials[flags][0.2].cost / 0.2)
    print(f"chosen, {len(safe)} meet both bounds: {chosen}")
    return chosen


def _macpo(logs: Iterable[RunLog]) -> str:
    """The rule: three of four seeds within 1 at a mean reward of at least 1,220, and of these the lowest mean cost."""
    trials = {tuple((log.settings | {"method": log.method})[name] for name in MACPO): _trial(log) for log in logs}
    print(f"MACPO: {trials}")
    kept = [setting for setting, trial in trials.items() if trial.within >= 3 and trial.reward >= 1220]
    if not kept:
        return AT_TEN
    best = min(kept, key=lambda setting: trials[setting].cost)
    flags = " ".join(f"--{name.replace('_', '-')}={value}" for name, value in zip(MACPO, best, strict=True))
    return f"{flags} {SPREAD}"


def _floors() -> dict[str, dict[float, Trial]]:
    """The trial of floors, whose episodes are not spread, as it was stored."""
    found: dict[str, dict[float, Trial]] = {}
    for limit, name in ((1.0, "floor_trial_one_h100"), (0.2, "floor_trial_fifth_h100")):
        for run in json.loads((RESULTS / f"{name}.json").read_text()):
            cost, reward = run["table"]["cost"], run["table"]["reward"]
            floor = run["label"].split("cost_std_floor=")[1]
            flags = f"{AVERAGE} --lambda-unit=relative --lambda-lr=0.005 --cost-std-floor={floor}"
            mean = Trial(sum(cost) / len(cost), sum(reward) / len(reward), sum(x <= 1 for x in cost))
            found.setdefault(flags, {})[limit] = mean
    return found


def _flags(log: RunLog) -> str:
    own = log.settings
    flags = f"{AVERAGE} {SPREAD} --lambda-unit={own['lambda_unit']} --lambda-lr={own['lambda_lr']:g}"
    if own["lambda_rule"] == "pid":
        flags += f" --lambda-rule=pid --lambda-kp={own['lambda_kp']:g}"
    return f"{flags} --cost-std-floor={own['cost_std_floor']:g}"


def _trial(log: RunLog) -> Trial:
    cost, reward = log.final("episode_cost"), log.final("episode_reward")
    assert cost is not None and reward is not None, f"{log.folder} has no costs or rewards"
    mean = float(cost.mean())
    # A seed that broke has nan: its setting is not to be chosen.
    return Trial(mean if math.isfinite(mean) else math.inf, float(reward.mean()), int((cost <= 1).sum()))


if __name__ == "__main__":
    for part in cells(pathlib.Path(sys.argv[1])):
        for name, command in part.items():
            print(name, command)
