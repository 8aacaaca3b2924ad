"""Several programs of a sweep at a time, each in a process of its own: what one leaves idle of a GPU, another uses.

Where there are several GPUs, each process gets the one that the fewest others have. A process trains what
`sweep.train_program` trains, says every line through its parent, and ends, saved, with it.
"""

from __future__ import annotations

import itertools
import os
import pathlib
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Sequence
from typing import NamedTuple

import jax

from ..training import signals
from ..training.run_folder import Say

POLL_SECONDS = 0.1


def share_memory() -> None:
    """Lets processes share a GPU's memory, of which JAX would give the first three quarters; before JAX starts."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def command(folder: pathlib.Path, out: pathlib.Path, cache: bool, devices: int | None) -> list[str]:
    """What a process runs, see `pmt_jax.cli.job`."""
    return [sys.executable, "-m", "pmt_jax.cli.job", str(folder), str(out), str(int(cache)), str(devices or "")]


def gpus() -> tuple[str, ...]:
    """The NVIDIA GPUs that JAX sees here, as CUDA_VISIBLE_DEVICES names them; none where there is nothing to choose."""
    present = jax.local_devices()
    if present[0].platform != "gpu" or len(present) == 1:
        return ()
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    return tuple(named.split(",")) if named else tuple(str(number) for number in range(len(present)))


def run(commands: Sequence[Sequence[str]], jobs: int, say: Say, devices: Sequence[str] = ()) -> int:
    """Runs `commands`, `jobs` at a time, and says what they print with their number in front, from [1].

    Ctrl-C and SIGTERM reach all that run, which save and end. After one has failed no other is started.

    Args:
      devices: GPUs to spread the processes over, each of which then sees one of them alone; see `gpus`.

    Returns:
      0, or the exit code of the first that failed.
    """
    waiting = [(number, list(words)) for number, words in enumerate(commands, 1)]
    running: dict[subprocess.Popen[str], _Job] = {}
    code = passed_on = 0
    with signals.noted() as received:
        while running or (waiting and not code and not received):
            while waiting and len(running) < jobs and not code and not received:
                process, job = _start(*waiting.pop(0), _least_used(devices, running.values()), say)
                running[process] = job
            new = received[passed_on:]  # here and not in the handler, which may strike while a process is starting
            passed_on += len(new)
            for process, number in itertools.product(running, new):
                process.send_signal(number)
            for process in [p for p in running if p.poll() is not None]:
                running.pop(process).speaker.join()
                code = code or process.returncode
            time.sleep(POLL_SECONDS)
    return code or (128 + received[0] if received and waiting else 0)


class _Job(NamedTuple):
    """What belongs to a process that runs: the thread that repeats what it says, and its GPU where it was given one."""

    speaker: threading.Thread
    device: str | None


def _least_used(devices: Sequence[str], running: Collection[_Job]) -> str | None:
    return min(devices, key=[job.device for job in running].count, default=None)


def _start(number: int, words: list[str], device: str | None, say: Say) -> tuple[subprocess.Popen[str], _Job]:
    pipe = subprocess.PIPE  # the child's standard input ends with this process, however that ends
    env = os.environ | ({} if device is None else {"CUDA_VISIBLE_DEVICES": device})
    process = subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True, start_new_session=True, env=env)

    def repeat() -> None:
        assert process.stdout
        for line in process.stdout:
            say(f"[{number}] {line.rstrip()}")

    job = _Job(threading.Thread(target=repeat, daemon=True), device)
    job.speaker.start()
    return process, job
