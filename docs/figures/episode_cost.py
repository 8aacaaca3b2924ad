"""When an episode costs: mean cost per step through the episodes of the pretrained policies (the paper's Fig. 6).

    python -m docs.figures.episode_cost             draws bench/results/episode_cost.json as docs/episode_cost.png
    python -m docs.figures.episode_cost --measure   evaluates the policies first, and stores what it draws

The mean over agents, as in an episode's cost; mean actions, 32 episodes a policy from starts that no training saw.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import tempfile

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench import records
from pmt_jax.policies import hub
from pmt_jax.policies.evaluate import evaluate_run
from pmt_jax.studies.plot import METHOD_COLOURS
from pmt_jax.training.compile import use_cache

from . import style

STORED = records.RESULTS / "episode_cost.json"
PICTURE = pathlib.Path(__file__).parents[1] / "episode_cost.png"
WINDOWS = {"ant_2x4": 50, "hand_over_2x6": 5}  # control steps that a point is the mean of
UNITS = {"ant_2x4": 0.05, "hand_over_2x6": 1 / 60}  # seconds of a control step
EPISODES = 32


def measure(task: str, method: str) -> list[float]:
    """Mean cost per step in each window, of the episodes that last so long."""
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "steps.npz"
        evaluate_run(pathlib.Path(f"hub:{task}/{method}"), EPISODES, deterministic=True, save=file)
        with np.load(file) as steps:
            cost, length = steps["cost"][0].sum(-1).mean(-1), steps["length"][0]
    running = np.arange(cost.shape[1]) < length[:, None]
    cut = cost.shape[1] // WINDOWS[task] * WINDOWS[task]
    parts = (np.where(running, cost, 0)[:, :cut], running[:, :cut])
    total, count = (x.sum(0).reshape(-1, WINDOWS[task]).sum(1) for x in parts)
    return [round(float(x), 4) for x in total / np.maximum(count, 1)]


def draw(found: dict[str, dict[str, list[float]]], file: pathlib.Path) -> None:
    """A panel a task: cost per step against the time in the episode, a line a method."""
    with rc_context(style.FONT):
        figure = Figure(figsize=(10, 4.2), layout="constrained")
        for axis, (task, methods) in zip(figure.subplots(1, len(found)), found.items(), strict=True):
            ends = []
            for method, costs in methods.items():
                time = (np.arange(len(costs)) + 0.5) * WINDOWS[task] * UNITS[task]
                axis.plot(time, costs, color=METHOD_COLOURS[method], lw=2)
                ends.append((method, costs[-1]))
            axis.set_title(f"{task}: cost per step", loc="left", fontsize=12, fontweight="bold")
            axis.set_xlabel("time in the episode (s)")
            axis.set_xlim(0, time[-1])
            axis.set_ylim(0)
            style.label_lines(axis, ends)
        figure.savefig(file, dpi=110)


def main() -> None:
    """Measures if asked to, and draws what is stored."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true", help="evaluate the pretrained policies first")
    if parser.parse_args().measure:
        use_cache()
        there = set(hub.names())
        found = {
            task: {method: measure(task, method) for method in METHOD_COLOURS if f"hub:{task}/{method}" in there}
            for task in WINDOWS
        }
        STORED.write_text(json.dumps(found) + "\n")
    draw(json.loads(STORED.read_text()), PICTURE)
    print(f"docs/{PICTURE.name}")


if __name__ == "__main__":
    main()
