"""What checkpoints of the corridor ant cost: size, seconds to save and load, share of training's wall time.

python -m bench.checkpoint --out bench/results/checkpoint.json

A 256-environment run of `mixed`, the method with the most networks, is trained for a while, so that its weights
compress as those of a real run do. `overhead` is what checkpoints take of wall time at the default interval: a save
every CHECKPOINT_SECONDS (`interval`, s), and after every chunk a copy of the state, as if each were the best so far.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import statistics
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from pmt_jax import load_config
from pmt_jax.learning.setup import make_setup
from pmt_jax.training import checkpoint, run_folder, trainer
from pmt_jax.training.compile import compile_run, use_cache

from . import records


def seconds(work: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(work())
    return time.perf_counter() - begin


def measure(chunks: int, repeats: int) -> dict[str, Any]:
    """All figures; seconds are medians, except for the first save, which also warms orbax up."""
    run = make_setup(load_config("ant_2x4", method="mixed", num_envs=256))
    state, programs = compile_run(run, print)
    best = run_folder.initial_best(state)
    chunk_seconds = []
    for _ in range(chunks):
        begin = time.perf_counter()
        state, _ = jax.block_until_ready(programs.chunk(state))
        chunk_seconds.append(time.perf_counter() - begin)
    keep_seconds = []
    for _ in range(chunks):
        begin = time.perf_counter()
        best = run_folder.Best(programs.take(np.ones(1, bool), best.state, state), best.reward, best.cost)
        jax.block_until_ready(best.state)
        keep_seconds.append(time.perf_counter() - begin)
    saved = {"last": state, "best": best}
    with tempfile.TemporaryDirectory() as out:
        checkpoints = checkpoint.Checkpoints(pathlib.Path(out))
        save_seconds = [seconds(lambda step=step: checkpoints.save(step, saved)) for step in range(repeats)]
        load_seconds = [seconds(lambda: checkpoints.load(saved, print)) for _ in range(repeats)]
        newest = pathlib.Path(out) / "checkpoints" / str(repeats - 1)
        size = sum(p.stat().st_size for p in newest.rglob("*") if p.is_file())
        checkpoints.close()
    save, chunk, keep = (statistics.median(x) for x in (save_seconds[1:], chunk_seconds[1:], keep_seconds[1:]))
    return {
        "task": "ant_2x4",
        "method": "mixed",
        "num_envs": 256,
        "checkpoint_mb": round(size / 1e6, 3),
        "first_save_seconds": round(save_seconds[0], 3),
        "save_seconds": round(save, 3),
        "load_seconds": round(statistics.median(load_seconds), 3),
        "chunk_seconds": round(chunk, 3),
        "keep_best_seconds": round(keep, 5),
        "overhead": round(save / trainer.CHECKPOINT_SECONDS + keep / chunk, 5),
        "interval": trainer.CHECKPOINT_SECONDS,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chunks", type=int, default=12, help="chunks to train and to keep")
    parser.add_argument("--repeats", type=int, default=8, help="saves and loads")
    parser.add_argument("--out", type=pathlib.Path)
    arguments = parser.parse_args()
    use_cache()
    result = measure(arguments.chunks, arguments.repeats)
    print(json.dumps(result, indent=1))
    if arguments.out:
        records.write(arguments.out, [result], ("orbax-checkpoint",))


if __name__ == "__main__":
    main()
