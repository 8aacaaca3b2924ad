"""Random search over traced settings: all draws train side by side in one program.

    python -m bench.search ant_2x4 --draws 32 --steps 1e6 --vary actor_lr=1e-4:2e-3,lambda_lr=0.3:30 --out found.json \\
        num_envs=64 env=observation=raw

    python -m bench.search --summarise found.json other.json --out bench/results/search_ant.json

Settings after the options are fixed for all draws; those of --vary are drawn log-uniformly from their ranges. Without
any, the draws are plain seeds. Every draw starts from its own seed, so a single good figure may be luck: confirm the
winner on fresh seeds before believing it.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import tempfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pmt_jax import Config, evaluate, load_config, make_setup
from pmt_jax.policies.load import load_run
from pmt_jax.studies import sweep

Ranges = dict[str, tuple[float, float]]  # name -> (lowest, highest)

CURVE = ("episode_reward", "episode_cost", "violation_rate", "lambda", "step_reward", "actor/std", "actor/kl_per_agent")


def draw(config: Config, draws: int, seed: int, ranges: Ranges) -> sweep.Points:
    """`draws` runs of one seed each, with random values of the settings in `ranges`."""
    rng = np.random.default_rng(seed)
    drawn = {name: np.exp(rng.uniform(np.log(low), np.log(high), draws)) for name, (low, high) in ranges.items()}
    return {
        f"draw{i:03}": config.replace(seeds=1, seed=seed + i, **{name: float(x[i]) for name, x in drawn.items()})
        for i in range(draws)
    }


def search(points: sweep.Points, episodes: int) -> dict[str, Any]:
    """Trains `points`, which share a program, side by side, then evaluates them over `episodes` episodes.

    Curves have one entry per chunk and lane (a seed of a point); evaluations are means over episodes, one per lane, of
    sampled and of mean actions.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = pathlib.Path(folder)
        if sweep.train_points(points, out):
            raise SystemExit(130)
        runs = [load_run(out / name) for name in points]
        logs = [[json.loads(line) for line in (out / name / "metrics.jsonl").open()] for name in points]
    trials = [[row for row in log if row["seed"] == seed] for log in logs for seed in sorted({r["seed"] for r in log})]
    first = trials[0]
    steps, seconds = ([row[name] for row in first] for name in ("step", "seconds"))
    rate = len(trials) * (steps[-1] - steps[0]) / max(seconds[-1] - seconds[0], 1e-9)
    names = [name for name in first[0] if name in CURVE or name.startswith(("info/", "fear/", "regret/"))]
    curves = {name: [[lane[i][name] for lane in trials] for i in range(len(first))] for name in names}
    found = {"steps": steps, "seconds": seconds, "steps_per_second": rate, "curves": curves}
    states = jax.tree.map(lambda *each: jnp.concatenate(each), *(state for _, state in runs))
    for how in ("sampled", "mean") if episodes else ():
        judge = jax.jit(jax.vmap(lambda s: evaluate(runs[0][0], s, episodes, deterministic=how == "mean")))  # noqa: B023
        found[f"evaluation_{how}"] = {k: x.mean(1).tolist() for k, x in jax.device_get(judge(states)).items()}
    return found


def summarise(found: dict[str, Any]) -> dict[str, Any]:
    """A search without its curves: per draw, reward and steps with cost per 1,000 steps over the last eighth."""
    last = max(1, len(found["steps"]) // 8)
    curves = found.pop("curves")
    reward = 1000 * np.asarray(curves["step_reward"], float)[-last:].mean(0)
    cost = 1000 * np.asarray(curves["violation_rate"], float)[-last:].mean(0)
    found["steps"], found["seconds"] = found["steps"][-1], found["seconds"][-1]
    found["drawn"] = {name: np.round(x, 6).tolist() for name, x in found["drawn"].items()}
    return {**found, "reward_per_1000": reward.round(1).tolist(), "costly_per_1000": cost.round(2).tolist()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?")
    parser.add_argument("--summarise", nargs="+", type=pathlib.Path, metavar="FILE")
    parser.add_argument("--method", default="mappo_l")
    parser.add_argument("--draws", type=int, default=32)
    parser.add_argument("--vary", default="", metavar="NAME=LOW:HIGH,...", help="which settings are drawn, from where")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", default="1e6")
    parser.add_argument("--episodes", type=int, default=0, help="evaluate every draw at the end over so many episodes")
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("fixed", nargs="*", metavar="SETTING=VALUE")
    arguments = parser.parse_intermixed_args()
    if arguments.summarise:
        searches = [{"name": p.stem, **summarise(json.loads(p.read_text()))} for p in arguments.summarise]
        arguments.out.write_text(json.dumps(searches, indent=0) + "\n")
        return
    fixed: dict[str, Any] = dict(pair.split("=", 1) for pair in arguments.fixed)
    if "env" in fixed:
        fixed["env"] = fixed["env"].split(",")
    config = load_config(arguments.task, method=arguments.method, steps=arguments.steps, **fixed)
    pairs = [pair.split("=") for pair in arguments.vary.split(",") if pair]
    ranges: Ranges = {name: (float(bounds.split(":")[0]), float(bounds.split(":")[1])) for name, bounds in pairs}
    points = draw(config, arguments.draws, arguments.seed, ranges)
    found = search(points, arguments.episodes)
    found["drawn"] = {name: [getattr(point, name) for point in points.values()] for name in ranges}
    found |= {"task": arguments.task, "method": arguments.method, "fixed": arguments.fixed}
    found |= {
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "engine": make_setup(config).vector.env.engine,
    }
    arguments.out.write_text(json.dumps(found))
    print(f"{found['steps_per_second']:,.0f} steps/s over all draws; written to {arguments.out}")


if __name__ == "__main__":
    main()
