"""The contract of all engines: their state, their protocol, which of them can run here, and the versions they need."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol, Self

import jax
import jax.numpy as jnp

from .. import native
from ..errors import TaskError, one_of
from ..versions import installed_version

if TYPE_CHECKING:
    import mujoco  # at runtime after `check_versions`: a missing MuJoCo then gets its sentence

ENGINES = ("fused", "mjx", "mujoco", "warp")
MUJOCO_SERIES = "3.17"  # RK4, contact margins and MJX's private hooks differ between minor versions
INSTALL = f"pip install 'mujoco=={MUJOCO_SERIES}.*' 'mujoco-mjx=={MUJOCO_SERIES}.*'"


def check_versions() -> None:
    """Refuses versions that are known to compute something else or to hang.

    Raises:
      TaskError: mujoco and mujoco-mjx are not the same 3.17.*, or jax is 0.10.*.
    """
    found = {name: installed_version(name) for name in ("mujoco", "mujoco-mjx")}
    right = all(v is not None and v.startswith(MUJOCO_SERIES + ".") for v in found.values())
    if not right or len(set(found.values())) != 1:
        listing = ", ".join(f"{name} {version or 'missing'}" for name, version in found.items())
        raise TaskError(
            f"the physics needs mujoco and mujoco-mjx of the same {MUJOCO_SERIES}.*; found {listing}; {INSTALL}"
        )
    if jax.__version__.startswith("0.10."):
        raise TaskError(f"jax {jax.__version__} deadlocks on CPUs; pip install 'jax>=0.9.2,!=0.10.*'")


check_versions()


class Remade:
    """What is pickled as the arguments that it was made of, as it holds programs, threads or pointers."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        made = super().__new__(cls)
        made._made_of = args, kwargs
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        args, kwargs = self._made_of
        return functools.partial(type(self), *args, **kwargs), ()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PhysicsState:
    """The state that one control step hands to the next.

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
          stage, not to the new qpos, unless the engine was made with `forward`. Contact forces (`cfrc_ext`) include
          `mj_rnePostConstraint`. The readout `overflow` is 1 if the step found no room for all contacts or constraints
          and is wrong, else 0: only fused and warp have buffers that can be too small without raising.
        """
        ...


def resolve(
    physics: str, model: mujoco.MjModel | None = None, readout: Readout | None = None, forward: bool = False
) -> str:
    """The engine that `physics` means on this machine, for a model, its readouts and a forward pass if they are given.

    Raises:
      TaskError: no such engine, or it cannot run here, or not with this model.
    """
    one_of("physics", physics, ("auto", *ENGINES))
    if physics == "auto":
        return next(name for name in _PREFERENCE if obstacle(name, model, readout, forward) is None)
    reason = obstacle(physics, model, readout, forward)
    if reason is not None:
        raise TaskError(f"physics '{physics}' {reason}")
    return physics


_PREFERENCE = ("fused", "mujoco", "warp", "mjx")  # the first that can run: the next two never can on the same device


def obstacle(
    physics: str, model: mujoco.MjModel | None = None, readout: Readout | None = None, forward: bool = False
) -> str | None:
    """Why an engine cannot run here, as the rest of a sentence that begins with its name; None if it can.

    `fused` depends on the model and its readouts, `warp` on the forward pass. Without a model, the answer is about the
    machine alone.
    """
    device = jax.devices()[0]
    if physics == "fused":
        return _fused_obstacle(device, model, readout, forward)
    if physics == "mujoco" and device.platform != "cpu":
        return f"runs on CPUs only; found {device.device_kind} (set JAX_PLATFORMS=cpu, or take 'warp' or 'mjx')"
    if physics == "warp":
        if not _is_nvidia(device):
            return f"needs an NVIDIA GPU; found {device.device_kind} (take 'mujoco' on CPUs, 'mjx' elsewhere)"
        if installed_version("warp-lang") is None:
            return "needs warp-lang; found none; install it with pip install 'pmt-jax[warp]'"
        if forward:
            return "cannot step this model: its step has no forward pass after the substeps (take 'mjx')"
    return None


def _fused_obstacle(
    device: jax.Device, model: mujoco.MjModel | None, readout: Readout | None, forward: bool
) -> str | None:
    on_cpu = device.platform == "cpu"
    if not on_cpu and not _is_nvidia(device):
        return f"runs on CPUs and NVIDIA GPUs; found {device.device_kind} (take 'mjx')"
    reason = None if model is None else _refused(model, readout, on_cpu)
    if reason:
        return f"{reason} (take '{'mujoco' if on_cpu else 'mjx' if forward else 'warp'}')"
    if on_cpu:
        return native.obstacle("fused")
    from .fused import nvrtc

    return nvrtc.obstacle()


def _is_nvidia(device: jax.Device) -> bool:
    return device.platform == "gpu" and "nvidia" in device.device_kind.lower()


def _refused(model: mujoco.MjModel, readout: Readout | None, on_cpu: bool = True) -> str | None:
    from .fused import model as tables_of
    from .fused import threads

    reason = tables_of.obstacle(model, readout)
    return reason if reason or on_cpu else threads.obstacle(tables_of.tables(model, 1, readout or {}))


def explain() -> dict[str, str | None]:
    """For each engine the obstacle to running it here, None if there is none."""
    return {name: obstacle(name) for name in ENGINES}


def advice(model: mujoco.MjModel, readout: Readout | None = None) -> str | None:
    """What would make a model's steps faster on this machine, as a sentence; None if nothing is known."""
    if obstacle("mujoco") or obstacle("fused") is None or _refused(model, readout):
        return None
    return f"physics engine 'fused' steps this model several times as fast, but it {obstacle('fused')}"


def usable_cpus() -> int:
    """CPUs this process may run on, which in a container are fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def needs_post_constraint(readout: Readout) -> bool:
    """Whether a readout holds forces that only `mj_rnePostConstraint` computes."""
    return any(field in ("cfrc_ext", "cfrc_int", "cacc") for field, _ in readout.values())


def rest_state(model: mujoco.MjModel) -> PhysicsState:
    """The model's reference position at rest."""
    dtype = jnp.result_type(float)
    zeros = jnp.zeros(model.nv, dtype)
    return PhysicsState(jnp.asarray(model.qpos0, dtype), zeros, zeros)


def flattened(batched: Any) -> Any:
    """A function of arrays with a leading [B] for which `vmap`, however nested, only makes B larger."""

    @jax.custom_batching.custom_vmap
    def call(*args: Any) -> Any:
        return batched(*args)

    @call.def_vmap
    def rule(axis_size: int, in_batched: Any, *args: Any) -> tuple[Any, Any]:
        def spread(leaf: jax.Array, is_batched: bool) -> jax.Array:
            leaf = leaf if is_batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:])

        size = jax.tree.leaves(args)[0].shape[1 if jax.tree.leaves(in_batched)[0] else 0]
        out = flattened(batched)(*jax.tree.map(spread, args, tuple(in_batched)))
        out = jax.tree.map(lambda leaf: leaf.reshape(axis_size, size, *leaf.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return call
