"""The form that the cells get, by the rule of "a trial of forms" in docs/appendix/preregistration.md.

As a script: choose.py FOLDER, which holds the trial's runs.
"""

from __future__ import annotations

import itertools
import pathlib
import sys
from typing import NamedTuple

import numpy as np

from pmt_jax.studies.run_log import RunLog, read_all

SWITCHES = {"entropy_coef": -0.01, "max_grad_norm": np.inf, "kl_half_life": 3.4e6}  # what each is when it is on
LAST, CUT = 2e6, 4.0  # the steps at the end that are read; a cost counts as at most so many limits
LEAST_REWARD = 4501.0  # of the criterion


class Form(NamedTuple):
    """Which switches are on, and what the fit says: cost / limit, and the reward at a limit of 1."""

    on: tuple[bool, ...]
    cost: float
    reward: float

    @property
    def settings(self) -> str:
        """As the command line has them."""
        return " ".join(
            f"--{name.replace('_', '-')}={value:g}"
            for on, (name, value) in zip(self.on, SWITCHES.items(), strict=True)
            if on
        )


def forms(folder: pathlib.Path) -> list[Form]:
    """All forms, best first.

    The costs of all runs and the rewards of those at 1 are fitted by least squares, with an effect for each switch. The
    best has the least cost among those whose reward is at least nine tenths of that without a switch, and at least
    LEAST_REWARD if any reaches that.
    """
    costs, rewards = list[tuple[np.ndarray, float]](), list[tuple[np.ndarray, float]]()
    for log in read_all([folder]):
        row = np.array([1.0, *(np.isclose(log.settings[name], value) for name, value in SWITCHES.items())])
        costs += [(row, min(cost / log.cost_limit, CUT)) for cost in _last(log, "episode_cost", CUT * log.cost_limit)]
        if log.cost_limit == 1:
            rewards += [(row, reward) for reward in _last(log, "episode_reward", 0.0)]
    of_cost, of_reward = _fit(costs), _fit(rewards)
    every = itertools.product((False, True), repeat=len(SWITCHES))
    found = [Form(on, float([1.0, *on] @ of_cost), float([1.0, *on] @ of_reward)) for on in every]
    reached = max(form.reward for form in found) >= LEAST_REWARD
    enough = max(0.9 * found[0].reward, LEAST_REWARD if reached else 0.0)
    return sorted(found, key=lambda form: (form.reward < enough, form.cost))


def _last(log: RunLog, metric: str, broken: float) -> list[float]:
    """A number a seed: the mean over the last steps, `broken` for a seed that has none."""
    mean = log.metrics[metric][:, log.steps > log.steps[-1] - LAST].mean(1)
    return [float(x) for x in np.where(np.isfinite(mean), mean, broken)]


def _fit(rows: list[tuple[np.ndarray, float]]) -> np.ndarray:
    """A constant and an effect for each switch."""
    of, values = zip(*rows, strict=True)
    return np.linalg.lstsq(np.array(of), np.array(values), rcond=None)[0]


if __name__ == "__main__":
    for form in forms(pathlib.Path(sys.argv[1])):
        print(f"cost {form.cost:.3f} of the limit, reward {form.reward:,.0f}: {form.settings or 'no switch'}")
