"""Weak and strong scaling of the whole training loop over 1, 2, 4 ... of the devices that JAX sees.

    python -m bench all --only scaling
    XLA_FLAGS=--xla_force_host_platform_device_count=2 JAX_PLATFORMS=cpu python -m bench.scaling --tasks switch

| scaling | D devices train | each device has |
|---|---|---|
| weak, environments | one seed of D x B environments | B environments |
| weak, seeds | D seeds of B environments | a seed |
| strong | one seed of B environments | B / D environments |

`steps_per_second` counts the environment steps of all seeds, the median over `--repeats` rounds, in which the programs
of a task take turns (they are compiled together). `efficiency` is that over D times the rate of one device with one
seed of B environments, of which weak scaling keeps 1 where devices do not slow each other down. Devices made of one CPU
by XLA_FLAGS share its cores, so there the figures show that it runs, not how well. Results are written task by task.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import pathlib
import statistics
import time
from typing import Any

import jax

from pmt_jax import load_config
from pmt_jax.config.settings import Config
from pmt_jax.learning.setup import Setup, make_setup
from pmt_jax.learning.sharding import make_mesh
from pmt_jax.training import processes
from pmt_jax.training.compile import compile_run
from pmt_jax.training.run_folder import MATMUL_PRECISION

from . import records, turns
from .tables import scaling as table

GPU_SIZES = {"switch": (4096, 25), "voltage_33": (4096, 60), "ant_2x4": (4096, 8)}  # B, steps between updates
CPU_SIZES = {"switch": (64, 25), "voltage_33": (32, 60), "ant_2x4": (32, 64)}


@dataclasses.dataclass
class Contestant(turns.Contestant):
    """A compiled training loop over some devices."""

    scaling: str
    count: int
    config: Config
    engine: str

    @property
    def rate(self) -> float:
        """Environment steps of all seeds per second; the first turn warms up."""
        config = self.config
        return config.seeds * config.batch_size * config.log_interval / statistics.median(self.seconds[1:])


def prepare(config: Config, count: int) -> Setup:
    """A run over `count` devices."""
    return dataclasses.replace(make_setup(config), mesh=make_mesh(config, count))


def enter(run: Setup, scaling: str, count: int) -> Contestant:
    """Compiles the training loop of a run over `count` devices."""
    begin = time.perf_counter()
    state, programs = compile_run(run, lambda _: None)
    seconds = time.perf_counter() - begin
    print(f"compiled {run.config.task}, {scaling}, {count} device(s) in {seconds:.1f} s", flush=True)
    return Contestant(state, programs.chunk, seconds, scaling, count, run.config, run.vector.env.engine)


def measure(task: str, size: tuple[int, int], counts: list[int], arguments: argparse.Namespace) -> records.Rows:
    """A task's rows: one device first, then every scaling of every number of devices."""
    num_envs, length = size
    one = {"seeds": 1, "num_envs": num_envs, "rollout_length": length, "log_interval": arguments.updates}
    splits: list[tuple[str, int, dict[str, Any]]] = [("one device", 1, one)]
    for count in counts:
        splits += [
            ("weak, environments", count, one | {"num_envs": count * num_envs}),
            ("weak, seeds", count, one | {"seeds": count}),
            ("strong", count, one),
        ]
    # One after the other: Warp starts up with the first engine, and two threads that start it crash it.
    runs = [prepare(load_config(task, method=arguments.method, **sizes), count) for _, count, sizes in splits]
    with concurrent.futures.ThreadPoolExecutor() as pool:  # compiling is most of the time that a rented host is held
        begun = [pool.submit(enter, run, *split[:2]) for run, split in zip(runs, splits, strict=True)]
        contestants = [future.result() for future in begun]
    for _ in range(arguments.repeats + 1):
        for contestant in contestants:
            contestant.turn()
    return [_row(contestant, contestants[0].rate) for contestant in contestants]


def _row(contestant: Contestant, alone: float) -> dict[str, Any]:
    config = contestant.config
    return {
        "task": config.task,
        "method": config.method,
        "physics": contestant.engine,
        "scaling": contestant.scaling,
        "devices": contestant.count,
        "seeds": config.seeds,
        "num_envs": config.num_envs,
        "rollout_length": config.rollout_length,
        "steps_per_second": round(contestant.rate),
        "efficiency": round(contestant.rate / (contestant.count * alone), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", default=",".join(GPU_SIZES), help="with commas")
    parser.add_argument("--method", default="mappo_l")
    parser.add_argument("--num-envs", type=int, help="B, in place of the device's default")
    parser.add_argument("--updates", type=int, default=4, help="in a chunk")
    parser.add_argument("--repeats", type=int, default=7, help="chunks of each program")
    parser.add_argument("--out", type=pathlib.Path, help="a JSON file for the rows")
    arguments = parser.parse_args()
    processes.make_room()
    jax.config.update("jax_default_matmul_precision", MATMUL_PRECISION)
    sizes = CPU_SIZES if jax.devices()[0].platform == "cpu" else GPU_SIZES
    counts = [2**k for k in range(1, jax.device_count().bit_length())]
    rows: records.Rows = []
    for task in arguments.tasks.split(","):
        num_envs, length = sizes[task]
        rows += measure(task, (arguments.num_envs or num_envs, length), counts, arguments)
        print(table({"rows": rows}), flush=True)
        if arguments.out:
            records.write(arguments.out, rows)


if __name__ == "__main__":
    main()
