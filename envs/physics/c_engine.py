"""The `mujoco` engine: MuJoCo's C engine on a team of threads, called by XLA once per control step."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import atexit
import contextlib
import copy
import functools
import os
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterator
from queue import SimpleQueue
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ..errors import TaskError
from .contract import PhysicsState, Readout, needs_post_constraint, rest_state, usable_cpus
from .host_call import GivenUp, host_call, register


class CEngine:
    """MuJoCo's C engine on a team of threads, called from inside the jitted program once per control step.

    The numbers depend on neither the number of threads nor which of them advances which environment.
    """

    name = "mujoco"

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout, threads: int | None):
        if threads is not None and threads < 1:
            raise TaskError(f"threads must be at least 1, not {threads}")
        _prepare_process()
        # A broken simulation must come out as it is: the vector wrapper counts and quarantines it.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if model.ntree == 1:  # one tree is one island; the search for it takes 6 % of a step and changes no bit
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
        self._model, self._substeps, self._readout = model, substeps, dict(readout)
        self._threads = threads or usable_cpus()
        first = _Worker(model, substeps, readout)
        self._idle = [first]  # as many as ever worked at once
        self._parts, self._width = first.parts, first.width
        self._target = register(self._advance)

    def start(self) -> PhysicsState:
        return rest_state(self._model)

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        packed = jnp.concatenate([state.qpos, state.qvel, state.warmstart, ctrl.astype(state.qpos.dtype)])
        flat = host_call(self._target, packed, self._width)
        qpos, qvel, warmstart, *rest = (flat[place].reshape(shape) for place, shape in self._parts)
        out = dict(zip(self._readout, rest, strict=True))
        return PhysicsState(qpos, qvel, warmstart), out | {"overflow": jnp.zeros((), qpos.dtype)}

    def _advance(self, argument: np.ndarray, result: np.ndarray) -> None:
        """The host's side: qpos, qvel, warm start and ctrl [..., D] to what `_Worker` writes [..., E]."""
        if _leaving.is_set():
            raise GivenUp("the interpreter is shutting down")
        _running.append(None)
        try:
            self._advance_rows(argument.reshape(-1, argument.shape[-1]), result.reshape(-1, self._width))
        except KeyboardInterrupt:  # XLA runs short programs on the main thread; this cannot unwind through C
            raise GivenUp("interrupted in a physics step (Ctrl-C)") from None
        finally:
            _running.pop()

    def _advance_rows(self, rows: np.ndarray, out: np.ndarray) -> None:
        todo: Collection[int] = range(len(rows))
        if not np.isfinite(rows).all():
            sound = np.isfinite(rows).all(axis=1)
            out[~sound] = np.nan  # broken before the step
            todo = np.flatnonzero(sound).tolist()
        # The threads draw rows from one iterator (atomic in CPython), so a slow thread delays nobody.
        queue, states = iter(todo), rows.astype(np.float64)
        _team.share(lambda: self._work(queue, states, out), queue, min(self._threads, len(todo)))

    def _work(self, queue: Iterator[int], states: np.ndarray, out: np.ndarray) -> None:
        try:
            worker = self._idle.pop()
        except IndexError:
            worker = _Worker(self._model, self._substeps, self._readout)
        _thread.quiet = True
        try:
            for row in queue:
                worker.advance(states[row], out[row])
            worker.check_memory()
        finally:
            _thread.quiet = False
        self._idle.append(worker)


_PACKED = int(
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_WARMSTART
    | mujoco.mjtState.mjSTATE_CTRL
)  # what a control step starts from, in the order in which MuJoCo packs it


class _Worker:
    """One thread's mjData, with the array views that are read and written every control step."""

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout):
        self._model = model
        self._steps = [(model, substeps)]
        if model.nsensor and substeps > 1:  # nobody reads the sensors before the last
            unsensed = copy.copy(model)
            unsensed.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
            self._steps = [(unsensed, substeps - 1), (model, 1)]
        self._data = data = mujoco.MjData(model)
        self._post_constraint = needs_post_constraint(readout)
        self._warnings = data.warning
        for warning in data.warning:
            warning.number = 1  # C reports the first of each kind only
        self._outputs = [data.qpos, data.qvel, data.qacc_warmstart]
        readouts = [getattr(data, field)[index] for field, index in readout.values()]
        self._outputs += [view.reshape(-1) for view in readouts]
        ends = np.cumsum([view.size for view in self._outputs]).tolist()
        shapes = [view.shape for view in (*self._outputs[:3], *readouts)]
        self.parts = [
            (slice(end - view.size, end), shape) for view, end, shape in zip(self._outputs, ends, shapes, strict=True)
        ]
        self.width = ends[-1]

    def advance(self, state: np.ndarray, out: np.ndarray) -> None:
        """One control step of one environment: `state` [D] (float64) to `out` [E]."""
        data = self._data
        data.time = 0.0
        mujoco.mj_setState(self._model, data, state, _PACKED)
        for model, substeps in self._steps:
            mujoco.mj_step(model, data, substeps)
        if self._post_constraint:
            mujoco.mj_rnePostConstraint(self._model, data)
        np.concatenate(self._outputs, out=out, casting="same_kind")

    def check_memory(self) -> None:
        """Contacts that found no room were dropped by C with a warning only."""
        kinds = mujoco.mjtWarning
        if any(self._warnings[int(kind)].number > 1 for kind in (kinds.mjWARN_CONTACTFULL, kinds.mjWARN_CNSTRFULL)):
            raise MemoryError("MuJoCo ran out of room for contacts; raise <size memory=.../> in the model")


class _Team:
    """Threads that help whichever engine calls; they start when first needed and then wait for work.

    `concurrent.futures` would do, but its hand-over costs 16 ants 3 % of their speed. The threads are daemons, so that
    nobody waits for them at exit; `_leave` sees to it that they are idle by then.
    """

    def __init__(self) -> None:
        self.disband()

    def disband(self) -> None:
        """Forgets the threads, which do not survive a fork; new ones start when needed."""
        self._jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._size = 0

    def share(self, work: Callable[[], None], queue: Iterator[Any], threads: int) -> None:
        """Runs `work`, which takes from `queue` until it is empty, on this thread and on `threads - 1` others.

        When this returns or raises, nobody works any more: a helper that comes late finds the queue empty.
        """
        inside: list[None] = []  # one entry for each helper at work
        errors: list[BaseException] = []
        left: SimpleQueue[None] = SimpleQueue()

        def assist() -> None:
            inside.append(None)
            try:
                work()
            except BaseException as error:
                errors.append(error)
            finally:
                inside.pop()
                left.put(None)

        def settle() -> None:
            for _ in queue:  # only after a failure is anything left
                pass
            while inside:
                left.get()

        try:
            for _ in range(min(threads - 1, self._recruit(threads - 1))):
                self._jobs.put(assist)
            work()
        finally:
            while True:
                try:
                    settle()
                    break
                except KeyboardInterrupt:  # again: it takes no more than one environment's control step
                    continue
        if errors:
            raise errors[0]

    def _recruit(self, size: int) -> int:
        """Makes the team at least that large if it can, and returns how large it is."""
        with contextlib.suppress(RuntimeError):  # the interpreter is going down and starts no new thread
            while self._size < size:
                threading.Thread(target=_serve, args=[self._jobs], name="pmt-physics", daemon=True).start()
                self._size += 1
        return self._size


def _serve(jobs: SimpleQueue[Callable[[], None]]) -> None:
    while True:
        jobs.get()()


_team = _Team()
_running: list[None] = []  # one entry for each host call under way
_leaving = threading.Event()
_thread = threading.local()  # its `quiet` is True while the thread works for us


def _forked() -> None:
    """Makes a child's process its own: neither threads nor host calls under way came with it."""
    _team.disband()
    _running.clear()


@functools.cache
def _prepare_process() -> None:
    """What makes threads safe to fork and to leave, and C quiet; done once, when the first engine is built."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_forked)
    atexit.register(_leave)
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_hear)


def _hear(message: str) -> None:
    """MuJoCo's warnings, which it would write to a MUJOCO_LOG.TXT in the working directory.

    Those of our own simulations say that one is about to break, which its numbers tell the quarantine anyway.
    """
    if not getattr(_thread, "quiet", False):
        warnings.warn(f"MuJoCo: {message}", stacklevel=2)


def _leave() -> None:
    """Ends programs that still run when the interpreter exits: XLA's threads would call into what no longer exists."""
    _leaving.set()
    with contextlib.suppress(Exception):  # the programs given up raise here, and nobody is left to tell
        for array in jax.live_arrays():
            with contextlib.suppress(Exception):
                array.block_until_ready()
    deadline = time.monotonic() + 10.0
    while _running and time.monotonic() < deadline:
        time.sleep(0.01)
