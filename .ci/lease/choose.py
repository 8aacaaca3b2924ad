"""The cells of MACPO in the study of limits, with the settings that its trial chooses (preregistration.md).

`cells(FOLDERS)` reads the trial's folders, as the queue of a lease does when it has ended. As a script:
choose.py FOLDER..., which prints them.
"""

from __future__ import annotations

import math
import pathlib
import sys
from collections.abc import Sequence
from typing import NamedTuple

import macpo_fear  # noqa: F401  # adds the method to the table, so that its runs can be read
from jobs import ANT, AT_TEN, FORM

from pmt_jax.studies.run_log import RunLog, read_all


class Trial(NamedTuple):
    """Mean cost and reward of the last tenth of the steps, and how many seeds are within the limit."""

    cost: float
    reward: float
    within: int


def cells(folders: Sequence[pathlib.Path]) -> tuple[dict[str, str], bool]:
    """{name: command} of the cells at 1 and 0.2, and whether a form of the trial kept 1.

    The rule: three of four seeds within 1 at a mean reward of at least 1,220, and of these forms the lowest mean cost.
    """
    trials = {log.settings["kl_limit"]: _trial(log) for log in read_all(folders)}
    print(trials, flush=True)
    kept = [kl_limit for kl_limit, trial in trials.items() if trial.within >= 3 and trial.reward >= 1220]
    if kept:
        best = min(kept, key=lambda kl_limit: trials[kl_limit].cost)
        start = f".ci/lease/macpo_shrink.py {ANT} {FORM} --kl-limit={best:g}"
    else:
        start = f"-m pmt_jax {ANT} {AT_TEN}"
    return {f"limits/macpo-{limit}": f"{start} --seed=440 --cost-limit={limit}" for limit in ("1", "0.2")}, bool(kept)


def _trial(log: RunLog) -> Trial:
    cost, reward = log.final("episode_cost"), log.final("episode_reward")
    assert cost is not None and reward is not None, f"{log.folder} has no costs or rewards"
    mean = float(cost.mean())
    # A seed that broke has nan: its form is not to be chosen.
    return Trial(mean if math.isfinite(mean) else math.inf, float(reward.mean()), int((cost <= log.cost_limit).sum()))


if __name__ == "__main__":
    for name, command in cells([pathlib.Path(folder) for folder in sys.argv[1:]])[0].items():
        print(name, command)
