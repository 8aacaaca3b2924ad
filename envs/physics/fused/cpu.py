"""The fused step on CPUs: compiled at first use by whatever C++ compiler is there, kept in a cache, called by XLA.

The cache's key has the sources, the model's tables, the compiler with its version and flags, the CPU's own flags (the
code is for this machine) and jaxlib's version (its header). A library is put in place at once, so that processes which
compile at the same time do not see each other's halves.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import hashlib
import importlib.util
import os
import pathlib
import platform
import shlex
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import numpy as np

from ...progress import announce
from .header import header
from .model import Tables

Step = Callable[[jax.Array, jax.Array, jax.Array, jax.Array], list[jax.Array]]

HERE = pathlib.Path(__file__).parent
INSTALL = "install g++ or clang++, or pip install 'pmt-jax[native]'"
_SOURCES = ("lanes.cpp", *sorted(path.name for path in HERE.glob("lanes*.h")))
_SOURCES += ("algebra.h", "boxes.h", "formulae.h", "rows.h", "vector.h")
_FLAGS = "-O3 -std=c++17 -shared -fPIC -fno-math-errno -fno-trapping-math -ffp-contract=fast".split()
_PATIENCE = 600.0  # seconds for a compiler; one on a loaded machine took 20


class NoLibrary(Exception):
    """No compiler made a library; the reason is the rest of a sentence that begins with the engine's name."""


class Compiler(NamedTuple):
    """A C++ compiler.

    Attributes:
      command: its words.
      version: the first line it says of itself.
    """

    command: tuple[str, ...]
    version: str


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
    target = _register(library(tables, real))
    widths = (tables.nq, tables.nv, tables.nv, tables.width, 1)

    def step(*operands: jax.Array) -> list[jax.Array]:
        shape, dtype = operands[0].shape[:-1], operands[0].dtype
        results = [jax.ShapeDtypeStruct((*shape, width), dtype) for width in widths]
        return list(jax.ffi.ffi_call(target, results)(*operands, threads=np.int64(threads)))

    return step


_registering = threading.Lock()
_registered: dict[str, ctypes.CDLL] = {}  # XLA keeps the addresses for the life of the process


def _register(path: pathlib.Path) -> str:
    """The library's function by the name under which XLA finds it, which is that of the file: its key is in it."""
    name = f"pmt_{path.stem}"
    with _registering:
        if name not in _registered:
            _registered[name] = ctypes.CDLL(str(path))
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(_registered[name].fused_step), platform="cpu")
    return name


# -- compilers --


def compilers() -> Iterator[Compiler]:
    """What can compile C++ here, by preference: $CXX, c++, g++, clang++, zig of PyPI's ziglang."""
    if chosen := os.environ.get("CXX", ""):
        yield from _asked(tuple(shlex.split(chosen)))
    for name in ("c++", "g++", "clang++"):
        if found := shutil.which(name):
            yield from _asked((found,))
    with contextlib.suppress(ImportError, ValueError):
        spec = importlib.util.find_spec("ziglang")
        for place in (spec.submodule_search_locations or ()) if spec else ():
            yield from _asked((str(pathlib.Path(place) / "zig"), "c++"))


@functools.cache
def _asked(command: tuple[str, ...]) -> tuple[Compiler, ...]:
    """The compiler, if it says what it is."""
    try:
        done = _run([*command, "--version"], 60.0)
    except (OSError, subprocess.SubprocessError):
        return ()
    return () if done.returncode else (Compiler(command, (done.stdout.splitlines() or [""])[0].strip()),)


def obstacle() -> str | None:
    """Why nothing can be compiled here, as the rest of a sentence; None if a compiler is there and has not failed."""
    if _failures:
        return f"could not be compiled: {_failures[-1]} ({INSTALL})"
    if next(compilers(), None) is None:
        return f"needs a C++ compiler; found none ({INSTALL})"
    return None


_failures: list[str] = []  # of this process


def describe() -> str:
    """The compiler that is taken first."""
    compiler = next(compilers())
    return f"compiled by {shlex.join(compiler.command)} ({compiler.version})"


def _run(command: list[str], patience: float, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=patience,
        stdin=subprocess.DEVNULL,
        env=os.environ | environment,
        check=False,
    )


# -- libraries --


def library(tables: Tables, real: str = "double") -> pathlib.Path:
    """The compiled library of a model's step, from the cache if it is there.

    Raises:
      NoLibrary: no compiler here makes one that loads.
    """
    text, reasons = header(tables), []
    for compiler in compilers():
        name = f"fused_{_key(compiler, text, real)}.so"
        found = _folder() / name
        if found.exists() and _loads(found) is None:
            return found
        announce(f"compiling the physics ({compiler.command[0]}) ...")
        reason = _compile(compiler, text, real, found)
        if reason is None:
            return found
        reasons.append(f"{shlex.join(compiler.command)}: {reason}")
    if not reasons:
        raise NoLibrary(f"needs a C++ compiler; found none ({INSTALL})")
    _failures.append("; ".join(reasons))
    raise NoLibrary(f"could not be compiled: {_failures[-1]} ({INSTALL})")


def _compile(compiler: Compiler, text: str, real: str, target: pathlib.Path) -> str | None:
    """Writes the library to `target`; the reason if that fails."""
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        place = pathlib.Path(folder)
        (place / "model.h").write_text(text)
        part = place / "part.so"
        paths = ["-isystem", jax.ffi.include_dir(), f"-I{folder}", f"-I{HERE}", str(HERE / "lanes.cpp")]
        command = [*_command(compiler, real), *paths, "-o", str(part)]
        zig = {name: str(target.parent / "zig") for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")}
        try:
            done = _run(command, _PATIENCE, **{name: value for name, value in zig.items() if name not in os.environ})
        except (OSError, subprocess.SubprocessError) as error:
            return str(error)
        if done.returncode:
            lines = done.stderr.splitlines()
            return next((line for line in lines if "error" in line), (lines or [f"exit code {done.returncode}"])[-1])
        reason = _loads(part)
        if reason is None:
            part.replace(target)
        return reason


def _command(compiler: Compiler, real: str) -> list[str]:
    """The command without its paths, on which the library does not depend."""
    arm = platform.machine() in ("aarch64", "arm64")
    flags = [*_FLAGS, "-mcpu=native" if arm else "-march=native", f"-DREAL={real}", '-DMODEL="model.h"']
    if compiler.command[-1] == "c++" and "zig" in pathlib.Path(compiler.command[0]).name:
        flags.append("-nostdlib++")  # or its first use builds a C++ library, for 40 seconds
    return [*compiler.command, *flags]


def _key(compiler: Compiler, text: str, real: str) -> str:
    sources = [(HERE / name).read_text() for name in _SOURCES]
    parts = (*sources, text, compiler.version, _command(compiler, real), cpu_flags(), jax.lib.__version__)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:20]


@functools.cache
def cpu_flags() -> str:
    """What this machine's CPU can do, on which code for it depends."""
    with contextlib.suppress(OSError):
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                return line.partition(":")[2].strip()
    return f"{platform.machine()} {platform.processor()} {platform.node()}"


def _loads(path: pathlib.Path) -> str | None:
    """Why a library cannot be used; None if it can."""
    try:
        _ = ctypes.CDLL(str(path)).fused_step
    except (OSError, AttributeError) as error:
        return f"made no library that loads: {error}"
    return None


@functools.cache
def _folder() -> pathlib.Path:
    """Where libraries are kept: a cache folder, or one of this process alone where none can be written."""
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    with contextlib.suppress(OSError, RuntimeError):
        home = pathlib.Path(chosen) if os.path.isabs(chosen) else pathlib.Path.home() / ".cache"
        place = home / "pmt-jax" / "fused"
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return place
    folder = tempfile.mkdtemp(prefix="pmt-fused-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return pathlib.Path(folder)
