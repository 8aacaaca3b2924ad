"""The step for GPUs, compiled for a CPU: the same source with loops for lanes, in float32 or float64."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import pathlib
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable

import numpy as np
import pytest

import envs.physics.fused
from envs.physics.fused import threads
from envs.physics.fused.model import Tables
from paths import ROOT

COMPILER = next((path for name in ("g++", "c++", "clang++") if (path := shutil.which(name))), None)
compiled = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler here")

_SOURCE = pathlib.Path(__file__).with_suffix(".cpp")
_FOLDER = pathlib.Path(str(envs.physics.fused.__file__)).parent
_KEPT = ROOT / ".cache" / "threads"

Rows = dict[str, np.ndarray]


def runner(tables: Tables, dtype: type[np.floating]) -> Callable[..., Rows]:
    """A function of qpos [n, nq], qvel, warm start [n, nv] and ctrl [n, nu]: rows of new ones, overflow and readouts.

    With `whole=False` it evaluates qacc of the states instead of a control step; the row is `warmstart`.
    """
    library = _built(threads.source(tables), np.dtype(dtype).name)

    def run(*arrays: np.ndarray, whole: bool = True) -> Rows:
        given = [np.ascontiguousarray(x, dtype) for x in arrays]
        sizes = {"qpos": tables.nq, "qvel": tables.nv, "warmstart": tables.nv, "overflow": 1, "read": tables.width}
        out = {name: np.zeros((len(given[0]), size), dtype) for name, size in sizes.items()}
        addresses = [x.ctypes.data_as(ctypes.c_void_p) for x in (*given, *out.values())]
        library.run(len(given[0]), int(whole), *addresses, tables.width)
        return out

    return run


def world_bytes(tables: Tables) -> int:
    """Of what the lanes of a world share on a GPU."""
    return _built(threads.source(tables), "float32").world_bytes()


@functools.cache
def _built(source: str, dtype: str) -> ctypes.CDLL:
    """The library, kept for all processes of the tests and the next time, under a hash of all that it is made of."""
    real = {"float32": "float", "float64": "double"}[dtype]
    flags = ["-O1", "-std=c++17", "-shared", "-fPIC", f"-DREAL={real}"]
    headers = [path.read_bytes() for path in (_SOURCE, *sorted(_FOLDER.glob("*.h")))]
    made_of = repr((source, headers, flags, _version(), platform.machine()))
    library = _KEPT / f"{hashlib.sha256(made_of.encode()).hexdigest()[:20]}.so"
    if not library.exists():
        _KEPT.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=_KEPT) as folder:
            model, part = pathlib.Path(folder) / "tables.h", pathlib.Path(folder) / "part.so"
            model.write_text(source)
            paths = [f'-DMODEL="{model}"', f"-I{_FOLDER}", "-o", str(part), str(_SOURCE)]
            subprocess.run([str(COMPILER), *flags, *paths], check=True)
            part.replace(library)
    return ctypes.CDLL(str(library))


@functools.cache
def _version() -> str:
    return subprocess.run([str(COMPILER), "--version"], check=True, capture_output=True, text=True).stdout
