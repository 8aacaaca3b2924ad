"""The form of the trial that the cells get, by the rule in docs/appendix/preregistration.md.

As a script: choose.py FOLDER..., a form's folder each, the form without a change first.
"""

from __future__ import annotations

import pathlib
import sys
from typing import NamedTuple

import numpy as np

from pmt_jax.studies.run_log import read_all
from pmt_jax.studies.statistics import iqm

END, CUT = 2e6, 4.0  # the last steps that are read; a cost counts as at most so many limits
LEAST_REWARD = 4501.0  # of the criterion


class Score(NamedTuple):
    """Mean of cost / limit over a form's runs, each cut, and the interquartile mean reward at a limit of 1."""

    cost: float
    reward: float


def form(folders: dict[str, pathlib.Path]) -> tuple[str, dict[str, Score]]:
    """The form with the least cost among those that earn enough, and all scores; the first form has no change.

    Forms without runs at both limits are left out.
    """
    scores = {name: score for name, folder in folders.items() if (score := _score(folder)) is not None}
    first, *_ = scores.values()
    # A form whose reward is not a number does not earn enough.
    earn = {name: score for name, score in scores.items() if score.reward >= 0.9 * first.reward} or scores
    earn = {name: score for name, score in earn.items() if score.reward >= LEAST_REWARD} or earn
    return min(earn, key=lambda name: earn[name].cost), scores


def _score(folder: pathlib.Path) -> Score | None:
    costs, rewards = [], {}
    for log in read_all([folder]) if folder.exists() else ():
        last = log.steps > log.steps[-1] - END
        cost = log.metrics["episode_cost"][:, last].mean(1) / log.cost_limit
        costs += [*np.where(cost < CUT, cost, CUT)]  # a seed that broke has nan, and counts as CUT
        rewards[log.cost_limit] = log.metrics["episode_reward"][:, last].mean(1)
    return Score(float(np.mean(costs)), iqm(rewards[1.0])) if len(rewards) > 1 else None


if __name__ == "__main__":
    found, of = form({pathlib.Path(folder).name: pathlib.Path(folder) for folder in sys.argv[1:]})
    for name, score in of.items():
        print(f"{name}: cost {score.cost:.3f} of the limit, reward {score.reward:,.0f}")
    print("chosen:", found)
