"""`pmt` with MACPO whose cost surrogate is made of fear and whose trust region shrinks, on trial.

`kl_limit` is multiplied by the square of the share that is left of the learning rates: a trust region's radius is
MACPO's step size, and its square is a divergence.
"""

from __future__ import annotations

import dataclasses
import sys

import jax
import macpo_fear  # noqa: F401  # adds the method to the table

from pmt_jax.cli import main
from pmt_jax.config.settings import Hyper
from pmt_jax.learning import learner
from pmt_jax.learning.setup import Setup

plain = learner._annealed


def annealed(setup: Setup, hyper: Hyper, update: jax.Array) -> Hyper:
    rates = plain(setup, hyper, update)
    return dataclasses.replace(rates, kl_limit=hyper.kl_limit * (rates.critic_lr / hyper.critic_lr) ** 2)


learner._annealed = annealed
if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
