"""Where fear looks: the mean fear of a trained fear network over the corridor, and a picture of it.

    python -m docs.figures.fear_map          draws bench/results/fear_map.json
    python -m docs.figures.fear_map RUN      computes it from a run of F4SG or Mixed on an ant first

The network sees the whole state of the ant. Each pixel is therefore a mean over poses: the joint angles and velocities
of the trained policy's own episodes, with the ant put at the pixel's place.
"""

from __future__ import annotations

import argparse
import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.ant import corridor
from envs.ant.walls import DANGER, FOLDS, HALF_WIDTH
from pmt_jax.errors import UsageError
from pmt_jax.learning.types import LearnerState
from pmt_jax.policies.load import load_run
from pmt_jax.render.episode import record_run

ROOT = pathlib.Path(__file__).parents[2]
STORED = ROOT / "bench" / "results" / "fear_map.json"
X, Y = np.arange(-4.75, 70.0, 0.5), np.arange(-20.0, 25.0, 0.5)  # m
POSES, EPISODES = 128, 4


def fear_map(run: pathlib.Path) -> dict[str, Any]:
    """Mean fear [len(Y)][len(X)] of the run's first seed, over agents and poses.

    Raises:
      UsageError: the run has no fear network, or is not an ant's.
    """
    setup, state = load_run(run)
    if not isinstance(state, LearnerState) or state.fear is None:
        raise UsageError(f"{run} has no fear network; take a run folder of f4sg or mixed")
    recorded = [record_run(run, None, number).raw for number in range(EPISODES)]
    if "torso_xpos" not in recorded[0]:
        raise UsageError(f"{run} is not an ant's run; the map is drawn over the ant's corridor")
    poses = {name: np.concatenate([np.asarray(raw[name]) for raw in recorded]) for name in ("qpos", "qvel")}
    chosen = np.linspace(0, len(poses["qpos"]) - 1, POSES).astype(int)
    qpos, qvel = (jnp.asarray(poses[name][chosen]) for name in ("qpos", "qvel"))
    params, moments = jax.tree.map(lambda x: x[0], (state.fear.params, state.state_moments))
    env: Any = setup.vector.env

    def fear(x: jax.Array, y: jax.Array) -> jax.Array:
        there = qpos.at[:, 0].set(x).at[:, 1].set(y)
        seen = jax.vmap(lambda q, v: env.restore(q, v).global_state)(there, qvel)
        return jax.nn.sigmoid(setup.nets.fear(params, setup.scale(moments, seen))).mean()

    over = jax.jit(jax.vmap(jax.vmap(fear, (0, None)), (None, 0)))
    mean = np.asarray(over(jnp.asarray(X, jnp.float32), jnp.asarray(Y, jnp.float32)))
    settings = {name: getattr(setup.config, name) for name in ("method", "seed", "steps", "cost_seen")}
    return {
        "task": setup.vector.spec.name,
        **settings,
        "x": X.tolist(),
        "y": Y.tolist(),
        "fear": mean.round(4).tolist(),
    }


def draw(found: dict[str, Any], file: pathlib.Path) -> None:
    """The map, the walls as lines and the edge of danger dashed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    panel = figure.subplots()
    x, y = np.array(found["x"]), np.array(found["y"])
    shown = panel.pcolormesh(x, y, np.array(found["fear"]), cmap="cividis", vmin=0, vmax=1, shading="nearest")
    x = x[x != FOLDS[1]]  # exactly there the centre line jumps (`off_centre`)
    centre = -np.asarray(corridor.off_centre(jnp.asarray(x), jnp.zeros(x.shape)))
    for side in (-1, 1):
        panel.plot(x, centre + side * HALF_WIDTH, color="white", lw=1.5)
        for edge in (-DANGER, DANGER):
            panel.plot(x, centre + side * (HALF_WIDTH + edge), color="white", lw=0.8, ls="--")
    panel.set(xlabel="x (m)", ylabel="y (m)", ylim=(y[0], y[-1]), xlim=(x[0], x[-1]))
    figure.colorbar(shown, label="mean fear (probability of a cost)")
    figure.savefig(file, dpi=110)


def main(words: list[str] | None = None) -> None:
    """Computes the map if a run is named, and draws it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", type=pathlib.Path)
    arguments = parser.parse_args(words)
    try:
        if arguments.run:
            STORED.write_text(json.dumps(fear_map(arguments.run), separators=(",", ":")) + "\n")
        draw(json.loads(STORED.read_text()), ROOT / "docs" / "fear_map.png")
    except (OSError, UsageError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
