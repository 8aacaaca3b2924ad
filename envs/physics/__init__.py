"""One physics contract, four engines behind it.

| engine   | where         | what it is                                                          |
|----------|---------------|---------------------------------------------------------------------|
| `fused`  | CPU, NVIDIA   | a control step compiled for the model: a world a SIMD lane or warp  |
| `mujoco` | CPU           | MuJoCo's C engine on threads, called by XLA once per step           |
| `mjx`    | any XLA device| MJX, pure XLA, with C's contact frame for capsules on planes        |
| `warp`   | NVIDIA GPU    | MuJoCo-Warp, a control step as one CUDA graph, with that frame too  |

Signatures are those of one environment; batches come from `jax.vmap`, nested to any depth.

Examples:
  >>> import jax, mujoco
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

import copy
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..errors import TaskError, at_least
from .contract import (
    ENGINES,
    Engine,
    PhysicsState,
    Readout,
    advice,
    check_versions,
    explain,
    obstacle,
    resolve,
    usable_cpus,
)

if TYPE_CHECKING:
    import mujoco

__all__ = [
    "ENGINES",
    "Engine",
    "PhysicsState",
    "Readout",
    "advice",
    "check_versions",
    "explain",
    "kernels_of",
    "make_engine",
    "obstacle",
    "resolve",
    "usable_cpus",
]


def make_engine(
    model: mujoco.MjModel,
    *,
    substeps: int,
    readout: Readout,
    forward: bool = False,
    physics: str = "auto",
    threads: int | None = None,
    contacts: int | None = None,
) -> Engine:
    """Builds an engine for a model.

    Args:
      model: a compiled model; it is copied, never changed.
      substeps: integration steps in a control step; 0, with `forward`, leaves the state as it is.
      readout: derived arrays to return, e.g. `{"torso": ("xpos", 1), "forces": ("cfrc_ext", slice(None))}`.
      forward: a step ends with a forward pass at the new state under the same controls, and readouts are of that state,
        not of the last substep.
      physics: `auto` or one of `ENGINES`; `auto` takes the fastest for the device (`engine.name` says which).
      threads: of `fused` and `mujoco`; the process's usable CPUs if None.
      contacts: of `fused` and `warp`: room for so many contacts in a world; derived from the model if None.

    Raises:
      TaskError: unknown engine, or one that cannot run here, or not with this model.
    """
    chosen = resolve(physics, model, readout, forward)
    if threads is not None:
        at_least("threads", threads, 1)
    if model.na or model.nmocap:
        raise ValueError("PhysicsState carries neither activations nor mocap bodies, which this model has")
    model = copy.copy(model)
    # Each engine's module is imported when it is first built: warp needs packages that the others do without.
    if chosen == "fused":
        from ..native import NoLibrary
        from .fused_engine import FusedEngine

        try:
            return FusedEngine(model, substeps, readout, threads, contacts, forward)
        except NoLibrary as error:
            if physics != "auto":
                raise TaskError(f"physics 'fused' {error}") from error
            chosen = resolve("auto", model, readout, forward)
    if chosen == "mujoco":
        from .c_engine import CEngine

        return CEngine(model, substeps, readout, threads, forward)
    if chosen == "warp":
        from .warp_engine import WarpEngine

        return WarpEngine(model, substeps, readout, contacts)
    from .mjx_engine import MjxEngine

    return MjxEngine(model, substeps, readout, forward)


def kernels_of(*engines: Engine) -> list[Callable[[], Any]]:
    """What engines need compiled besides XLA's programs, as calls for any threads; only warp needs some."""
    return [kernel for engine in engines for kernel in getattr(engine, "kernels", tuple)()]
