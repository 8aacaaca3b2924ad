"""What an emotion or a trust region costs: seconds of compiling and per update of every method, at equal batch.

    python -m bench.methods --out bench/results/methods.json     about ten minutes on two cores

Methods take turns, one update each; figures are medians over rounds, ratios are medians over rounds of the ratio to
MAPPO-Lagrangian in the same round. `ant_2x4` is the whole training loop; `switch` with the ant's batch and networks has
an environment that costs next to nothing, so it shows the learner alone. Compiled without the cache on disk.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import statistics
import time
from typing import Any

import jax

from pmt_jax import METHODS, load_config, make_setup
from pmt_jax.learning import learner

from . import records, turns
from .tables import of_methods

REFERENCE = "mappo_l"
SIZE = {"num_envs": 64, "rollout_length": 64, "epochs": 5, "minibatches": 8, "hidden": (128, 128), "log_interval": 1}
LIKE_THE_ANT = SIZE | {"activation": "relu", "layer_norm": True}
TASKS: dict[str, dict[str, Any]] = {"ant_2x4": SIZE, "switch": LIKE_THE_ANT}


@dataclasses.dataclass
class Contestant(turns.Contestant):
    """A method's compiled update."""

    method: str


def enter(task: str, method: str) -> Contestant:
    """Compiles one update of a method on a task."""
    run = make_setup(load_config(task, method=method, **TASKS[task]))
    state = jax.jit(lambda key: learner.init(run, run.hyper, key))(jax.random.key(0))
    begin = time.perf_counter()
    update = jax.jit(lambda s: learner.train_chunk(run, run.hyper, s, 1)).lower(state).compile()
    return Contestant(state, update, time.perf_counter() - begin, method)


def measure(task: str, rounds: int) -> list[dict[str, Any]]:
    """A row per method."""
    contestants = [enter(task, method) for method in METHODS]
    for _ in range(rounds + 2):
        for contestant in contestants:
            contestant.turn()
    reference = next(c for c in contestants if c.method == REFERENCE)
    batch = SIZE["num_envs"] * SIZE["rollout_length"]
    rows = []
    for c in contestants:
        seconds, against = c.seconds[2:], reference.seconds[2:]  # the first turns warm up
        rows.append(
            {
                "task": task,
                "method": c.method,
                "compile_seconds": round(c.compile_seconds, 2),
                "compile_ratio": round(c.compile_seconds / reference.compile_seconds, 2),
                "update_seconds": round(statistics.median(seconds), 4),
                "update_ratio": round(statistics.median(x / y for x, y in zip(seconds, against, strict=True)), 3),
                "steps_per_second": round(batch / statistics.median(seconds)),
                "throughput_ratio": round(statistics.median(y / x for x, y in zip(seconds, against, strict=True)), 3),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--out", type=pathlib.Path)
    arguments = parser.parse_args()
    rows = []
    for task in arguments.tasks:
        rows += measure(task, arguments.rounds)
        print(of_methods(rows), flush=True)
    if arguments.out:
        records.write(arguments.out, rows)


if __name__ == "__main__":
    main()
