"""How long a newcomer waits for `pmt train`, and how much memory it takes."""

from __future__ import annotations

import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time
from typing import Any

from .cases import Case


def start(case: Case) -> dict[str, Any]:
    """Trains in a process of its own with an empty compile cache; the second start has what the first left in it."""
    with tempfile.TemporaryDirectory() as folder:
        if case.what == "second start":
            _train(pathlib.Path(folder), case)
        return _train(pathlib.Path(folder), case)


def _train(folder: pathlib.Path, case: Case) -> dict[str, Any]:
    """Two updates of the case's size, or 4,096 steps of the task's own size; what they took."""
    out = pathlib.Path(tempfile.mkdtemp(dir=folder))
    command = [sys.executable, "-m", "pmt_jax", "train", case.task, "--method", case.method, "--log-interval", "1"]
    command += ["--out", str(out), "--steps", str(2 * case.num_envs * case.rollout_length or 4096)]
    if case.rollout_length:
        command += ["--num-envs", str(case.num_envs), "--rollout-length", str(case.rollout_length)]
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
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
        "memory_gb": round(usage.ru_maxrss / (1e6 if sys.platform == "linux" else 1e9), 3),
    }
