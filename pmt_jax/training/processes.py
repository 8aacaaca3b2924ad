"""Several processes, on one host or many, that run the same program.

Only the first process reads, writes and prints; the others receive its results, and all stop after the same row.
"""

from __future__ import annotations

import contextlib
import functools
import os
import pickle
import re
import socket
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import ParamSpec, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from ..errors import UsageError

T = TypeVar("T")
_UNREACHED = re.compile(
    r"gloo|nccl|coordination service|heartbeat|connection (reset|closed|refused)|^unavailable", re.I
)
TRY_AGAIN = 75  # exit code, EX_TEMPFAIL of sysexits.h: the same command with --resume continues
P = ParamSpec("P")


class Parted(UsageError):
    """Another process of the run has ended, or cannot be reached; the sentence says what was seen of it."""


@contextlib.contextmanager
def reaching_others() -> Iterator[None]:
    """What JAX raises inside because another process is gone becomes a sentence.

    Raises:
      Parted: it is gone.
    """
    try:
        yield
    except (ValueError, RuntimeError) as error:  # JAX's own is a RuntimeError, but where arrays are made it is none
        if jax.process_count() == 1 or not _UNREACHED.search(str(error)):
            raise
        seen = str(error).splitlines()[0]
        raise Parted(f"another process of the run has ended or cannot be reached ({seen})") from error


def join(coordinator: str | None, process: int | None, processes: int | None, devices: int | None = None) -> None:
    """Connects to the other processes of the job, if the arguments or SLURM's step name any.

    It must be called before JAX is asked for devices.

    Args:
      coordinator: HOST:PORT at which the first process listens; process: which one this is; processes: how many.
      devices: that a run in one process takes.

    Raises:
      UsageError: the arguments contradict each other, or the other processes cannot be reached.
    """
    given = {"--coordinator": coordinator, "--process": process, "--processes": processes}
    missing = [flag for flag, value in given.items() if value is None]
    if missing and len(missing) < len(given):
        is_or_are = "is" if len(missing) == 1 else "are"
        raise UsageError(f"{', '.join(given)} belong together; {' and '.join(missing)} {is_or_are} missing")
    if missing and not in_step():
        make_room(devices)
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
        raise UsageError(f"cannot reach the other processes: {str(error).splitlines()[0]}") from error
    _share_cpus()


def make_room(devices: int | None = None, several: bool = False) -> None:
    """Makes `devices` of a CPU, and gives XLA enough threads for them, or for one in each of `several` processes.

    It must be called before JAX is asked for devices. A CPU has at most as many devices as cores, unless XLA_FLAGS sets
    their number.
    """
    made = re.search(r"xla_force_host_platform_device_count=(\d+)", os.environ.get("XLA_FLAGS", ""))
    count = int(made[1]) if made else min(devices or 1, usable_cpus())
    if count > 1 and not made:
        with contextlib.suppress(RuntimeError):  # JAX has started, and keeps the devices that it has
            jax.config.update("jax_num_cpu_devices", count)
    if made or count > 1 or (several and getattr(jax.config, "jax_platforms", None) == "cpu"):
        os.environ.setdefault("NPROC", str(threads_for(count)))


def threads_for(devices: int) -> int:
    """The size of XLA's pool for so many CPU devices of this process, which its variable NPROC sets.

    A collective holds a thread of each device until all devices have reached it, and devices reach theirs in any order:
    with no more threads than devices they may deadlock, and XLA ends the process after 40 s. Many more cost time: 64
    for two devices on two cores cost a sixth of an update.
    """
    return max(usable_cpus(), 2 * devices)


def usable_cpus() -> int:
    """CPUs that this process may run on, without MuJoCo, which `pmt doctor` may find broken."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_step() -> bool:
    """Whether SLURM's srun started this process as one of several."""
    return int(os.environ.get("SLURM_STEP_NUM_TASKS", "1")) > 1


def _share_cpus() -> None:
    """Divides CPUs that several processes could use among these."""
    if not hasattr(os, "sched_setaffinity"):
        return
    cpus = sorted(os.sched_getaffinity(0))
    place = zlib.crc32(f"{socket.gethostname()} {cpus}".encode())
    together = np.flatnonzero(multihost_utils.process_allgather(np.uint32(place)) == place).tolist()
    take_cpus(0, cpus, together.index(jax.process_index()), len(together))


def take_cpus(process: int, cpus: Sequence[int], rank: int, parts: int) -> None:
    """Gives `process` (0: this one), before it starts threads, its part of `cpus`; with too few, some share one."""
    mine = cpus[rank * len(cpus) // parts : (rank + 1) * len(cpus) // parts]
    os.sched_setaffinity(process, mine or [cpus[rank % len(cpus)]])


def is_first() -> bool:
    """Whether this process is the one that reads, writes and prints."""
    return jax.process_index() == 0


def agree(number: int) -> int:
    """The largest of the processes' numbers, below 2**31; all must call it at the same point."""
    if jax.process_count() == 1:
        return number
    with reaching_others():
        return int(multihost_utils.process_allgather(np.int32(number)).max())


def by_first(action: Callable[[], T]) -> T:
    """What `action` returns in the first process, in all of them; all must call it at the same point.

    Raises:
      what `action` raises, in the first process; the others exit with the code of `pmt` for it and print nothing.
    """
    if jax.process_count() == 1:
        return action()
    failure, sent = None, b""
    if is_first():
        try:
            sent = pickle.dumps((0, action()))
        except Exception as error:  # whatever it is, the others wait for a result
            failure, sent = error, pickle.dumps((2 if isinstance(error, UsageError) else 1, None))
    buffer = np.zeros(agree(len(sent)), np.uint8)
    buffer[: len(sent)] = np.frombuffer(sent, np.uint8)
    with reaching_others():
        received = multihost_utils.broadcast_one_to_all(buffer)
    if failure is not None:
        raise failure
    code, result = pickle.loads(np.asarray(received).tobytes())
    if code:
        raise SystemExit(code)
    return result


def in_first(method: Callable[P, T]) -> Callable[P, T]:
    """`method` as one that the first process alone carries out, for all of them (see `by_first`)."""

    @functools.wraps(method)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        return by_first(lambda: method(*args, **kwargs))

    return call
