"""Where ants go: paths through the corridor of a few episodes of each policy, and a picture of them.

    python -m docs.figures.ant_paths                                draws all that is stored in bench/results
    python -m docs.figures.ant_paths R4SG=hub:ant_2x4/r4sg runs/x   stores these, as ant_paths_methods.json, and draws

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
from pmt_jax.studies.plot import BLUE, METHOD_COLOURS
from pmt_jax.training.compile import use_cache

from . import style

ROOT = pathlib.Path(__file__).parents[2]
RESULTS = ROOT / "bench" / "results"
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
        panel.fill_between(x, wall - side * DANGER, wall + side * behind, color=style.DANGER, lw=0)
        panel.plot(x, wall, color=style.WALL, lw=1)
        if walls == "solid":
            panel.fill_between(x, wall, wall + side * THICKNESS, color=style.WALL, lw=0)


def draw(policies: list[dict[str, Any]], file: pathlib.Path) -> None:
    """One panel a policy: the corridor, where it costs, and the paths; two columns of more than four policies."""
    from matplotlib.figure import Figure

    across = 1 + (len(policies) > 4)
    down = -(-len(policies) // across)
    figure = Figure(figsize=(9 if across == 1 else 12, (2.4 if across == 1 else 2.0) * down), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True).ravel()
    for panel in panels[len(policies) :]:
        panel.set_axis_off()
    furthest = min(140.0, max(max(e["x"]) for policy in policies for e in policy["episodes"]) + 5)
    colours = {style.NAMES[method]: colour for method, colour in METHOD_COLOURS.items()}
    for panel, policy in zip(panels, policies, strict=False):
        _draw_walls(panel, policy.get("walls", "reference"), furthest)
        for episode in policy["episodes"]:
            panel.plot(episode["x"], episode["y"], color=colours.get(policy["title"], BLUE), lw=1, alpha=0.9)
        reward, cost = (np.mean([e[name] for e in policy["episodes"]]) for name in ("reward", "cost"))
        panel.set_title(f"{policy['title']}: reward {reward:,.0f}, cost {cost:.1f}", loc="left", fontsize=10)
        panel.set(ylim=(-25, 30), xlim=(-5, furthest))
    for panel in panels[::across]:
        panel.set_ylabel("y (m)")
    for panel in panels[-across:]:
        panel.set_xlabel("x (m)")
    figure.savefig(file, dpi=110)


def main(words: list[str] | None = None) -> None:
    """Records the paths of the policies that are named, if any, and draws those that are stored."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="*", metavar="[TITLE=]RUN[@SEED]")
    parser.add_argument("--json", type=pathlib.Path, help="where paths are stored (ant_paths_methods.json)")
    parser.add_argument("--png", type=pathlib.Path, help="the picture (docs/NAME.png for NAME.json)")
    arguments = parser.parse_args(words)
    use_cache()
    try:
        if arguments.policies:
            found = [paths(source, EPISODES) for source in arguments.policies]
            arguments.json = arguments.json or RESULTS / "ant_paths_methods.json"
            arguments.json.write_text(json.dumps(found) + "\n")
        for file in [arguments.json] if arguments.json else sorted(RESULTS.glob("ant_paths*.json")):
            draw(json.loads(file.read_text()), arguments.png or ROOT / "docs" / f"{file.stem}.png")
    except (OSError, UsageError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
