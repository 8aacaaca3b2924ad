"""How well a cost critic knows the costs to come, with a clip on its values and without: RUN [UPDATES].

The policies of a trained run act and do not change. Critics that begin as the run's own are fitted to the same batches,
as in training six million steps in. In the second half of the batches their values are compared with the discounted
costs that really followed.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np

from pmt_jax.learning import learner
from pmt_jax.learning.maths.advantages import gae
from pmt_jax.learning.types import Batch, Critic, LearnerState, Tag
from pmt_jax.training import run_folder
from pmt_jax.training.compile import use_cache

STEPS = 6e6  # the learning rate is that of a run after so many steps
FUTURE = 300  # last steps that have too little future to be judged by


def main(run: pathlib.Path, updates: int = 90) -> None:
    """Prints a line for each seed and clip: moments of values and of true costs, slope, explained share."""
    jax.config.update("jax_default_matmul_precision", run_folder.MATMUL_PRECISION)
    use_cache()
    setup, _, saved = run_folder.load_saved(run)
    state = jax.tree.map(jnp.asarray, saved["last"])
    hyper = learner._annealed(setup, setup.hyper, jnp.asarray(int(STEPS / setup.config.batch_size)))

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    def act(state: LearnerState, k: jax.Array) -> tuple[LearnerState, Batch]:
        key = jax.random.fold_in(jax.random.fold_in(state.key, state.update), k)
        after, batch = learner._act(setup, hyper, state, {tag: jax.random.fold_in(key, tag) for tag in Tag})
        return dataclasses.replace(state, rollout=after.rollout), batch

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, 0, None, None))
    def fit(critic: Critic, batch: Batch, clip: jax.Array, key: jax.Array) -> tuple[Critic, jax.Array]:
        value, next_value = learner._values(critic, setup.nets.cost_value, batch)
        ends = (batch.terminated, batch.done, hyper.gamma, hyper.gae_lambda)
        _, returns = gae(batch.cost, value, next_value, *ends)
        rows = (batch.state, value, returns)
        return learner._fit_critic(setup, hyper, critic, setup.nets.cost_value, clip, rows, key)[0], value[..., 0, 0]

    critics = {str(clip): (clip, state.cost_critic) for clip in (round(float(hyper.clip), 2), math.inf)}
    values: dict[str, list[np.ndarray]] = {name: [] for name in critics}
    costs, done = [], []
    for k in range(updates):
        state, batch = act(state, jnp.uint32(k))
        costs.append(np.asarray(batch.cost[..., 0, 0]))
        done.append(np.asarray(batch.done))
        for name, (clip, critic) in critics.items():
            critic, value = fit(critic, batch, jnp.float32(clip), jax.random.key(k))
            critics[name] = clip, critic
            values[name].append(np.asarray(value))
    # Advantages over values of 0 with a trace that does not decay are the discounted costs up to an episode's end.
    follows = jax.vmap(lambda cost, done: gae(cost, 0.0, 0.0, done, done, hyper.gamma, 1.0)[0])
    future = np.asarray(follows(np.concatenate(costs, 1), np.concatenate(done, 1)))
    judged = slice(future.shape[1] // 2, future.shape[1] - FUTURE)
    for name in critics:
        for seed, (value, truth) in enumerate(zip(np.concatenate(values[name], 1), future, strict=True)):
            _report(f"seed {seed}, cost_value_clip {name}:", value[judged].ravel(), truth[judged].ravel())


def _report(name: str, value: np.ndarray, truth: np.ndarray) -> None:
    slope = np.cov(value, truth)[0, 1] / value.var()
    explained = 1 - np.var(truth - value) / np.var(truth)
    print(
        name,
        f"value {value.mean():.3f} +- {value.std():.3f}, true {truth.mean():.3f} +- {truth.std():.3f},",
        f"slope of the truth over the value {slope:.2f}, share of the variance explained {explained:.2f}",
    )


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), *map(int, sys.argv[2:3]))
