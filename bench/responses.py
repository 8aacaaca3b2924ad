"""Responses to regret at equal budget: does any of them lower cost at equal reward, and can Mixed beat its parts?

    python -m bench.responses lane switch noisy --out bench/results/responses_toys.json     ten minutes on two cores
    python -m bench.responses ant_2x4 --steps 3e5 --faster 4 --methods mappo_l r4sg f4sg \\
        --out bench/results/responses_ant.json                                              half an hour
    python -m bench.responses --from bench/results/responses_toys.json                      prints the table

Five seeds, the stochastic policy. Figures are per horizon (25 steps on the toys, 1,000 on the ant): costly steps over
the last eighth of training and over all of it, reward over the last eighth; means and 95 % bootstrap intervals.
MAPPO-Lagrangian with faster multipliers is there because a response that only adds to the price is no discovery.
"""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

import numpy as np

from pmt_jax import load_config, make_setup

from . import records
from .search import search
from .tables import markdown
from .toys import SIZES, interval

SEEDS = 5
ADVANTAGE = {"regret_response": "advantage", "regret_max": 0.8}
CONTESTANTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("mappo_l", {}),
    ("r4sg", {}),
    ("r4sg", {"regret_response": "one_sided"}),
    ("r4sg", ADVANTAGE),
    ("f4sg", {}),
    ("mixed", {}),
    ("mixed", ADVANTAGE),
)


def measure(task: str, method: str, changes: dict[str, Any], faster: tuple[float, ...]) -> list[dict[str, Any]]:
    """One row per multiplier step: the task's own `lambda_lr` times each of `faster`, all seeds in one program."""
    config = load_config(task, method=method, seeds=SEEDS, **changes)
    rates = [config.lambda_lr * times for times in faster]
    found = search({f"lambda_lr={rate:g}": config.replace(lambda_lr=rate) for rate in rates}, episodes=0)
    horizon = make_setup(config).vector.horizon
    costly = horizon * np.asarray(found["curves"]["violation_rate"], float)
    reward = horizon * np.asarray(found["curves"]["step_reward"], float)
    last = max(1, len(costly) // 8)
    rows = []
    for i, rate in enumerate(rates):
        mine = slice(i * SEEDS, (i + 1) * SEEDS)
        figures = {"cost": costly[-last:, mine], "cost_all": costly[:, mine], "reward": reward[-last:, mine]}
        means = {name: x.mean(0).round(4).tolist() for name, x in figures.items()}
        told = {k: v for k, v in changes.items() if k not in ("steps", "num_envs")}
        told |= {"lambda_lr": round(rate, 4)} if rate != config.lambda_lr else {}
        rows.append({"task": task, "method": method, "changes": told, "steps": found["steps"][-1], **means})
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    body = [
        [
            row["task"],
            row["method"] + "".join(f", {k} = {v}" for k, v in row["changes"].items()),
            *(interval(row[name]) for name in ("cost", "cost_all", "reward")),
        ]
        for row in rows
    ]
    return markdown(("task", "method", "cost at the end", "cost while training", "reward at the end"), body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*")
    parser.add_argument("--steps")
    parser.add_argument("--methods", nargs="+", default=["mappo_l", "r4sg", "f4sg", "mixed"])
    parser.add_argument("--faster", nargs="+", type=float, default=[2.0, 4.0, 8.0], help="times the task's lambda_lr")
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--from", dest="source", type=pathlib.Path)
    arguments = parser.parse_args()
    if arguments.source:
        print(table(records.read(arguments.source)))
        return
    rows = []
    for task in arguments.tasks:
        size = {**SIZES.get(task, {}), **({"steps": arguments.steps} if arguments.steps else {})}
        for method, changes in CONTESTANTS:
            if method not in arguments.methods:
                continue
            faster = (1.0, *arguments.faster) if method == "mappo_l" else (1.0,)
            new = measure(task, method, {**size, **changes}, faster)
            rows += new
            print(*table(new).splitlines()[2:], sep="\n", flush=True)
            if arguments.out:
                records.write(arguments.out, rows)


if __name__ == "__main__":
    main()
