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
import dataclasses
import json
import pathlib
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pmt_jax import evaluate, learner, load_config, setup
from pmt_jax.run import Run

Ranges = dict[str, tuple[float, float]]  # name -> (lowest, highest)

CURVE = ("episode_reward", "episode_cost", "violation_rate", "lambda", "step_reward", "actor/std", "actor/kl_per_agent")


def draw(run: Run, draws: int, seed: int, ranges: Ranges) -> Any:
    """The run's settings with `draws` random values of those in `ranges`: leaves [draws]."""
    rng = np.random.default_rng(seed)
    hyper = jax.tree.map(lambda x: jnp.broadcast_to(x, (draws,)), run.hyper)
    drawn = {
        n: jnp.asarray(np.exp(rng.uniform(np.log(r[0]), np.log(r[1]), draws)), jnp.float32) for n, r in ranges.items()
    }
    return dataclasses.replace(hyper, **drawn)


def search(run: Run, hyper: Any, draws: int, seed: int, seconds: float, episodes: int) -> dict[str, Any]:
    """Trains every draw until its steps are done or the time is up, then evaluates it over `episodes` episodes.

    Curves have one entry per chunk and draw; evaluations are means over episodes, one per draw, of sampled and of mean
    actions.
    """
    config = run.config
    keys = jax.vmap(jax.random.key)(jnp.arange(seed, seed + draws))
    begin = time.monotonic()
    state = jax.jit(jax.vmap(lambda h, k: learner.init(run, h, k)))(hyper, keys)
    chunk = jax.jit(jax.vmap(lambda h, s: learner.train_chunk(run, h, s, config.log_interval)), donate_argnums=1)
    curves: dict[str, list[list[float | None]]] = {}
    marks = []
    for done in range(config.num_chunks):
        state, metrics = chunk(hyper, state)
        metrics = jax.device_get(metrics)
        for name in metrics:
            if name not in CURVE and not name.startswith(("info/", "fear/", "regret/")):
                continue
            curves.setdefault(name, [])
            values = np.asarray(metrics[name]).reshape(draws, -1)
            curves[name].append([float(np.nanmean(row)) if np.isfinite(row).any() else None for row in values])
        marks.append(round(time.monotonic() - begin, 2))
        if done % 10 == 0:
            print(f"{config.task} chunk {done + 1}/{config.num_chunks}, {marks[-1]} s", flush=True)
        if marks[-1] > seconds:
            break
    steps = [(i + 1) * config.batch_size * config.log_interval for i in range(len(marks))]
    rate = draws * (steps[-1] - steps[0]) / max(marks[-1] - marks[0], 1e-9)
    found = {"steps": steps, "seconds": marks, "steps_per_second": rate, "curves": curves}
    for how in ("sampled", "mean") if episodes else ():
        judge = jax.jit(jax.vmap(lambda s: evaluate(run, s, episodes, deterministic=how == "mean")))  # noqa: B023
        found[f"evaluation_{how}"] = {k: x.mean(1).tolist() for k, x in jax.device_get(judge(state)).items()}
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
    parser.add_argument("--seconds", type=float, default=600.0)
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
    jax.config.update("jax_default_matmul_precision", "highest")
    run = setup(load_config(arguments.task, method=arguments.method, steps=arguments.steps, **fixed))
    pairs = [pair.split("=") for pair in arguments.vary.split(",") if pair]
    ranges: Ranges = {name: (float(bounds.split(":")[0]), float(bounds.split(":")[1])) for name, bounds in pairs}
    hyper = draw(run, arguments.draws, arguments.seed, ranges)
    found = search(run, hyper, arguments.draws, arguments.seed, arguments.seconds, arguments.episodes)
    found["drawn"] = {n: np.asarray(getattr(hyper, n)).tolist() for n in ranges}
    found |= {"task": arguments.task, "method": arguments.method, "fixed": arguments.fixed}
    found |= {"device": jax.devices()[0].device_kind, "jax": jax.__version__, "engine": run.vector.env.engine}
    arguments.out.write_text(json.dumps(found))
    print(f"{found['steps_per_second']:,.0f} steps/s over all draws; written to {arguments.out}")


if __name__ == "__main__":
    main()
