"""Every method on the toys, whose optimum is known: mean of five seeds with 95 % bootstrap intervals.

    python -m bench.toys --out bench/results/toys.json        trains and writes (about four minutes on two cores)
    python -m bench.toys --from bench/results/toys.json       prints the table

Batches and steps are those of the specification's table (section 8.4): 64 environments and 120 updates on `lane`, 48
and 100 elsewhere; figures are means over the last 15 updates of the stochastic policy.
"""

from __future__ import annotations

import argparse
import pathlib
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pmt_jax import METHODS, load_config, make_train
from pmt_jax.studies.statistics import bootstrap_interval

from . import records
from .tables import markdown

SEEDS = 5
LAST = 15
SIZES = {
    "lane": {"num_envs": 64, "steps": 64 * 25 * 120},
    "switch": {"num_envs": 48, "steps": 48 * 25 * 100},
    "noisy": {"num_envs": 48, "steps": 48 * 25 * 100},
}


def measure(task: str, method: str, **changes: Any) -> dict[str, Any]:
    """Trains SEEDS seeds; episode cost and reward per seed, and seconds of compiling and running."""
    train = make_train(load_config(task, method=method, **{**SIZES[task], **changes}))
    keys = jax.vmap(jax.random.key)(jnp.arange(SEEDS))
    begin = time.monotonic()
    program = jax.jit(jax.vmap(train)).lower(keys).compile()
    compiled = time.monotonic()
    _, metrics = jax.block_until_ready(program(keys))
    ended = time.monotonic()
    figures = {name: np.asarray(metrics[name])[:, -LAST:].mean(1).round(4).tolist() for name in FIGURES}
    times = {"compile_seconds": round(compiled - begin, 2), "run_seconds": round(ended - compiled, 2)}
    return {"task": task, "method": method, "changes": changes, **figures, **times}


FIGURES = ("episode_cost", "episode_reward", "lambda")


def interval(values: list[float], digits: int = 2) -> str:
    """Mean and 95 % bootstrap interval over seeds."""
    low, high = bootstrap_interval([values], np.mean)
    return f"{np.mean(values):.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    body = [
        [
            row["task"],
            row["method"] + "".join(f", {k} = {v}" for k, v in row["changes"].items()),
            interval(row["episode_cost"]),
            interval(row["episode_reward"]),
        ]
        for row in rows
    ]
    return markdown(("task", "method", "episode cost", "episode reward"), body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--from", dest="source", type=pathlib.Path)
    arguments = parser.parse_args()
    if arguments.source:
        print(table(records.read(arguments.source)))
        return
    rows = []
    for task in SIZES:
        for method in METHODS:
            rows.append(measure(task, method))
            print(table(rows[-1:]).splitlines()[-1], flush=True)
    rows.append(measure("switch", "f4sg", fear_time="current"))
    rows.append(measure("noisy", "f4sg", fear_loss="gumbel_rev"))
    if arguments.out:
        records.write(arguments.out, rows)


if __name__ == "__main__":
    main()
