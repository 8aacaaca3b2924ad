"""How long a policy's ants are in danger at a time, and what the noise of actions has to do with it: RUN [SCALE ...].

RUN is a run folder (its first seed acts) or a pretrained policy. Each SCALE multiplies the noise, 0 is the mean action.
"""

from __future__ import annotations

import functools
import pathlib
import sys

import jax
import numpy as np

from pmt_jax.learning import rollout
from pmt_jax.policies.load import load_seed
from pmt_jax.training import run_folder
from pmt_jax.training.compile import use_cache

STEPS, PIECE = 2000, 50  # of each environment, and of one call
STILL, LATER = 0.3, 100  # an ant that moves less than so many metres along x in so many steps stands
LONG = 50  # steps of a long burst


def main(run: pathlib.Path, scales: list[float]) -> None:
    """Prints a line for each scale."""
    jax.config.update("jax_default_matmul_precision", run_folder.MATMUL_PRECISION)
    use_cache()
    setup, _, acting = load_seed(run)

    @jax.jit
    def act(
        state: rollout.RolloutState, key: jax.Array, scale: jax.Array | float
    ) -> tuple[rollout.RolloutState, dict[str, jax.Array]]:
        def policy(obs: jax.Array) -> tuple[jax.Array, jax.Array]:
            mean, std = setup.nets.policies(acting.actor.params, obs)
            return mean, scale * std

        normalise = functools.partial(setup.scale, acting.obs_moments)
        state, batch, _ = rollout.collect(setup.vector, state, policy, (normalise, lambda x: x), key, PIECE)
        x = batch.info["x_position"]
        return state, {"cost": batch.true_cost[..., 0, 0], "reward": batch.reward, "done": batch.done, "x": x}

    for scale in scales:
        state = rollout.start(setup.vector, jax.random.key(0), spread=True)
        pieces = []
        for piece in range(STEPS // PIECE):
            state, seen = act(state, jax.random.fold_in(jax.random.key(1), piece), scale)
            pieces.append(jax.device_get(seen))
        seen = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
        lengths = bursts(seen["cost"] > 0, seen["done"])
        print(
            f"noise x {scale:g}: of 1,000 steps {1000 * seen['cost'].mean():.2f} cost,",
            f"{1000 * standing(seen['x'], seen['done']):.1f} stand; reward a step {seen['reward'].mean():.2f};",
            f"{len(lengths)} bursts, the longest {lengths[:5].tolist()},",
            f"share of costs in bursts above {LONG} steps {lengths[lengths > LONG].sum() / lengths.sum():.2f}",
            flush=True,
        )


def bursts(costly: np.ndarray, done: np.ndarray) -> np.ndarray:
    """Lengths of uninterrupted costs [T, B] within episodes, longest first."""
    before = np.zeros_like(costly)
    before[1:] = costly[:-1] & ~done[:-1]
    burst = np.cumsum((costly & ~before).T.ravel())  # environment after environment: a burst keeps its number
    return np.sort(np.bincount(burst[costly.T.ravel()])[1:])[::-1]


def standing(x: np.ndarray, done: np.ndarray) -> float:
    """Share of the steps after which an ant is where it was, of those with no end of an episode in between."""
    ended = np.cumsum(np.pad(done, ((1, 0), (0, 0))), 0)
    same = ended[LATER:-1] == ended[: -LATER - 1]
    return float((np.abs(x[LATER:] - x[:-LATER]) < STILL)[same].mean())


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), [float(scale) for scale in sys.argv[2:]] or [1.0])
