"""Several processes, on one host or many, that run the same program: how they meet and how they stay together.

Only the first touches files and speaks; the others follow what it found, and all stop together.
"""

from __future__ import annotations

import os
import pickle
import socket
import zlib
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from ..errors import UsageError

T = TypeVar("T")


def join(coordinator: str | None, process: int | None, processes: int | None) -> None:
    """Meets the other processes of the job, as the arguments or else SLURM's step say; alone, there are none to meet.

    Must come before anything asks JAX for devices.

    Args:
      coordinator: HOST:PORT at which the first process listens; process: which one this is; processes: how many.

    Raises:
      UsageError: the arguments do not fit, or the others cannot be met.
    """
    given = {"--coordinator": coordinator, "--process": process, "--processes": processes}
    missing = [flag for flag, value in given.items() if value is None]
    if missing and len(missing) < len(given):
        raise UsageError(f"{', '.join(given)} belong together; {' and '.join(missing)} is missing")
    if missing and not in_step():
        make_room()
        return
    if coordinator is not None and not coordinator.rpartition(":")[2].isdecimal():
        raise UsageError(f"--coordinator must be HOST:PORT, like node1:1234, not '{coordinator}'")
    if process is not None and processes is not None and process >= processes:
        raise UsageError(f"--process must be from 0 to {processes - 1} with --processes {processes}, not {process}")
    make_room(several=True)
    jax.config.update("jax_enable_preemption_service", False)  # it would take SIGTERM from us
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    detection = None if missing else "deactivate"
    try:
        jax.distributed.initialize(coordinator, processes, process, cluster_detection_method=detection)
    except RuntimeError as error:
        raise UsageError(f"cannot meet the other processes: {str(error).splitlines()[0]}") from error
    _share_cpus()


def make_room(several: bool = False) -> None:
    """Gives XLA's CPU devices, where they are more than one or in `several` processes, more threads than cores.

    A collective keeps a thread of the pool until its partners come, and devices reach theirs in any order: with no
    more threads than devices, all may wait for each other until XLA ends the process after 40 s. Must come before
    anything asks JAX for devices.
    """
    made = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if made or (several and getattr(jax.config, "jax_platforms", None) == "cpu"):
        os.environ.setdefault("NPROC", "64")  # the size of XLA's pool


def in_step() -> bool:
    """Whether SLURM's srun started this process as one of several."""
    return int(os.environ.get("SLURM_STEP_NUM_TASKS", "1")) > 1


def _share_cpus() -> None:
    """Each of the processes that could use the same CPUs takes its part of them."""
    if not hasattr(os, "sched_setaffinity"):
        return
    cpus = sorted(os.sched_getaffinity(0))
    place = zlib.crc32(f"{socket.gethostname()} {cpus}".encode())
    together = np.flatnonzero(multihost_utils.process_allgather(np.uint32(place)) == place).tolist()
    rank, parts = together.index(jax.process_index()), len(together)
    mine = cpus[rank * len(cpus) // parts : (rank + 1) * len(cpus) // parts]
    os.sched_setaffinity(0, mine or [cpus[rank % len(cpus)]])


def is_first() -> bool:
    """Whether this process is the one that touches files and speaks."""
    return jax.process_index() == 0


def agree(number: int) -> int:
    """The largest of the processes' numbers, below 2**31; all must call it at the same point."""
    if jax.process_count() == 1:
        return number
    return int(multihost_utils.process_allgather(np.int32(number)).max())


def by_first(action: Callable[[], T]) -> T:
    """What `action` returns in the first process, in all of them; all must call it at the same point.

    Raises:
      what `action` raises, in the first process; there, the others leave quietly with the code of `pmt` for it.
    """
    if jax.process_count() == 1:
        return action()
    failure, told = None, b""
    if is_first():
        try:
            told = pickle.dumps((0, action()))
        except Exception as error:  # whatever it is, the others wait to hear of it
            failure, told = error, pickle.dumps((2 if isinstance(error, UsageError) else 1, None))
    buffer = np.zeros(agree(len(told)), np.uint8)
    buffer[: len(told)] = np.frombuffer(told, np.uint8)
    heard = multihost_utils.broadcast_one_to_all(buffer)
    if failure is not None:
        raise failure
    code, result = pickle.loads(np.asarray(heard).tobytes())
    if code:
        raise SystemExit(code)
    return result
