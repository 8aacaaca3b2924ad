"""C++ code that XLA calls: compiled at first use by whatever compiler is there, kept in a cache.

The cache's key has the sources, the compiler with its version and flags, the CPU's own flags (the code is for this
machine) and jaxlib's version (its header). A library is put in place at once, so that processes which compile at the
same time do not see each other's halves.
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
from collections.abc import Iterator
from typing import NamedTuple

import jax

from .progress import announce
from .versions import installed_version

HEADER = pathlib.Path(__file__).parent / "native.h"
INSTALL = "install g++ or clang++, or pip install 'pmt-jax[native]'"
FLAGS = "-O3 -std=c++17 -shared -fPIC -fno-math-errno -fno-trapping-math -ffp-contract=fast".split()
PATIENCE = 600.0  # seconds for a compiler; one on a loaded machine took 20


class NoLibrary(Exception):
    """No compiler made a library; the reason is the rest of a sentence that begins with its name."""


class Compiler(NamedTuple):
    """A C++ compiler.

    Attributes:
      command: its words.
      version: the first line it says of itself.
    """

    command: tuple[str, ...]
    version: str


class Code(NamedTuple):
    """What a library is made of.

    Attributes:
      name: of the library. what: is compiled, for whoever waits.
      sources: files; the first one is compiled, and includes the others.
      functions: that XLA calls.
      made: file that was made for this library, by its name.
      defined: macros.
    """

    name: str
    what: str
    sources: tuple[pathlib.Path, ...]
    functions: tuple[str, ...]
    made: tuple[tuple[str, str], ...] = ()
    defined: tuple[str, ...] = ()


_registering = threading.Lock()
_registered: dict[pathlib.Path, ctypes.CDLL] = {}  # XLA keeps the addresses for the life of the process


def targets(code: Code) -> list[str]:
    """The code's functions by the names under which XLA finds them: those of the file, as its key is in it.

    Raises:
      NoLibrary: no compiler here makes them.
    """
    path = library(code)
    names = [f"pmt_{path.stem}_{function}" for function in code.functions]
    with _registering:
        if path not in _registered:
            _registered[path] = loaded = ctypes.CDLL(str(path))
            for name, function in zip(names, code.functions, strict=True):
                jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(loaded, function)), platform="cpu")
    return names


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


def obstacle(name: str) -> str | None:
    """Why a library cannot be made here, the rest of a sentence; None if a compiler is there and has not failed."""
    if name in failures:
        return f"could not be compiled: {failures[name]} ({INSTALL})"
    if next(compilers(), None) is None:
        return f"needs a C++ compiler; found none ({INSTALL})"
    return None


failures: dict[str, str] = {}  # of this process, by the library's name


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


def library(code: Code) -> pathlib.Path:
    """The compiled library, from the cache if it is there.

    Raises:
      NoLibrary: no compiler here makes one that loads.
    """
    reasons = []
    for compiler in compilers():
        found = cache_folder() / f"{code.name}_{key_of(compiler, code)}.so"
        if found.exists() and _loads(found, code) is None:
            return found
        announce(f"compiling {code.what} ({compiler.command[0]}) ...")
        reason = _compile(compiler, code, found)
        if reason is None:
            return found
        reasons.append(f"{shlex.join(compiler.command)}: {reason}")
    if not reasons:
        raise NoLibrary(f"needs a C++ compiler; found none ({INSTALL})")
    failures[code.name] = "; ".join(reasons)
    raise NoLibrary(f"could not be compiled: {failures[code.name]} ({INSTALL})")


def _compile(compiler: Compiler, code: Code, target: pathlib.Path) -> str | None:
    """Writes the library to `target`; the reason if that fails."""
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        place = pathlib.Path(folder)
        for name, text in code.made:
            (place / name).write_text(text)
        part = place / "part.so"
        folders = dict.fromkeys([place, *(source.parent for source in code.sources)])
        paths = ["-isystem", jax.ffi.include_dir(), *(f"-I{path}" for path in folders), str(code.sources[0])]
        command = [*_command(compiler, code), *paths, "-o", str(part)]
        zig = {name: str(target.parent / "zig") for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")}
        try:
            done = _run(command, PATIENCE, **{name: value for name, value in zig.items() if name not in os.environ})
        except (OSError, subprocess.SubprocessError) as error:
            return str(error)
        if done.returncode:
            lines = done.stderr.splitlines()
            return next((line for line in lines if "error" in line), (lines or [f"exit code {done.returncode}"])[-1])
        reason = _loads(part, code)
        if reason is None:
            part.replace(target)
        return reason


def _command(compiler: Compiler, code: Code) -> list[str]:
    """The command without its paths, on which the library does not depend; flags in $CXX win, as they come last."""
    words = compiler.command
    count = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
    program, chosen = words[:count], words[count:]
    arm = platform.machine() in ("aarch64", "arm64")
    flags = [*FLAGS, "-mcpu=native" if arm else "-march=native", *(f"-D{macro}" for macro in code.defined)]
    if program[-1] == "c++" and "zig" in pathlib.Path(program[0]).name:
        flags.append("-nostdlib++")  # or its first use builds a C++ library, for 40 seconds
    return [*program, *flags, *chosen]


def key_of(compiler: Compiler, code: Code) -> str:
    """A hash of all that the library depends on."""
    sources = [source.read_text() for source in code.sources]
    parts = (*sources, code.made, compiler.version, _command(compiler, code), cpu_flags(), installed_version("jaxlib"))
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:20]


@functools.cache
def cpu_flags() -> str:
    """What this machine's CPU can do, on which code for it depends."""
    with contextlib.suppress(OSError):
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                return line.partition(":")[2].strip()
    return f"{platform.machine()} {platform.processor()} {platform.node()}"


def _loads(path: pathlib.Path, code: Code) -> str | None:
    """Why a library cannot be used; None if it can."""
    try:
        _ = [getattr(ctypes.CDLL(str(path)), function) for function in code.functions]
    except (OSError, AttributeError) as error:
        return f"made no library that loads: {error}"
    return None


def cache_of_user() -> pathlib.Path:
    """Where this package keeps what it compiles: `~/.cache/pmt-jax`, or below $XDG_CACHE_HOME.

    Raises:
      RuntimeError: the user has no home.
    """
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    # By the XDG standard, a path that is empty or relative does not count.
    home = pathlib.Path(chosen) if os.path.isabs(chosen) else pathlib.Path.home() / ".cache"
    return home / "pmt-jax"


@functools.cache
def cache_folder() -> pathlib.Path:
    """Where libraries are kept: a cache folder, or one of this process alone where none can be written."""
    with contextlib.suppress(OSError, RuntimeError):
        place = cache_of_user() / "fused"
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return place
    folder = tempfile.mkdtemp(prefix="pmt-fused-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return pathlib.Path(folder)
