"""How noisy the cost advantage of a policy update is: of observed costs and of fear, by how seldom a cost is observed.

    python -m docs.figures.noise    trains, measures and writes bench/results/advantage_noise.json (15 minutes)
    python -m docs.figures.noise --updates 60 --json bench/results/advantage_noise_later.json    (26 minutes)

For each p and seed, F4SG trains for 30 updates on the CPU. Then the policy collects one batch. Its true costs are
thinned 32 times: a costly step is observed with probability p. Each thinning has two cost advantages. Both come from
the same GAE with the same values of the cost critic. MAPPO-Lagrangian's signal is the observed cost. F4SG's signal is
fear: its network starts from the same weights and is fitted to the thinning as in an update, with a shuffle of its own.

The main measures set the critic's values aside, with 0 in their place: the critic's error is the same for both signals
and for the truth, so it counts as signal, and it dominates a batch with few costs. The measures with the critic's
values are stored, too. What the noise does to the critic itself is not measured.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
import pathlib
import sys
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from bench import records
from pmt_jax import init, load_config, make_setup, tasks, train_step
from pmt_jax.config.settings import Hyper
from pmt_jax.learning import critics, fear, learner, schedules
from pmt_jax.learning.maths.advantages import gae
from pmt_jax.learning.rollout import flatten_steps
from pmt_jax.learning.setup import Setup
from pmt_jax.learning.types import LearnerState, Tag

STORED = records.RESULTS / "advantage_noise.json"
TASK, SEEDS, UPDATES, THINNINGS = "ant_2x4", (100, 101, 102), 30, 32
SHARES = (1.0, 0.3, 0.1, 0.03, 0.01)  # p, the probability that a costly step is observed
SIGNALS, VALUES = ("cost", "fear"), ("critic", "zero")
THINNED = max(Tag) + 1  # the tag of the thinnings' draws


def advantages(setup: Setup, hyper: Hyper, state: LearnerState) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Cost advantages of one batch: of its true cost times p, and of each thinning.

    The true cost is multiplied by p, so that it is the mean of the thinnings and fits the critic's unit.

    Returns:
      true [2, T, B, N, K] and drawn [THINNINGS, 2, 2, T, B, N, K], in units of observed cost. The last axis of two is
      VALUES: the critic's values, or 0 in their place. The one before it is SIGNALS. Last, the true cost per step [].
    """
    key = jax.random.fold_in(state.key, state.update)
    now = schedules.at(setup.config, hyper, state.update)
    state, batch = learner.act(setup, hyper, state, {tag: jax.random.fold_in(key, tag) for tag in Tag})
    values = critics.values(state.cost_critic, setup.nets.cost_value, critics.inputs(batch))
    zeros = (jnp.zeros_like(batch.cost), jnp.zeros_like(batch.cost))
    ends = (batch.terminated, batch.done, hyper.gamma, hyper.gae_lambda)

    def both(signal: jax.Array) -> jax.Array:
        return jnp.stack([gae(signal, value, following, *ends)[0] for value, following in (values, zeros)])

    def thinned(key: jax.Array) -> jax.Array:
        observed = tasks.observed_cost(flatten_steps(batch.true_cost), key, hyper.cost_seen).reshape(batch.cost.shape)
        seen = dataclasses.replace(batch, cost=observed)
        _, feared, _ = fear.appraise_fear(setup, hyper, now, state.fear, seen, jax.random.fold_in(key, Tag.FEAR))
        return jnp.stack([both(observed), both(feared)])

    drawn = jax.lax.map(thinned, jax.random.split(jax.random.fold_in(key, THINNED), THINNINGS))
    return both(hyper.cost_seen * batch.true_cost), drawn, batch.true_cost.mean()


def measures(drawn: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """How noisy and how true an advantage is; every thinning and agent is centred first, as in the policy update.

    noise_share: variance across thinnings, mean over rows, over the variance across rows and thinnings. correlation: of
    one thinning with the truth, over rows, mean over thinnings; 0 if the thinning has no variance. slope: of the
    thinnings' regression on the truth, 1 if unbiased. std: standard deviation across rows and thinnings, in observed
    cost.

    Args:
      drawn: [THINNINGS, T, B, N, K]; true: [T, B, N, K].
    """
    centred = drawn - drawn.mean((1, 2), keepdims=True)
    variance = (centred**2).mean()
    noise = centred.var(0, ddof=1).mean()
    rows, truth = centred.reshape(len(drawn), -1), (true - true.mean((0, 1))).ravel()
    products, norms = rows @ truth, np.linalg.norm(rows, axis=1) * np.linalg.norm(truth)
    correlations = np.divide(products, norms, out=np.zeros_like(products), where=norms > 0)
    found = {"noise_share": noise / variance, "correlation": correlations.mean()}
    found |= {"slope": products.mean() / (truth @ truth), "std": variance**0.5}
    return {name: float(f"{x:.4g}") for name, x in found.items()}


def measure(shares: Sequence[float], seeds: Sequence[int], updates: int) -> records.Records:
    """A row for each p, seed, signal and choice of values."""
    config = load_config(TASK, method="f4sg", physics="mujoco")
    setup = make_setup(config)
    update, look = (jax.jit(functools.partial(f, setup)) for f in (train_step, advantages))
    found: records.Records = []
    for p, seed in itertools.product(shares, seeds):
        thinned = dataclasses.replace(config, cost_seen=p, lambda_lr=config.lambda_lr / p)
        hyper = dataclasses.replace(setup, config=thinned).hyper  # the same program for every p
        state = init(setup, hyper, jax.random.key(seed))
        for _ in range(updates):
            state, _ = update(hyper, state)
        true, drawn, step_cost = (np.asarray(x, np.float64) for x in look(hyper, state))
        about = {"task": TASK, "p": p, "seed": seed, "updates": updates, "true_step_cost": round(float(step_cost), 4)}
        for (i, signal), (j, values) in itertools.product(enumerate(SIGNALS), enumerate(VALUES)):
            found.append({**about, "signal": signal, "values": values, **measures(drawn[:, i, j], true[j])})
            print(found[-1], flush=True)
    return found


def main(words: list[str] | None = None) -> None:
    """Measures, and stores the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=pathlib.Path, default=STORED, help="where the rows are stored")
    parser.add_argument("--updates", type=int, default=UPDATES, help=f"of the training (default {UPDATES})")
    arguments = parser.parse_args(words)
    rows = measure(SHARES, SEEDS, arguments.updates)
    records.write(arguments.json, rows, " ".join(["python -m docs.figures.noise", *(words or sys.argv[1:])]))


if __name__ == "__main__":
    main()
