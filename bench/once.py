"""What is measured once and takes no turns: starts, checkpoints, policies that are not learned, certificates."""

from __future__ import annotations

import dataclasses
import functools
import os
import pathlib
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import envs
from envs.voltage.certificate import certify
from envs.voltage.control import VoltageControl
from pmt_jax import load_config, make_setup, tasks
from pmt_jax.learning.evaluation import EVALUATION_KEY
from pmt_jax.learning.types import Best
from pmt_jax.policies.evaluate import evaluate_baseline
from pmt_jax.training import loop
from pmt_jax.training.checkpoint import Checkpoints, newest, unpack
from pmt_jax.training.compile import compile_run
from pmt_jax.training.provenance import Provenance

from .cases import Case
from .records import Record

CHUNKS, SAVES = 8, 8
CACHES = ("XDG_CACHE_HOME", "WARP_CACHE_PATH", "CUDA_CACHE_PATH")  # of JAX, of Warp's kernels, of the driver


def start(case: Case) -> Record:
    """Trains in a process of its own with empty caches; the second start has what the first left in them."""
    folder, row = _first_start(dataclasses.replace(case, what="empty cache"))
    return _train(pathlib.Path(folder.name), case) if case.what == "second start" else row


@functools.cache
def _first_start(case: Case) -> tuple[tempfile.TemporaryDirectory[str], Record]:
    """The folder that has the caches until this process ends, and the row."""
    folder = tempfile.TemporaryDirectory()
    return folder, _train(pathlib.Path(folder.name), case)


def _train(folder: pathlib.Path, case: Case) -> Record:
    """Two updates of the case's size, or 4,096 steps of the task's own size; what they took."""
    out = pathlib.Path(tempfile.mkdtemp(dir=folder))
    command = [sys.executable, "-m", "pmt_jax", "train", case.task, "--method", case.method, "--log-interval", "1"]
    command += ["--out", str(out), "--steps", str(2 * case.num_envs * case.rollout_length or 4096)]
    if case.rollout_length:
        command += ["--num-envs", str(case.num_envs), "--rollout-length", str(case.rollout_length)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    environment |= {name: str(folder / name) for name in CACHES}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    begin, first = time.perf_counter(), None
    with open(folder / f"{out.name}.log", "w+") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)
        while (done := os.wait4(process.pid, os.WNOHANG))[0] == 0:
            metrics = out / "metrics.jsonl"
            if first is None and metrics.exists() and metrics.stat().st_size:
                first = time.perf_counter() - begin
            time.sleep(0.01)
        log.seek(0)
        said = log.read()
    if done[1] != 0 or (compiled := re.search(r"compiled in ([0-9.]+) s \(compile cache (\w+)\)", said)) is None:
        raise RuntimeError(f"{' '.join(command)} failed: {said.strip().splitlines()[-1]}")
    usage = done[2]
    return {
        "cache": compiled[2],
        "compile_seconds": float(compiled[1]),
        "first_update_seconds": round(first or time.perf_counter() - begin, 2),
        "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 2),
        "memory_gb": round(usage.ru_maxrss * (1024 if sys.platform == "linux" else 1) / 1e9, 3),
    }


def checkpoint(case: Case) -> Record:
    """Medians over saves, loads and chunks without the first of each, which warms up.

    The run is trained for a while first, so that its weights compress as those of a real run do. `overhead` is the
    share of wall time at the default interval, with a copy of the state after every chunk, as if each were the best.
    """
    setup = make_setup(load_config(case.task, method=case.method, num_envs=case.num_envs))
    state, programs = compile_run(setup, lambda _: None)
    box = [state, Best.initial(state)]

    def train() -> None:
        box[0], _ = programs.chunk(box[0], 1)

    def keep() -> None:
        box[1] = Best(programs.where_seed(np.ones(1, bool), box[1].state, box[0]), box[1].reward, box[1].cost)

    chunk, copy = ([_seconds(work, box) for _ in range(CHUNKS)] for work in (train, keep))
    saved = {"last": box[0], "best": box[1]}
    with tempfile.TemporaryDirectory() as out:
        kept = Checkpoints(pathlib.Path(out))
        save = [_seconds(lambda step=step: kept.save(step, saved, Provenance(setup.config))) for step in range(SAVES)]
        load = [_seconds(lambda: unpack(newest(pathlib.Path(out), print).packed, saved)) for _ in range(SAVES)]
        last = pathlib.Path(out) / "checkpoints" / str(SAVES - 1)
        size = sum(file.stat().st_size for file in last.rglob("*") if file.is_file())
        kept.close()
    saving, copying, training = (statistics.median(seconds[1:]) for seconds in (save, copy, chunk))
    return {
        "checkpoint_mb": round(size / 1e6, 3),
        "save_seconds": round(saving, 3),
        "load_seconds": round(statistics.median(load[1:]), 3),
        "overhead": round(saving / loop.CHECKPOINT_SECONDS + copying / training, 5),
    }


def _seconds(work: Callable[[], Any], then: Any = None) -> float:
    begin = time.perf_counter()
    work()
    jax.block_until_ready(then)
    return time.perf_counter() - begin


def baseline(case: Case) -> Record:
    """Means over episodes from the starts that `pmt eval` has."""
    found = evaluate_baseline(case.task, case.what, case.num_envs, {})
    return {name: round(float(x[0]), 6) for name, x in found.items() if isinstance(x, tuple)}


def certificate(case: Case) -> Record:
    """What dispatches can and cannot do in the steps of the episodes that `baseline` has.

    `reached` are shares of steps with every bus in the band, under the best dispatch found; `possible` are those that
    no proof excludes. The costs are of an episode, a step out of the band costing 1.
    """
    rows = data_rows(case.task, case.num_envs)
    with jax.enable_x64(True):
        env = envs.make(case.task)
        assert isinstance(env, VoltageControl)
        found = certify(env, rows)
    out = found.excess > 0
    return {
        "states": out.size,
        "reached": round(1 - float(out.mean()), 6),
        "possible": round(1 - float(found.impossible.mean()), 6),
        "unknown": int((out & ~found.impossible).sum()),
        "cost_reached": round(float(out.sum(axis=0).mean()), 6),
        "cost_at_least": round(float(found.impossible.sum(axis=0).mean()), 6),
        "largest_unknown_excess": round(float(np.max(found.excess, initial=0, where=out & ~found.impossible)), 6),
        "largest_excess": round(float(found.excess.max()), 6),
    }


def data_rows(task: str, episodes: int) -> np.ndarray:
    """The data rows [T, episodes, D] that the episodes of evaluations step through, whatever the actions."""
    vector = tasks.VectorEnv(tasks.make(task), episodes)
    still = jax.numpy.zeros((episodes, vector.spec.num_agents, vector.spec.action_dim))

    def step(state: tasks.VectorState, _: None) -> tuple[tasks.VectorState, tuple[jax.Array, jax.Array]]:
        after, outcome = vector.step(state, still)
        return after, (state.env.carry.row, outcome.terminated)

    start = vector.reset(jax.random.fold_in(jax.random.key(EVALUATION_KEY), vector.horizon))  # as `play` has it
    rows, ended = jax.jit(lambda: jax.lax.scan(step, start, length=vector.horizon)[1])()
    if ended.any():
        raise RuntimeError("without reactive power a power flow has no solution: the episode's later rows are unknown")
    return np.asarray(rows, np.float64)
