"""What checkpoints cost: size, seconds to save and load, share of training's wall time."""

from __future__ import annotations

import pathlib
import statistics
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from pmt_jax import load_config, make_setup
from pmt_jax.training import run_folder, trainer
from pmt_jax.training.checkpoint import Checkpoints
from pmt_jax.training.compile import compile_run

from .cases import Case

CHUNKS, SAVES = 8, 8


def checkpoint(case: Case) -> dict[str, Any]:
    """Medians over saves, loads and chunks without the first of each, which warms up.

    The run is trained for a while first, so that its weights compress as those of a real run do. `overhead` is the
    share of wall time at the default interval, with a copy of the state after every chunk, as if each were the best.
    """
    setup = make_setup(load_config(case.task, method=case.method, num_envs=case.num_envs))
    state, programs = compile_run(setup, lambda _: None)
    box = [state, run_folder.initial_best(state)]

    def train() -> None:
        box[0], _ = programs.chunk(box[0])

    def keep() -> None:
        box[1] = run_folder.Best(programs.take(np.ones(1, bool), box[1].state, box[0]), box[1].reward, box[1].cost)

    chunk, copy = ([_seconds(work, box) for _ in range(CHUNKS)] for work in (train, keep))
    saved = {"last": box[0], "best": box[1]}
    with tempfile.TemporaryDirectory() as out:
        kept = Checkpoints(pathlib.Path(out))
        save = [_seconds(lambda step=step: kept.save(step, saved)) for step in range(SAVES)]
        load = [_seconds(lambda: kept.load(saved, print)) for _ in range(SAVES)]
        newest = pathlib.Path(out) / "checkpoints" / str(SAVES - 1)
        size = sum(file.stat().st_size for file in newest.rglob("*") if file.is_file())
        kept.close()
    saving, copying, training = (statistics.median(seconds[1:]) for seconds in (save, copy, chunk))
    return {
        "checkpoint_mb": round(size / 1e6, 3),
        "save_seconds": round(saving, 3),
        "load_seconds": round(statistics.median(load[1:]), 3),
        "overhead": round(saving / trainer.CHECKPOINT_SECONDS + copying / training, 5),
    }


def _seconds(work: Callable[[], Any], then: Any = None) -> float:
    begin = time.perf_counter()
    work()
    jax.block_until_ready(then)
    return time.perf_counter() - begin
