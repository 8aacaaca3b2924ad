"""Worker processes that share the seeds of a run and the CPUs of a host.

One program keeps few cores busy with its learner; several keep one each. Workers are functions: every call returns the
new states of their seeds to the run's process. Files, signals and seeds that break therefore stay where they are in a
run of one process, and what a lost worker had not returned is all that is lost.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection, Pipe
from typing import Any

import jax
import numpy as np

from .. import numerics
from ..config.settings import Config
from ..errors import UsageError
from ..learning.setup import Setup, make_setup
from ..learning.types import LearnerState
from ..output import Say
from . import failures, processes
from .checkpoint import pack, unpack
from .compile import Programs, compile_run, where_seed
from .run_folder import state_like
from .signals import CAUGHT

SETTINGS = (  # of JAX, which a worker takes over
    *numerics.RECORDED,
    "jax_default_matmul_precision",
    "jax_enable_compilation_cache",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
)
START = "from pmt_jax.training import workers; workers.serve()"


class WorkerLost(UsageError):
    """A worker process has ended; the sentence says which and how."""


def check_workers(config: Config, count: int, others: Mapping[str, object]) -> None:
    """Whether so many worker processes can share the run.

    Args:
      others: flags that need the programs in this process, and their values.

    Raises:
      UsageError: they cannot.
    """
    if count == 1:
        return
    if count > config.seeds:
        raise UsageError(f"--workers {count} cannot share {config.seeds} seed(s); take at most one a seed")
    if given := [flag for flag, value in others.items() if value]:
        raise UsageError(f"--workers and {' and '.join(given)} do not go together; leave one of them out")
    if jax.process_count() > 1:
        raise UsageError("--workers splits a run on one host; these processes split it already: leave out --workers")
    if jax.devices()[0].platform != "cpu":
        raise UsageError("--workers shares the cores of a CPU; a GPU trains all seeds in one program: leave it out")


def start_workers(setup: Setup, say: Say) -> tuple[LearnerState, Programs]:
    """As `compile_run`, but the programs run in `setup.workers` worker processes.

    Raises:
      WorkerLost: a worker ended meanwhile; their programs raise it too.
      UsageError: what `compile_run` raises.
    """
    config = setup.config
    say(f"compiling {setup.label} on {setup.vector.spec.name} in every worker ...")
    workers = Workers(setup)
    try:
        states, measures, said = zip(*map(workers.receive, range(setup.workers)), strict=True)
    except UsageError:
        workers.close()
        raise
    say(said[0])
    programs = Programs(
        functools.partial(workers.call, "chunk"),
        jax.jit(where_seed),
        final=functools.partial(workers.call, "final"),
        close=workers.close,
    )
    if config.eval_interval:
        programs = programs._replace(evaluate=functools.partial(workers.call, "evaluate"), measures=measures[0])
    return workers.together(states), programs


class Workers:
    """The worker processes of a run, each with its part of the seeds and of the CPUs."""

    def __init__(self, setup: Setup) -> None:
        config, self._like = setup.config, state_like(setup)
        parts = np.array_split(np.arange(config.seeds), setup.workers)
        self._bounds = [(int(part[0]), int(part[-1]) + 1) for part in parts]
        self._first, self._processes, self._pipes = config.seed, [], []
        cpus = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        for rank, (begin, end) in enumerate(self._bounds):
            ours, theirs = Pipe()
            process = subprocess.Popen(
                [sys.executable, "-c", START, str(theirs.fileno())],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # a terminal's Ctrl-C is for this process alone
            )
            if cpus:
                processes.take_cpus(process.pid, cpus, rank, setup.workers)
            theirs.close()  # the worker's end alone is left: where it dies, reading ends
            self._processes.append(process)
            self._pipes.append(ours)
            part = config.replace(seed=config.seed + begin, seeds=end - begin)
            self._send(rank, (part, {name: x for name, x in jax.config.values.items() if name in SETTINGS}))

    def call(self, program: str, state: LearnerState, updates: int = 0) -> Any:
        """What every worker's `program` returns for its seeds of `state`, put together along the seeds.

        Args:
          updates: of `chunk`.
        """
        packed = {} if state is self._newest else pack(state)  # the workers have what they returned last
        for rank, (begin, end) in enumerate(self._bounds):
            self._send(rank, (program, {path: x[begin:end] for path, x in packed.items()}, updates))
        results = [self.receive(rank) for rank in range(len(self._bounds))]
        if program in ("evaluate", "final"):
            return _joined(results)
        states, metrics = zip(*results, strict=True)
        return self.together(states), _joined(metrics)

    def together(self, states: Sequence[dict[str, np.ndarray]]) -> LearnerState:
        """The state of all seeds from the packed ones that the workers have just returned."""
        self._newest = unpack(_joined(states), self._like)
        return self._newest

    def receive(self, rank: int) -> Any:
        """What a worker sends next."""
        try:
            received = self._pipes[rank].recv()
        except (EOFError, OSError):
            raise self._lost(rank) from None
        if isinstance(received, UsageError):
            raise received
        return received

    def _send(self, rank: int, what: Any) -> None:
        try:
            self._pipes[rank].send(what)
        except OSError:
            raise self._lost(rank) from None

    def _lost(self, rank: int) -> WorkerLost:
        code = self._processes[rank].wait()
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        first, last = (self._first + i for i in (self._bounds[rank][0], self._bounds[rank][1] - 1))
        seeds = f"seed {first}" if first == last else f"seeds {first} to {last}"
        advice = " (fewer --workers need less memory)" if code == -signal.SIGKILL else ""
        return WorkerLost(f"worker {rank + 1} of {len(self._bounds)} ({seeds}) {how}{advice}")

    def close(self) -> None:
        """Ends the workers, which have nothing to save."""
        for pipe, process in zip(self._pipes, self._processes, strict=True):
            process.kill()
            process.communicate()
            pipe.close()


def _joined(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


# ---------------------------------------------------------------------------------------------------------------------
# In a worker


def serve() -> None:
    """A worker: compiles the programs of its seeds, then runs them whenever it is asked to."""
    for number in CAUGHT:  # the run stops its workers
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pipe = Connection(int(sys.argv[1]))
    config, settings = pipe.recv()
    for name, value in settings.items():
        jax.config.update(name, value)
    said: list[str] = []
    try:
        with failures.named():
            state, programs = compile_run(make_setup(config), said.append)
    except UsageError as error:
        pipe.send(error)
        return
    pipe.send((pack(state), programs.measures, said[-1]))
    with contextlib.suppress(EOFError, ConnectionError):  # a run that was killed may leave a result unread
        while True:
            program, packed, updates = pipe.recv()
            given = unpack(packed, state) if packed else state
            try:
                with failures.named():
                    if evaluate := {"evaluate": programs.evaluate, "final": programs.final}.get(program):
                        pipe.send(jax.device_get(evaluate(given)))
                    else:
                        state, metrics = programs.chunk(given, updates)
                        pipe.send((pack(state), jax.device_get(metrics)))
            except failures.Failed as failed:
                pipe.send(failed)


def _end_with_parent() -> None:
    os.read(0, 1)  # standard input ends with the run's process, even by kill -9
    os._exit(1)
