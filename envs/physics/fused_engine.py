"""The `fused` engine: the whole control step as one function of a batch, compiled for the model.

On CPUs the worlds are lanes of the machine's vectors, and threads of XLA's own pool step groups of them. Numbers inside
are double, whatever the arrays are. On NVIDIA GPUs a world is a warp of 32 threads, which hold two dofs each of a wide
model, and all numbers are single; sums have one order there too, so runs repeat bit for bit.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from .. import native
from ..errors import at_least
from .contract import PhysicsState, Readout, Remade, flattened, rest_state, usable_cpus
from .fused import cpu, gpu
from .fused.model import FIELDS, tables

if TYPE_CHECKING:
    import mujoco


class FusedEngine(Remade):
    """See the module. The numbers depend on neither the number of threads nor the rest of a batch.

    Raises:
      NoLibrary: no compiler here makes the step of a CPU.
      TaskError: NVIDIA's run-time compiler is missing, or refuses the step of a GPU.
    """

    name = "fused"

    def __init__(
        self,
        model: mujoco.MjModel,
        substeps: int,
        readout: Readout,
        threads: int | None = None,
        contacts: int | None = None,
        forward: bool = False,
    ):
        threads = usable_cpus() if threads is None else int(at_least("threads", threads, 1))
        self._model, self._tables = model, tables(model, substeps, readout, contacts, forward)
        self._on_gpu = gpu.make_step(self._tables) if jax.default_backend() == "gpu" else None
        if self._on_gpu is None:
            # A process's devices step at the same time and share the threads.
            self._advance = cpu.make_step(self._tables, -(-threads // jax.local_device_count()))

    def start(self) -> PhysicsState:
        return rest_state(self._model)

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        if self._on_gpu is not None:
            given = [x.astype(jnp.float32) for x in (state.qpos, state.qvel, state.warmstart, ctrl)]
            qpos, qvel, warmstart, overflow, out = self._on_gpu(*given)
            return PhysicsState(qpos, qvel, warmstart), out | {"overflow": overflow}
        single = jax.tree.map(lambda x: x[None], (state, ctrl))
        return jax.tree.map(lambda x: x[0], flattened(self._step_all)(*single))

    def _step_all(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        """One control step of a batch: all arrays have a leading [B]."""
        dtype = jnp.result_type(float)
        given = [x.astype(dtype) for x in (state.qpos, state.qvel, state.warmstart, ctrl)]
        qpos, qvel, warmstart, flat, overflow = self._advance(*given)
        readings = self._tables.readings
        ends = np.cumsum([FIELDS[reading.field] * len(reading.rows) for reading in readings.values()])
        parts = jnp.split(flat, ends[:-1].tolist(), axis=1)
        out = {
            name: part.reshape(len(qpos), *reading.shape)
            for (name, reading), part in zip(readings.items(), parts, strict=False)
        }
        return PhysicsState(qpos, qvel, warmstart), out | {"overflow": overflow[:, 0]}


def compiler() -> str:
    """What compiles the step for this process's devices."""
    return native.describe() if jax.default_backend() == "cpu" else "compiled by NVRTC"
