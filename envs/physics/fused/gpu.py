"""Kernels on NVIDIA GPUs as functions of arrays, and the step of a model: one launch a control step.

XLA launches PTX that a program carries, under a name of its own. Where an XLA does not know that name, `launch` does
it from the host; the bits are the same.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.extend.mlir import ir
from jax.interpreters import batching, mlir

from . import launch, nvrtc, threads
from .model import FIELDS, Tables

Way = Literal["xla", "host"]
Step = Callable[..., tuple[jax.Array, jax.Array, jax.Array, jax.Array, dict[str, jax.Array]]]

CALL = "__gpu$xla.gpu.ptx"
_ENTRY = "fused_step"


@dataclasses.dataclass(frozen=True)
class Kernel:
    """Compiled code that blocks of threads run for each item of a batch; called with arrays [..., *item], all of one
    batch, it returns float32 results [..., *item]. vmap, however nested, makes the batch larger.

    Attributes:
      entry: its name in the PTX. ptx: the code. results: shapes of an item of each result.
      rank: axes of an item of the first array. blocks, threads: for an item, and of a block.
      way: `xla` or `host`; whichever this XLA has if None.
      crowded: what computes the same of batches of more than so many blocks.
    """

    entry: str
    ptx: str
    results: tuple[tuple[int, ...], ...]
    rank: int = 1
    blocks: int = 1
    threads: int = threads.THREADS
    way: Way | None = None
    crowded: tuple[int, Kernel] | None = None

    def __call__(self, *arrays: jax.Array) -> Any:
        chosen = self.way or ("xla" if knows_call() else "host")
        return _call.bind(*arrays, kernel=self) if chosen == "xla" else launch.call(self, *arrays)

    def batch(self, array: Any) -> tuple[int, ...]:
        """The batch's axes, from the first array."""
        return array.shape[: len(array.shape) - self.rank]

    def of(self, items: int) -> Kernel:
        """The kernel for so many items."""
        return self.crowded[1] if self.crowded and items * self.blocks > self.crowded[0] else self


def obstacle() -> str | None:
    """Why no kernel runs here, as the rest of a sentence; None if they do."""
    kind = jax.devices()[0].device_kind
    return nvrtc.obstacle() if "nvidia" in kind.lower() else f"runs on NVIDIA GPUs; found {kind}"


def ptx(source: str, headers: dict[str, str], what: str) -> str:
    """PTX for the local GPUs; see `nvrtc.ptx`."""
    return nvrtc.ptx(source, headers, architecture(), what)


def make_step(tables: Tables, way: Way | None = None) -> Step:
    """A function of float32 `qpos` [..., nq], `qvel`, `warmstart` [..., nv] and `ctrl` [..., nu].

    It returns the new qpos, qvel and warm start, `overflow` [...], and the readouts [..., *shape] by name. Rows with
    a number that is not finite come out as nan, and touch no other row. vmap, however nested, makes the batch larger.

    Args:
      tables: of the model.
      way: `xla` or `host`; whichever this XLA has if None.

    Raises:
      TaskError: no NVRTC; see `nvrtc.step_ptx`.
    """
    readings = list(tables.readings.values())
    widths = [tables.nq, tables.nv, tables.nv, 1, *(len(r.rows) * FIELDS[r.field] for r in readings)]
    run = Kernel(
        _ENTRY, nvrtc.step_ptx(threads.source(tables), architecture()), tuple((width,) for width in widths), way=way
    )

    def step(*state_and_ctrl: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, dict[str, jax.Array]]:
        qpos, qvel, warmstart, overflow, *read = run(*state_and_ctrl)
        shapes = {name: reading.shape for name, reading in tables.readings.items()}
        read = {name: x.reshape(*x.shape[:-1], *shape) for (name, shape), x in zip(shapes.items(), read, strict=True)}
        return qpos, qvel, warmstart, overflow[..., 0], read

    return step


def architecture() -> str:
    """The oldest compute capability of the local GPUs, `9.0`: all of them run its PTX."""
    found = {str(device.compute_capability) for device in jax.local_devices()}
    return min(found, key=lambda version: tuple(map(int, version.split("."))))


@functools.cache
def knows_call() -> bool:
    """Whether this XLA launches PTX by itself: a kernel that does nothing tells."""
    empty = f".version 8.0\n.target sm_75\n.address_size 64\n.visible .entry {_ENTRY}(.param .u64 a, .param .u64 b)\n"
    kernel = Kernel(_ENTRY, empty + "{\nret;\n}\n", ((1,),))
    try:
        jax.jit(functools.partial(_call.bind, kernel=kernel)).lower(jnp.zeros((1, 1), jnp.float32)).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


# -- XLA's own call --

_call = Primitive("gpu_kernel")
_call.multiple_results = True


@_call.def_abstract_eval
def _results(*arrays: Any, kernel: Kernel) -> list[Any]:
    lead = kernel.batch(arrays[0])
    return [arrays[0].update(shape=(*lead, *item), dtype=jnp.dtype(jnp.float32)) for item in kernel.results]


@_call.def_impl
def _eager(*arrays: Any, kernel: Kernel) -> Any:
    return jax.jit(functools.partial(_call.bind, kernel=kernel))(*arrays)


def _batched(arrays: Sequence[Any], axes: Sequence[Any], *, kernel: Kernel) -> tuple[Any, list[int]]:
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None)
    spread = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]
    return _call.bind(*spread, kernel=kernel), [0] * len(kernel.results)


batching.primitive_batchers[_call] = _batched


def _lower(context: Any, *operands: Any, kernel: Kernel) -> Any:
    items = math.prod(kernel.batch(context.avals_in[0]))
    kernel = kernel.of(items)

    def number(value: int) -> Any:
        return ir.IntegerAttr.get(ir.IntegerType.get_signless(32), value)

    sizes = {f"{kind}_{axis}": number(1) for kind in ("grid", "block") for axis in "xyz"}
    config = sizes | {
        "name": ir.StringAttr.get(kernel.entry),
        "kernel_type": ir.StringAttr.get("ptx"),
        "kernel_data": ir.StringAttr.get(kernel.ptx),
        "grid_x": number(items * kernel.blocks),
        "block_x": number(kernel.threads),
        "shared_mem_bytes": number(0),
        "output_indices": ir.ArrayAttr.get([number(len(operands) + k) for k in range(len(kernel.results))]),
    }
    return jax.ffi.ffi_lowering(CALL, backend_config=config, api_version=4)(context, *operands)


mlir.register_lowering(_call, _lower, platform="cuda")  # pyright: ignore[reportArgumentType] (a stricter protocol than JAX keeps)
