"""Environment steps per second of the whole training loop: methods, seeds side by side, memory, and how busy a GPU is.

    python -m bench.loop --out bench/results/loop_h200.json                     the methods on the ant, five seeds
    python -m bench.loop --cases ant_2x4:mappo_l:1x2048x8,ant_2x4:mappo_l:5x2048x8

A case is TASK:METHOD:SEEDSxENVSxLENGTH. `steps_per_second` counts the environment steps of all seeds: the median over
`--repeats` chunks of `--updates` updates, as `pmt train` compiles them. `memory_gb` is the device's peak in the process
so far (on a CPU the process's own), `gpu_busy` the mean of nvidia-smi's share of time with a kernel running.
"""

from __future__ import annotations

import argparse
import contextlib
import pathlib
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import jax

from pmt_jax import METHODS, load_config
from pmt_jax.learning.setup import make_setup
from pmt_jax.training.compile import compile_run
from pmt_jax.training.run_folder import MATMUL_PRECISION

from . import records, turns

GPU_SIZE, CPU_SIZE = "5x2048x8", "1x64x64"
PAPER = ["ant_2x4:mappo_l:1x384x32", "ant_2x4:mappo_l:5x384x32"]  # sizes of Table 1


def measure(case: str, updates: int, repeats: int, fixed: dict[str, Any]) -> dict[str, Any]:
    """One case's row."""
    task, method, size = case.split(":")
    seeds, num_envs, length = (int(x) for x in size.split("x"))
    sizes = {"seeds": seeds, "num_envs": num_envs, "rollout_length": length, "log_interval": updates}
    run = make_setup(load_config(task, method=method, **sizes, **fixed))
    begin = time.perf_counter()
    state, programs = compile_run(run, lambda _: None)
    contestant = turns.Contestant(state, programs.chunk, time.perf_counter() - begin)
    contestant.turn()
    with _busy() as busy:
        for _ in range(repeats):
            contestant.turn()
    middle = statistics.median(contestant.seconds[1:])
    return {
        "task": task,
        "method": method,
        "physics": run.vector.env.engine,
        "seeds": seeds,
        "num_envs": num_envs,
        "rollout_length": length,
        "epochs": run.config.epochs,
        "minibatches": run.config.minibatches,
        "steps_per_second": round(seeds * updates * run.config.batch_size / middle),
        "update_seconds": round(middle / updates, 4),
        "compile_seconds": round(contestant.compile_seconds, 1),
        "memory_gb": round(_memory() / 1e9, 2),
        **({"gpu_busy": round(statistics.mean(busy), 2)} if busy else {}),
    }


@contextlib.contextmanager
def _busy() -> Iterator[list[float]]:
    """Yields a list that is filled, at the end, with the GPU's utilisation (0 to 1) every 100 ms; empty without one."""
    found: list[float] = []
    if jax.devices()[0].platform != "gpu":
        yield found
        return
    command = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits", "-i", "0", "-lms", "100"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        yield found
        process.terminate()
        found += [float(line) / 100 for line in process.communicate()[0].splitlines() if line.strip().isdigit()]


def _memory() -> float:
    stats = jax.devices()[0].memory_stats()
    return stats["peak_bytes_in_use"] if stats else 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="", metavar="CASES", help="TASK:METHOD:SEEDSxENVSxLENGTH, with commas")
    parser.add_argument("--updates", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("fixed", nargs="*", metavar="SETTING=VALUE")
    arguments = parser.parse_intermixed_args()
    jax.config.update("jax_default_matmul_precision", MATMUL_PRECISION)
    gpu = jax.devices()[0].platform == "gpu"
    size = GPU_SIZE if gpu else CPU_SIZE
    every = [f"ant_2x4:mappo_l:1x{size.split('x', 1)[1]}", *(f"ant_2x4:{method}:{size}" for method in METHODS)]
    cases = [c for c in arguments.cases.split(",") if c] or every + PAPER * gpu
    rows = []
    for case in cases:
        rows.append(measure(case, arguments.updates, arguments.repeats, dict(x.split("=", 1) for x in arguments.fixed)))
        print(rows[-1], file=sys.stderr, flush=True)
        if arguments.out:
            records.write(arguments.out, rows)


if __name__ == "__main__":
    main()
