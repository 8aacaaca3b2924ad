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
from collections.abc import Collection
from typing import TYPE_CHECKING

from ..errors import TaskError, one_of
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
    "SOLVERS",
    "Engine",
    "PhysicsState",
    "Readout",
    "advice",
    "check_versions",
    "explain",
    "make_engine",
    "obstacle",
    "resolve",
    "usable_cpus",
]

SOLVERS = ("converged", "fast")


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
      threads: of `fused` and `mujoco`; the process's usable CPUs if None.
      contacts: of `fused` and `warp`: room for so many contacts in a world; derived from the model if None.

    Raises:
      TaskError: unknown engine or solver, or an engine that cannot run here, or not with this model.
    """
    one_of("solver", solver, SOLVERS)
    chosen = resolve(physics, model, readout)
    if model.na or model.nmocap:
        raise ValueError("PhysicsState carries neither activations nor mocap bodies, which this model has")
    model = copy.copy(model)
    if solver == "fast":
        _cut_solver(model, fast_contacts)
    # Each engine's module is imported when it is first built: warp needs packages that the others do without.
    if chosen == "fused":
        from ..native import NoLibrary
        from .fused_engine import FusedEngine

        try:
            return FusedEngine(model, substeps, readout, threads, contacts)
        except NoLibrary as error:
            if physics != "auto":
                raise TaskError(f"physics 'fused' {error}") from error
            chosen = resolve("auto", model, readout)
    if chosen == "mujoco":
        from .c_engine import CEngine

        return CEngine(model, substeps, readout, threads)
    if chosen == "warp":
        from .warp_engine import WarpEngine

        return WarpEngine(model, substeps, readout, contacts)
    from .mjx_engine import MjxEngine

    return MjxEngine(model, substeps, readout)


def _cut_solver(model: mujoco.MjModel, keep: Collection[str]) -> None:
    model.opt.iterations, model.opt.ls_iterations = 4, 8
    for geom in range(model.ngeom):
        if keep and model.geom(geom).name not in keep:
            model.geom_contype[geom] = model.geom_conaffinity[geom] = 0
