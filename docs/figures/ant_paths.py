"""Where ants go: paths through the corridor of a few episodes of each policy, and a picture of them.

    python -m docs.figures.ant_paths                                draws docs/ant_paths.png from bench/results
    python -m docs.figures.ant_paths R4SG=hub:ant_2x4/r4sg runs/x   of other policies, which it stores there first

Every episode is the seed's `last` policy from one of the fixed starts of evaluations, actions sampled. A run's first
seed is shown; `NAME=FOLDER` gives a policy a title, `FOLDER@3` takes seed 3.
"""

from __future__ import annotations

import argparse
import json
import pathlib
from typing import Any

import jax.numpy as jnp
import numpy as np

from envs.ant import corridor
from envs.ant.walls import COSTLY_REACH, DANGER, HALF_WIDTH, THICKNESS
from pmt_jax.errors import UsageError
from pmt_jax.render.episode import record_run
from pmt_jax.training.compile import use_cache

ROOT = pathlib.Path(__file__).parents[2]
EPISODES = 6
EVERY = 10  # control steps between two points of a path


def paths(source: str, episodes: int) -> dict[str, Any]:
    """A policy's episodes: title, its task's walls, and for each its path [points] of x, y in m, its reward and cost.

    Raises:
      UsageError: there is no such run, or it is not an ant's.
    """
    title, place = "", source
    if not pathlib.Path(source.partition("@")[0]).exists() and "=" in source:  # a sweep's folders have an = themselves
        title, _, place = source.partition("=")
    place, _, seed = place.partition("@")
    found, walls = [], "reference"
    for number in range(episodes):
        episode = record_run(pathlib.Path(place), int(seed) if seed else None, number)  # hub:... survives a Path
        if "torso_xpos" not in episode.raw:
            raise UsageError(f"{place} is a run of {episode.env.spec.name}; paths are drawn of ants only")
        ant: Any = episode.env
        walls = ant.walls
        x, y, _ = np.asarray(episode.raw["torso_xpos"])[::EVERY].round(2).T
        found.append(
            {
                "x": x.tolist(),
                "y": y.tolist(),
                "reward": round(float(episode.reward_sum[-1]), 1),
                "cost": round(float(episode.cost_sum[-1]), 1),
            }
        )
    return {"title": title or place, "walls": walls, "episodes": found}


def _draw_walls(panel: Any, walls: str, furthest: float) -> None:
    """Where a step costs, and the walls' lines; solid walls as thick as they are."""
    x = np.linspace(-5, furthest, 500)
    centre = -np.asarray(corridor.off_centre(jnp.asarray(x), jnp.zeros(x.shape)))
    behind = {"reference": DANGER, "costly": 2 * COSTLY_REACH, "solid": 0.0}[walls]
    for side in (-1, 1):
        wall = centre + side * HALF_WIDTH
        panel.fill_between(x, wall - side * DANGER, wall + side * behind, color="#f3c6c0", lw=0)
        panel.plot(x, wall, color="#a33", lw=1)
        if walls == "solid":
            panel.fill_between(x, wall, wall + side * THICKNESS, color="#a33", lw=0)


def draw(policies: list[dict[str, Any]], file: pathlib.Path) -> None:
    """One panel a policy: the corridor, where it costs, and the paths."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.4 * len(policies)), layout="constrained")
    panels = figure.subplots(len(policies), squeeze=False, sharex=True)[:, 0]
    furthest = min(140.0, max(max(e["x"]) for policy in policies for e in policy["episodes"]) + 5)
    for panel, policy in zip(panels, policies, strict=True):
        _draw_walls(panel, policy.get("walls", "reference"), furthest)
        for episode in policy["episodes"]:
            panel.plot(episode["x"], episode["y"], color="#25557f", lw=0.9, alpha=0.8)
        reward, cost = (np.mean([e[name] for e in policy["episodes"]]) for name in ("reward", "cost"))
        panel.set_title(f"{policy['title']}: reward {reward:,.0f}, cost {cost:.1f}", loc="left", fontsize=10)
        panel.set(ylabel="y (m)", ylim=(-25, 30), xlim=(-5, furthest))
    panels[-1].set_xlabel("x (m)")
    figure.savefig(file, dpi=110)


def main(words: list[str] | None = None) -> None:
    """Records the paths of the policies that are named, if any, and draws those that are stored."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="*", metavar="[TITLE=]RUN[@SEED]")
    parser.add_argument("--json", type=pathlib.Path, default=ROOT / "bench" / "results" / "ant_paths.json")
    parser.add_argument("--png", type=pathlib.Path, default=ROOT / "docs" / "ant_paths.png")
    arguments = parser.parse_args(words)
    use_cache()
    try:
        if arguments.policies:
            found = [paths(source, EPISODES) for source in arguments.policies]
            arguments.json.write_text(json.dumps(found) + "\n")
        draw(json.loads(arguments.json.read_text()), arguments.png)
    except (OSError, UsageError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
