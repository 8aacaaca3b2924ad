"""MuJoCo's steps on the native thread pool of `mujoco.batch`: for all that a step leaves behind by itself.

Against `thread_team` on two cores, two hands step the same numbers 1.04 times as fast at 64 environments and 1.2 times
at 256 (the environment alone; medians of 21 interleaved ratios on a loaded machine, 1.03 and 1.17 in CPU time).
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import ctypes
import weakref

import mujoco
import numpy as np
from mujoco.batch import Batch

from .contract import Readout
from .thread_team import LOST, NO_ROOM


class BatchSteps:
    """Control steps of any number of environments, one `Batch` for each size of batch."""

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout, threads: int, forward: bool = False):
        self._model, self._substeps, self._readout, self.threads = model, substeps, readout, threads
        self._stage = int(mujoco.mjtStage.mjSTAGE_ACC if forward else mujoco.mjtStage.mjSTAGE_NONE)
        self.forget()
        _all.add(self)

    def forget(self) -> None:
        """Starts without any batch."""
        self._idle: dict[int, list[_Simulations]] = {}  # by size, as many as ever worked at once
        self.made: list[Batch] = []

    def advance(self, rows: np.ndarray, todo: np.ndarray, out: np.ndarray) -> None:
        """Writes into `out` [B, E] what a control step makes of the rows `todo` of `rows` [B, D]."""
        idle = self._idle.setdefault(len(rows), [])
        try:
            simulations = idle.pop()
        except IndexError:
            batch = Batch(self._model, len(rows), min(self.threads, len(rows)))
            self.made.append(batch)
            simulations = _Simulations(batch, self._readout)
        simulations.advance(rows, todo, out, self._substeps, self._stage)
        idle.append(simulations)


class _Simulations:
    """A batch with the array views that are read and written every control step."""

    def __init__(self, batch: Batch, readout: Readout):
        self._batch = batch
        state = [batch.bind(field) for field in ("qpos", "qvel", "qacc_warmstart")]
        self._inputs = [*state, batch.bind("ctrl")]
        self._outputs = [*state, *(batch.bind(field)[:, index] for field, index in readout.values())]

    def advance(self, rows: np.ndarray, todo: np.ndarray, out: np.ndarray, substeps: int, stage: int) -> None:
        batch = self._batch
        batch.time[:] = 0.0
        batch.warning[..., 1] = 1  # C reports the first of each kind only
        start = 0
        for view in self._inputs:
            end = start + view.shape[1]
            view[:] = rows[:, start:end]
            start = end
        if substeps:
            batch.step(todo, substeps, stage)
        else:
            batch.forward(todo, stage)
        if (batch.warning[:, LOST, 1] > 1).any():
            raise MemoryError(NO_ROOM)
        done = slice(None) if len(todo) == len(rows) else todo
        start = 0
        for view in self._outputs:
            flat = view.reshape(len(view), -1)
            end = start + flat.shape[1]
            out[done, start:end] = flat[done]
            start = end


_all: weakref.WeakSet[BatchSteps] = weakref.WeakSet()


def forget_batches() -> None:
    """In a forked child: the batches' threads did not come with it, and a batch without them hangs when it is freed."""
    for steps in list(_all):
        for batch in steps.made:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))  # never freed
        steps.forget()
