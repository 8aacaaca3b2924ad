"""The `mjx` engine: MJX, pure XLA on any device, with the patches of `mjx_patches`."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from .contract import PhysicsState, Readout, Remade, needs_post_constraint, rest_state
from .mjx_patches import check_hooks, import_mjx, patched


class MjxEngine(Remade):
    """MJX: pure XLA, any device, the same numbers run after run (on CPU and TPU)."""

    name = "mjx"

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout, forward: bool = False):
        mjx = import_mjx()
        check_hooks()
        self._c_model, self._substeps, self._readout, self._forward = model, substeps, dict(readout), forward
        with jax.ensure_compile_time_eval():  # constants, also where an environment is made inside a traced function
            self._model = mjx.put_model(model, impl="jax")
            self._data = mjx.make_data(model, impl="jax")

    def start(self) -> PhysicsState:
        return rest_state(self._c_model)

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        mjx = import_mjx()
        from mujoco.mjx._src import smooth

        data = load_state(self._data, state, ctrl)
        # TF32 on NVIDIA would cost three digits.
        with jax.default_matmul_precision("highest"), patched():
            data = jax.lax.fori_loop(0, self._substeps, lambda _, d: mjx.step(self._model, d), data)
            if self._forward:
                data = mjx.forward(self._model, data)
            if needs_post_constraint(self._readout):
                data = smooth.rne_postconstraint(self._model, data)
        after, out = read_state(data, self._readout)
        return after, out | {"overflow": jnp.zeros((), after.qpos.dtype)}


def load_state(data: Any, state: PhysicsState, ctrl: jax.Array) -> Any:
    """MJX's data with a state's positions, velocities and warm start, and controls."""
    return data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=ctrl)


def read_state(data: Any, readout: Readout) -> tuple[PhysicsState, dict[str, jax.Array]]:
    """The state and the readouts that MJX's data holds."""
    out = {name: getattr(_holder(data, field), field)[index] for name, (field, index) in readout.items()}
    return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), out


def _holder(data: Any, field: str) -> Any:
    """MJX keeps some of mjData's fields in the part that belongs to the implementation."""
    return data if field in {f.name for f in dataclasses.fields(data)} else data._impl
