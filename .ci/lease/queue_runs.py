"""Runs the jobs of jobs.py, some at a time on each GPU, until its END; then Ctrl-C, so that training is saved."""

from __future__ import annotations

import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time

import jobs

HERE = pathlib.Path(__file__).parent
SMOKE = "--smoke" in sys.argv
OUT = pathlib.Path("/tmp/smoke" if SMOKE else "/tmp/runs")
GPUS = 2 if SMOKE else len((OUT / "gpus").read_text().splitlines())
BEGIN = time.time() if SMOKE else float((HERE / "asked").read_text())
END = 900.0 if SMOKE else jobs.END
Running = tuple[int, str, subprocess.Popen[bytes]]
ENVIRONMENT = {  # next to what setup.sh exports
    "PYTHONUNBUFFERED": "1",
    "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    "XDG_CACHE_HOME": "/tmp/cache",
    "WARP_CACHE_PATH": "/tmp/warp",
}


def log(*words: object) -> None:
    print(f"{time.time() - BEGIN:.0f} s", *words, flush=True)


def start(gpu: int, name: str, command: list[str]) -> subprocess.Popen[bytes]:
    """`command` is what follows `python`; a run gets its folder, and continues if an earlier lease began it."""
    begun = OUT / "runs" / name / "config.toml"  # a sweep has none, and goes on by itself
    if begun.exists():
        program = command[: command.index("train")]  # a script of this folder may have changed the method
        command = [*program, "train", str(begun), "--resume"]
    command = [*command, "--out", str(begun.parent)]
    if SMOKE:
        tiny = "--num-envs=4 --rollout-length=8 --steps=64 --epochs=1 --minibatches=1 --log-interval=1 --seeds=2"
        command += tiny.split()
    (OUT / "logs").mkdir(parents=True, exist_ok=True)
    log("GPU", gpu, "starts", name)
    with open(OUT / "logs" / name.replace("/", "-"), "w") as file:
        where = {} if SMOKE else ENVIRONMENT | {"CUDA_VISIBLE_DEVICES": str(gpu)}
        return subprocess.Popen(
            [sys.executable, *command], env=os.environ | where, stdout=file, stderr=subprocess.STDOUT
        )


def room(running: list[Running], next_run: str) -> int | None:
    """The fullest GPU that has room for the next run, so that a large one finds an empty GPU; None if none has."""
    weight = jobs.WEIGHTS.get(next_run, 1)
    at = [sum(jobs.WEIGHTS.get(name, 1) for there, name, _ in running if there == gpu) for gpu in range(GPUS)]
    return max((gpu for gpu in range(GPUS) if at[gpu] + weight <= jobs.PROGRAMS), key=at.__getitem__, default=None)


def main() -> None:
    if SMOKE:
        shutil.rmtree(OUT, ignore_errors=True)
    queue, running = list(jobs.JOBS.items()), list[Running]()
    while time.time() - BEGIN < END and (queue or running):
        for gpu, name, process in list(running):
            if process.poll() is not None:
                log(name, "ended with", process.returncode)
                running.remove((gpu, name, process))
        if queue and (free := room(running, queue[0][0])) is not None:
            name, command = queue.pop(0)
            running.append((free, name, start(free, name, command.split())))
        else:
            time.sleep(1)
    for _, _, process in running:
        process.send_signal(signal.SIGINT)
    for _, name, process in running:
        try:
            log(name, "saved with", process.wait(40))
        except subprocess.TimeoutExpired:
            log(name, "did not end")
            process.kill()


if __name__ == "__main__":
    main()
