"""One physics contract, three engines behind it.

| engine   | where         | what it is                                                          |
|----------|---------------|---------------------------------------------------------------------|
| `mujoco` | CPU           | MuJoCo's C engine on a team of threads, called by XLA once per step |
| `mjx`    | any XLA device| MJX, pure XLA, with C's contact frame for capsules on planes        |
| `warp`   | NVIDIA GPU    | MJX with the MuJoCo-Warp implementation                             |

Signatures are those of one environment; batches come from `jax.vmap`, nested as one likes.

Example:
  >>> import mujoco
  >>> from envs import physics
  >>> ball = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
  >>> model = mujoco.MjModel.from_xml_string(ball)
  >>> engine = physics.make_engine(model, substeps=5, readout={"position": ("xpos", 1)}, physics="mujoco")
  >>> state, out = engine.step(engine.start(), jax.numpy.zeros(0))
  >>> out["position"].shape
  (3,)
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import atexit
import contextlib
import copy
import dataclasses
import functools
import importlib
import importlib.metadata
import importlib.util
import io
import os
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from queue import SimpleQueue
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import TaskError, one_of
from .host_call import GivenUp, host_call, register

ENGINES = ("mjx", "mujoco", "warp")
SOLVERS = ("converged", "fast")
MUJOCO_SERIES = "3.17"  # RK4, contact margins and MJX's private hooks differ between minor versions
_PIP = f"pip install 'mujoco=={MUJOCO_SERIES}.*' 'mujoco-mjx=={MUJOCO_SERIES}.*'"


def check_versions() -> None:
    """Refuses versions that are known to compute something else or to hang.

    Raises:
      TaskError: mujoco and mujoco-mjx are not the same 3.17.*, or jax is 0.10.*.
    """
    found = {name: _version(name) for name in ("mujoco", "mujoco-mjx")}
    right = all(v is not None and v.startswith(MUJOCO_SERIES + ".") for v in found.values())
    if not right or len(set(found.values())) != 1:
        listing = ", ".join(f"{name} {version or 'missing'}" for name, version in found.items())
        raise TaskError(
            f"the physics needs mujoco and mujoco-mjx of the same {MUJOCO_SERIES}.*; found {listing}; {_PIP}"
        )
    if jax.__version__.startswith("0.10."):
        raise TaskError(f"jax {jax.__version__} deadlocks on CPUs; pip install 'jax>=0.9.2,!=0.10.*'")


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


check_versions()
import mujoco  # noqa: E402  (after the check: a missing MuJoCo gets the sentence above, not a traceback)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PhysicsState:
    """All that one control step needs to know of the last one.

    Attributes:
      qpos: [nq] positions in MuJoCo's order and units.
      qvel: [nv] velocities.
      warmstart: [nv] the acceleration the constraint solver starts from.
    """

    qpos: jax.Array
    qvel: jax.Array
    warmstart: jax.Array


Readout = Mapping[str, tuple[str, Any]]  # name -> (field of mjData, index into its first axis)


class Engine(Protocol):
    """A model and the means to advance it."""

    name: str

    def start(self) -> PhysicsState:
        """The model's reference position at rest."""
        ...

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        """One control step of `substeps` integration steps under the constant `ctrl` [nu].

        Returns:
          The new state and the readouts, which are what the integrator left behind: after RK4 they belong to its last
          stage, not to the new qpos. Contact forces (`cfrc_ext`) include `mj_rnePostConstraint`. Beside them stands
          `overflow`, 1 where the step found no room for all contacts or constraints and is wrong, else 0: only warp
          has buffers that can be too small without raising.
        """
        ...


def make_engine(
    model: mujoco.MjModel,
    *,
    substeps: int,
    readout: Readout,
    physics: str = "auto",
    solver: str = "converged",
    fast_contacts: Collection[str] = (),
    threads: int | None = None,
    contacts: int | None = None,
) -> Engine:
    """Builds an engine for a model.

    Args:
      model: a compiled model; it is copied, never changed.
      substeps: integration steps in a control step.
      readout: derived arrays to return, e.g. `{"torso": ("xpos", 1), "forces": ("cfrc_ext", slice(None))}`.
      physics: `auto` or one of `ENGINES`; `auto` takes the fastest for the device (`engine.name` says which).
      solver: `converged` keeps the model's solver settings; `fast` cuts Newton to 4 iterations of 8 line-search steps
        and keeps only the contacts of `fast_contacts`: no difference in returns was found (KS p 0.58), one-step errors
        grow to 1e-3.
      fast_contacts: names of the geoms that keep their contacts when the solver is fast; empty keeps all.
      threads: of the `mujoco` engine; the process's usable CPUs where None.
      contacts: of the `warp` engine: room for so many contacts in a world; derived from the model where None.

    Raises:
      TaskError: unknown engine or solver, or an engine that cannot run here.
    """
    physics = resolve(physics)
    one_of("solver", solver, SOLVERS)
    if model.na or model.nmocap:
        raise ValueError("PhysicsState carries neither activations nor mocap bodies, which this model has")
    model = copy.copy(model)
    if solver == "fast":
        _cut_solver(model, fast_contacts)
    if physics == "mujoco":
        return CEngine(model, substeps, readout, threads)
    if physics == "warp":
        return WarpEngine(model, substeps, readout, contacts)
    return MjxEngine(model, substeps, readout)


def _cut_solver(model: mujoco.MjModel, keep: Collection[str]) -> None:
    model.opt.iterations, model.opt.ls_iterations = 4, 8
    for geom in range(model.ngeom):
        if keep and model.geom(geom).name not in keep:
            model.geom_contype[geom] = model.geom_conaffinity[geom] = 0


def resolve(physics: str) -> str:
    """The engine that `physics` means on this machine.

    Raises:
      TaskError: no such engine, or it cannot run here.
    """
    one_of("physics", physics, ("auto", *ENGINES))
    if physics == "auto":
        return next(name for name in _PREFERENCE if obstacle(name) is None)
    reason = obstacle(physics)
    if reason is not None:
        raise TaskError(f"physics '{physics}' {reason}")
    return physics


_PREFERENCE = ("mujoco", "warp", "mjx")  # the first that can run: the first two never can on the same device


def obstacle(physics: str) -> str | None:
    """Why an engine cannot run here, as the rest of a sentence that begins with its name; None where it can."""
    device = jax.devices()[0]
    if physics == "mujoco" and device.platform != "cpu":
        return f"runs on CPUs only; found {device.device_kind} (set JAX_PLATFORMS=cpu, or take 'warp' or 'mjx')"
    if physics == "warp":
        if device.platform != "gpu" or "nvidia" not in device.device_kind.lower():
            return f"needs an NVIDIA GPU; found {device.device_kind} (take 'mujoco' on CPUs, 'mjx' elsewhere)"
        if _version("warp-lang") is None:
            return "needs warp-lang; found none; install it with pip install 'pmt-jax[warp]'"
    return None


def explain() -> dict[str, str | None]:
    """For each engine the obstacle to running it here, None where there is none."""
    return {name: obstacle(name) for name in ENGINES}


def usable_cpus() -> int:
    """CPUs this process may run on, which in a container are fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _needs_post_constraint(readout: Readout) -> bool:
    return any(field in ("cfrc_ext", "cfrc_int", "cacc") for field, _ in readout.values())


def _start(model: mujoco.MjModel) -> PhysicsState:
    dtype = jnp.result_type(float)
    zeros = jnp.zeros(model.nv, dtype)
    return PhysicsState(jnp.asarray(model.qpos0, dtype), zeros, zeros)


# ---------------------------------------------------------------------------------------------------------------------
# MuJoCo's C engine


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
        return _start(self._model)

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
        self._post_constraint = _needs_post_constraint(readout)
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


# ---------------------------------------------------------------------------------------------------------------------
# MJX and MJX-Warp


class MjxEngine:
    """MJX: pure XLA, any device, the same numbers run after run (on CPU and TPU)."""

    name = "mjx"

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout):
        mjx = import_mjx()
        check_hooks()
        self._c_model, self._substeps, self._readout = model, substeps, dict(readout)
        with jax.ensure_compile_time_eval():  # constants, also where an environment is made inside a traced function
            self._model = mjx.put_model(model, impl="jax")
            self._data = mjx.make_data(model, impl="jax")

    def start(self) -> PhysicsState:
        return _start(self._c_model)

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        mjx = import_mjx()
        from mujoco.mjx._src import smooth

        data = _loaded(self._data, state, ctrl)
        # TF32 on NVIDIA would cost three digits.
        with jax.default_matmul_precision("highest"), _hooked():
            data = jax.lax.fori_loop(0, self._substeps, lambda _, d: mjx.step(self._model, d), data)
            if _needs_post_constraint(self._readout):
                data = smooth.rne_postconstraint(self._model, data)
        after, out = _unloaded(data, self._readout)
        return after, out | {"overflow": jnp.zeros((), after.qpos.dtype)}


class WarpEngine:
    """MJX with the MuJoCo-Warp implementation. Its sums are atomic: runs do not repeat to the last bit.

    Buffers are sized by the model (`_room`) and the batch, and every step says whether they were large enough.
    """

    name = "warp"

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout, contacts: int | None = None):
        mjx = import_mjx()
        self._c_model, self._substeps, self._readout = model, substeps, dict(readout)
        self._contacts, self._rows = _room(model, contacts)
        settings = {"opt._impl.warn_overflow": 0}  # it would print from inside the kernels
        settings |= {"ncam": 0, "nlight": 0}  # nobody looks through them here, and each has a kernel a stage
        self._model = _constant(lambda: mjx.put_model(model, impl="warp").tree_replace(settings))
        # Forces after the constraints are read at the end of a control step only; Warp works them out in each of the
        # integrator's stages, so the substeps before the last go without.
        forces = {"opt._impl.run_rne_postconstraint": _needs_post_constraint(readout)}
        self._last_model = self._model.tree_replace(forces)

    def start(self) -> PhysicsState:
        return _start(self._c_model)

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        # Controls that a scan takes straight from its inputs reached Warp as an illegal address (jax 0.11.2, H200;
        # computed ones did not): XLA hands such slices to a foreign call without a copy. Beyond mjMAXVAL nothing is
        # simulated anyway.
        ctrl = jnp.clip(ctrl, -mujoco.mjMAXVAL, mujoco.mjMAXVAL)
        lone = jax.tree.map(lambda x: x[None], (state, ctrl))
        return jax.tree.map(lambda x: x[0], _flattened(self._step_all)(*lone))

    def _step_all(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        """One control step of a batch: all arrays have a leading [B]."""
        mjx = import_mjx()
        data = self._make_data(len(ctrl))

        def one(state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
            own = _loaded(data, state, ctrl)
            for _ in range(self._substeps - 1):
                own = mjx.step(self._model, own)
            own = mjx.step(self._last_model, own)
            after, out = _unloaded(own, self._readout)
            lost = (own._impl.overflow & _LOST) != 0
            return after, out | {"overflow": lost.astype(after.qpos.dtype)}

        return jax.vmap(one)(state, ctrl)

    def _make_data(self, batch: int) -> Any:
        """Warp keeps the contacts of all worlds in one buffer, so its size depends on the batch."""
        mjx = import_mjx()
        size = self._contacts * batch
        data = _constant(lambda: mjx.make_data(self._c_model, impl="warp", naconmax=size, njmax=self._rows))

        def slim(leaf: Any) -> Any:  # the empty buffers are uniform: keep them out of the program's constants
            large = leaf.ndim > 0 and leaf.shape[0] == size and size > 1
            return jnp.broadcast_to(leaf[:1], leaf.shape) if large else leaf

        return jax.tree.map(slim, data)


def _constant(make: Callable[[], Any]) -> Any:
    """What `make` builds of JAX arrays, as NumPy's, wherever it is called from.

    MJX asks for its arrays' shapes per shard, which inside a `shard_map` nobody can say, so `make` runs outside of any
    mesh; and an array that lies on one device is no constant of a program for several.
    """
    with jax.ensure_compile_time_eval(), jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
        return jax.tree.map(np.asarray, make())


def _flattened(batched: Any) -> Any:
    """A function of arrays with a leading [B] for which `vmap`, however nested, only makes B larger."""

    @jax.custom_batching.custom_vmap
    def call(*args: Any) -> Any:
        return batched(*args)

    @call.def_vmap
    def rule(axis_size: int, in_batched: Any, *args: Any) -> tuple[Any, Any]:
        def spread(leaf: jax.Array, is_batched: bool) -> jax.Array:
            leaf = leaf if is_batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(-1, *leaf.shape[2:])

        out = _flattened(batched)(*jax.tree.map(spread, args, tuple(in_batched)))
        out = jax.tree.map(lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return call


_MOST_CONTACTS = 64  # of one world; 30 were enough for the ant, 60 for two hands
_LOST = 0b11111  # MuJoCo-Warp's overflow bits that cost contacts or constraints; the others are of solvers and sensors


def _room(model: mujoco.MjModel, contacts: int | None = None) -> tuple[int, int]:
    """Contacts and constraint rows that one world of the model needs at most, for so many contacts if given."""
    first, second = np.triu_indices(model.ngeom, 1)
    wanted = (model.geom_contype[first] & model.geom_conaffinity[second]) | (
        model.geom_contype[second] & model.geom_conaffinity[first]
    )
    apart = model.body_weldid[model.geom_bodyid[first]] != model.body_weldid[model.geom_bodyid[second]]
    each = np.full(mujoco.mjtGeom.mjNGEOMTYPES, 4)  # contact points of a pair, by the type with the most
    each[mujoco.mjtGeom.mjGEOM_PLANE], each[mujoco.mjtGeom.mjGEOM_SPHERE], each[mujoco.mjtGeom.mjGEOM_CAPSULE] = 0, 1, 2
    points = np.maximum(each[model.geom_type[first]], each[model.geom_type[second]])
    most = int(points[(wanted != 0) & apart].sum()) + 4 * model.npair
    contacts = contacts or max(1, min(most, _MOST_CONTACTS))
    limits = int(model.jnt_limited.sum() + model.tendon_limited.sum())
    dry = int((model.dof_frictionloss > 0).sum() + (model.tendon_frictionloss > 0).sum())
    return contacts, 2 * (int(model.geom_condim.max()) - 1) * contacts + limits + dry + 6 * model.neq


def _loaded(data: Any, state: PhysicsState, ctrl: jax.Array) -> Any:
    return data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=ctrl)


def _unloaded(data: Any, readout: Readout) -> tuple[PhysicsState, dict[str, jax.Array]]:
    out = {name: getattr(_holder(data, field), field)[index] for name, (field, index) in readout.items()}
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), out


def import_mjx() -> Any:
    """`mujoco.mjx`, imported on first use and without what it prints where the optional warp is missing."""
    with contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


def _holder(data: Any, field: str) -> Any:
    """MJX keeps some of mjData's fields in the part that belongs to the implementation."""
    return data if field in {f.name for f in dataclasses.fields(data)} else data._impl


def check_hooks() -> None:
    """Whether the two private places of MJX that `_hooked` replaces are still there.

    Raises:
      TaskError: they are not; this MJX needs another look before it can be trusted to agree with C.
    """
    import_mjx()
    from mujoco.mjx._src import collision_driver, solver
    from mujoco.mjx._src.types import GeomType

    table = getattr(collision_driver, "_COLLISION_FUNC", {})
    found = (GeomType.PLANE, GeomType.CAPSULE) in table and callable(getattr(solver, "_while_loop_scan", None))
    if not found:
        raise TaskError(f"mujoco-mjx {_version('mujoco-mjx')} lacks the private hooks of {MUJOCO_SERIES}; {_PIP}")


_HOOKING = threading.RLock()  # the hooks are module globals; two threads may trace at once


@contextlib.contextmanager
def _hooked() -> Iterator[None]:
    """While MJX is being traced: C's contact frame for capsules on planes, and a better line search.

    MJX's own is a scan over all iterations, for the sake of reverse-mode gradients, which nobody takes through the
    physics here; a real loop is 1.6 times as fast at 50 iterations. And in float32 it at times stops a step early.
    """
    from mujoco.mjx._src import collision_driver, solver
    from mujoco.mjx._src.types import GeomType

    table, pair = collision_driver._COLLISION_FUNC, (GeomType.PLANE, GeomType.CAPSULE)
    with _HOOKING:
        stock = table[pair], solver._while_loop_scan
        table[pair], solver._while_loop_scan = _plane_capsule, _line_search
        try:
            yield
        finally:
            table[pair], solver._while_loop_scan = stock


def _line_search(cond: Any, body: Any, init: Any, max_iter: int) -> Any:
    """`body` while `cond`, at most `max_iter` times, on the bracket `lo` to `hi` of MJX's line search.

    MJX then takes the end with the lower cost, or stays where it was if neither is lower than there. In float32 the
    cost is too coarse to show what the last Newton step gains (1e-3 of 1e5, and 0.1 in qacc), whereas the slope still
    shows it. So where costs agree to rounding, the end with the smaller slope is given the lower cost.
    """

    def proceed(carry: Any) -> jax.Array:
        count, value = carry
        return (count < max_iter) & cond(value)

    init = jax.tree.map(jnp.asarray, init)
    found = jax.lax.while_loop(proceed, lambda carry: (carry[0] + 1, body(carry[1])), (jnp.int32(0), init))[1]
    lo, hi = found.lo, found.hi
    start = _either(init.lo.alpha == 0, init.lo, init.hi)
    flatter = _either(jnp.abs(lo.deriv_0) < jnp.abs(hi.deriv_0), lo, hi)
    rounding = 8 * jnp.finfo(start.cost.dtype).eps * jnp.abs(start.cost)
    unseen = (jnp.minimum(lo.cost, hi.cost) >= start.cost) & (flatter.cost <= start.cost + rounding)
    unseen &= jnp.abs(flatter.deriv_0) < jnp.abs(start.deriv_0)
    return found.replace(lo=_either(unseen, flatter.replace(cost=-jnp.inf), lo))


def _either(condition: jax.Array, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _plane_capsule(model: Any, data: Any, _: Any, geoms: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Contacts [2 pairs] of planes and capsules: distance, position and frame, in the layout MJX's driver expects.

    As in C, the first tangent is the capsule's axis projected on the plane, however steep the capsule; MJX's own
    function lets go of it beyond 60 degrees, which changes friction, whose cone is a pyramid along the tangents.
    """

    def collide(plane: jax.Array, capsule: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        normal, axis = data.geom_xmat[plane][:, 2], data.geom_xmat[capsule][:, 2]
        radius, half_length = model.geom_size[capsule][0], model.geom_size[capsule][1]
        tangent = axis - normal * jnp.dot(normal, axis)
        length = jnp.linalg.norm(tangent)
        upright = length < 1e-6  # no direction to project: any tangent will do
        other = jnp.where(jnp.abs(normal[1]) < 0.5, jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
        other = other - normal * jnp.dot(normal, other)
        tangent = jnp.where(upright, other / jnp.linalg.norm(other), tangent / jnp.where(upright, 1.0, length))
        frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)])
        ends = data.geom_xpos[capsule] + jnp.array([[1.0], [-1.0]]) * half_length * axis
        distance = (ends - data.geom_xpos[plane]) @ normal - radius
        position = ends - normal * (radius + 0.5 * distance)[:, None]
        return distance, position, jnp.stack([frame, frame])

    return jax.tree.map(jnp.concatenate, jax.vmap(collide)(geoms[:, 0], geoms[:, 1]))


setattr(_plane_capsule, "ncon", 2)  # noqa: B010  (contacts a pair, read by MJX's driver)
