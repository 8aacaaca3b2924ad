"""The `mujoco` engine: MuJoCo's C engine on threads, called by XLA once per control step.

`thread_team` runs a step if a readout needs `mj_rnePostConstraint`, else `native_batch` does.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import atexit
import contextlib
import functools
import os
import threading
import time
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ..errors import at_least
from .contract import PhysicsState, Readout, Remade, needs_post_constraint, rest_state, usable_cpus
from .host_call import GivenUp, host_call, register
from .native_batch import BatchSteps, forget_batches
from .thread_team import TeamSteps, after_step, forget_threads


class CEngine(Remade):
    """MuJoCo's C engine on threads, called from inside the jitted program once per control step.

    The numbers depend on neither the number of threads nor which of them advances which environment.
    """

    name = "mujoco"

    def __init__(
        self, model: mujoco.MjModel, substeps: int, readout: Readout, threads: int | None, forward: bool = False
    ):
        threads = usable_cpus() if threads is None else int(at_least("threads", threads, 1))
        _prepare_process()
        # A broken simulation must come out as it is: the vector wrapper counts and quarantines it.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        if model.ntree == 1:  # one tree is one island; the search for it takes 6 % of a step and changes no bit
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
        self._model, self._substeps, self._readout, self._threads = model, substeps, dict(readout), threads
        self._forward = forward
        views = after_step(mujoco.MjData(model), readout)
        ends = np.cumsum([view.size for view in views]).tolist()
        self._parts = [(slice(end - view.size, end), view.shape) for view, end in zip(views, ends, strict=True)]
        self.width = ends[-1]
        self._target = register(self.advance)

    @functools.cached_property
    def runner(self) -> TeamSteps | BatchSteps:
        """Made by the first step, as JAX has its devices by then. They call at the same time and share the threads."""
        kind = TeamSteps if needs_post_constraint(self._readout) else BatchSteps
        calls = jax.local_device_count() if jax.default_backend() == "cpu" else 1
        return kind(self._model, self._substeps, self._readout, -(-self._threads // calls), self._forward)

    def start(self) -> PhysicsState:
        return rest_state(self._model)

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        packed = jnp.concatenate([state.qpos, state.qvel, state.warmstart, ctrl.astype(state.qpos.dtype)])
        flat = host_call(self._target, packed, self.width)
        qpos, qvel, warmstart, *rest = (flat[place].reshape(shape) for place, shape in self._parts)
        out = dict(zip(self._readout, rest, strict=True))
        return PhysicsState(qpos, qvel, warmstart), out | {"overflow": jnp.zeros((), qpos.dtype)}

    def advance(self, argument: np.ndarray, result: np.ndarray) -> None:
        """The host's side: qpos, qvel, warm start and ctrl [..., D] to the state and the readouts [..., E]."""
        if _leaving.is_set():
            raise GivenUp("the interpreter is shutting down")
        _running.append(None)
        rows, out = argument.reshape(-1, argument.shape[-1]), result.reshape(-1, self.width)
        try:
            sound = np.isfinite(rows).all(axis=1)
            out[~sound] = np.nan  # broken before the step
            self.runner.advance(rows, np.flatnonzero(sound), out)
        except KeyboardInterrupt:  # XLA runs short programs on the main thread; this cannot unwind through C
            raise GivenUp("interrupted in a physics step (Ctrl-C)") from None
        finally:
            _running.pop()


_running: list[None] = []  # one entry for each host call under way
_leaving = threading.Event()


def _forked() -> None:
    """Makes a child's process its own: neither threads nor host calls under way came with it."""
    forget_threads()
    forget_batches()
    _running.clear()


@functools.cache
def _prepare_process() -> None:
    """Makes threads safe to fork and to leave, and C quiet; once, when the first engine is built."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_forked)
    atexit.register(_leave)
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_hear)


def _hear(message: str) -> None:
    """Takes MuJoCo's warnings, which it would write to a MUJOCO_LOG.TXT in the working directory.

    Those of a host call under way say that a simulation is about to break, which its numbers show anyway.
    """
    if not _running:
        warnings.warn(f"MuJoCo: {message}", stacklevel=2)


def _leave() -> None:
    """Ends programs that still run when the interpreter exits: XLA's threads would call into what no longer exists."""
    _leaving.set()
    with contextlib.suppress(Exception):  # a program given up raises here, with no caller left
        for array in jax.live_arrays():
            with contextlib.suppress(Exception):
                array.block_until_ready()
    deadline = time.monotonic() + 10.0
    while _running and time.monotonic() < deadline:
        time.sleep(0.01)
