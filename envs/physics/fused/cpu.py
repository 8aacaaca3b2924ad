"""The fused step on CPUs: C++ code for a model's tables, called by XLA."""

from __future__ import annotations

import pathlib
from collections.abc import Callable

import jax
import numpy as np

from ... import native
from .header import header
from .model import Tables

Step = Callable[[jax.Array, jax.Array, jax.Array, jax.Array], list[jax.Array]]

HERE = pathlib.Path(__file__).parent
_SOURCES = ("lanes.cpp", *sorted(path.name for path in HERE.glob("lanes*.h")))
_SOURCES += ("algebra.h", "box_pair.h", "boxes.h", "formulae.h", "rows.h", "vector.h")


def make_step(tables: Tables, threads: int, real: str = "double") -> Step:
    """A control step of a batch: qpos [B, nq], qvel, warm start [B, nv] and ctrl [B, nu] to the first three, the
    readouts [B, width] and overflow [B, 1], all of one dtype, float32 or float64.

    Args:
      tables: see `model`.
      threads: of XLA's pool that work at once; all if 0.
      real: what is computed in, `double` or `float`.

    Raises:
      NoLibrary: no compiler here makes it.
    """
    (target,) = native.targets(code(header(tables), real))
    widths = (tables.nq, tables.nv, tables.nv, tables.width, 1)
    numbers = {"substeps": np.int64(tables.substeps), "threads": np.int64(threads)}

    def step(*operands: jax.Array) -> list[jax.Array]:
        shape, dtype = operands[0].shape[:-1], operands[0].dtype
        results = [jax.ShapeDtypeStruct((*shape, width), dtype) for width in widths]
        return list(jax.ffi.ffi_call(target, results)(*operands, **numbers))

    return step


def code(text: str, real: str = "double") -> native.Code:
    """What the step is compiled of.

    Args:
      text: the tables, from `header`. real: what is computed in, `double` or `float`.
    """
    sources = (*(HERE / name for name in _SOURCES), native.HEADER)
    defined = (f"REAL={real}", 'MODEL="model.h"')
    return native.Code("fused", "the physics", sources, ("fused_step",), (("model.h", text),), defined)
