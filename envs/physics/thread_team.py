"""MuJoCo's steps on a team of Python threads, with forces after constraints (`mj_rnePostConstraint`).

`mujoco.batch` computes these forces for sensors only, which RK4 skips after its first stage, so the ant steps here. A
persistent batch whose simulations are copied out for them one by one has 0.9 times the speed of this team at 64 and 256
ants on two cores; a batch without the forces has 1.00 to 1.04 times, so there is little to gain.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from queue import SimpleQueue
from typing import Any

import mujoco
import numpy as np

from .contract import Readout


class TeamSteps:
    """Control steps of any number of environments, one mjData a thread."""

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout, threads: int, forward: bool = False):
        self._model, self._substeps, self._readout, self.threads = model, substeps, readout, threads
        self._forward = forward
        self._idle: list[_Worker] = []  # as many as ever worked at once

    def advance(self, rows: np.ndarray, todo: np.ndarray, out: np.ndarray) -> None:
        """Writes into `out` [B, E] what a control step makes of the rows `todo` of `rows` [B, D]."""
        # The threads draw rows from one iterator (atomic in CPython), so none waits for a slow one.
        queue, states = iter(todo.tolist()), rows.astype(np.float64)
        _team.share(lambda: self._work(queue, states, out), queue, min(self.threads, len(todo)))

    def _work(self, queue: Iterator[int], states: np.ndarray, out: np.ndarray) -> None:
        try:
            worker = self._idle.pop()
        except IndexError:
            worker = _Worker(self._model, self._substeps, self._readout, self._forward)
        for row in queue:
            worker.advance(states[row], out[row])
        worker.check_memory()
        self._idle.append(worker)


def after_step(data: Any, readout: Readout) -> list[np.ndarray]:
    """Views of an mjData: position, velocity and warm start, then the readouts."""
    readouts = [getattr(data, field)[index] for field, index in readout.values()]
    return [data.qpos, data.qvel, data.qacc_warmstart, *readouts]


LOST = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]
NO_ROOM = "MuJoCo ran out of room for contacts; raise <size memory=.../> in the model"
_PACKED = int(
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_WARMSTART
    | mujoco.mjtState.mjSTATE_CTRL
)  # what a control step starts from, in the order in which MuJoCo packs it


class _Worker:
    """One thread's mjData, with the array views that are read and written every control step."""

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout, forward: bool):
        self._model, self._substeps, self._forward = model, substeps, forward
        self._data = data = mujoco.MjData(model)
        self._warnings = data.warning
        for warning in data.warning:
            warning.number = 1  # C reports the first of each kind only
        self._outputs = [view.reshape(-1) for view in after_step(data, readout)]

    def advance(self, state: np.ndarray, out: np.ndarray) -> None:
        """One control step of one environment: `state` [D] (float64) to `out` [E]."""
        data = self._data
        data.time = 0.0
        mujoco.mj_setState(self._model, data, state, _PACKED)
        mujoco.mj_step(self._model, data, self._substeps)
        if self._forward:
            mujoco.mj_forward(self._model, data)
        mujoco.mj_rnePostConstraint(self._model, data)
        np.concatenate(self._outputs, out=out, casting="same_kind")

    def check_memory(self) -> None:
        """Raises if contacts found no room, which C drops with a warning only."""
        if any(self._warnings[kind].number > 1 for kind in LOST):
            raise MemoryError(NO_ROOM)


class Team:
    """Threads that help whichever engine calls; they start when first needed and then wait for work.

    `concurrent.futures` costs 16 ants 3 % of their speed. The threads are daemons, which the interpreter does not join
    at exit; the engine waits until no step is under way.
    """

    def __init__(self) -> None:
        self.disband()

    def disband(self) -> None:
        """Forgets the threads, which do not survive a fork; new ones start when needed."""
        self._jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._size = 0
        self._wanted: list[int] = []  # helpers, one entry for each call under way: devices call at the same time

    def share(self, work: Callable[[], None], queue: Iterator[Any], threads: int) -> None:
        """Runs `work`, which takes from `queue` until it is empty, on this thread and on `threads - 1` others.

        When this returns or raises, no helper works any more: one that comes late finds the queue empty.
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

        self._wanted.append(threads - 1)
        try:
            for _ in range(min(threads - 1, self._recruit(sum(self._wanted)))):
                self._jobs.put(assist)
            work()
        finally:
            while True:
                try:
                    settle()
                    break
                except KeyboardInterrupt:  # again: it takes no more than one environment's control step
                    continue
            self._wanted.remove(threads - 1)
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


_team = Team()


def forget_threads() -> None:
    """In a forked child: the parent's threads did not come with it."""
    _team.disband()
