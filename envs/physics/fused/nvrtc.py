"""PTX, by the run-time compiler that `jax[cuda13]` installs: no toolkit, and no compiler at the user's.

The text is kept in the user's cache, under a hash of all that it is made of.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import importlib.util
import os
import pathlib
import re
import tempfile
from collections.abc import Mapping

from ...errors import TaskError
from ...native import cache_of_user

_FOLDER = pathlib.Path(__file__).parent
_PARTS = ("smooth", "contacts", "solver", "readouts", "step")
_SOURCES = ("kernel.cu", "box_pair.h", "boxes.h", "threads.h", *(f"threads_{part}.h" for part in _PARTS))
# Denormals are nothing that a simulation needs, and a root or reciprocal that heeds them takes longer.
_OPTIONS = ("--std=c++17", "--device-as-default-execution-space", "--ftz=true")
_WORLDS = 16  # at a time on a multiprocessor, which bounds a thread's registers: 128


def step_ptx(tables: str, architecture: str) -> str:
    """PTX of kernel.cu.

    Args:
      tables: of the model, from `threads.source`.
      architecture: of the device, `9.0`.

    Raises:
      TaskError: no NVRTC, or it refuses the source.
    """
    headers = {name: (_FOLDER / name).read_text() for name in _SOURCES} | {"tables.h": tables}
    source = f'#define REAL float\n#define MODEL "tables.h"\n#define BLOCKS {_WORLDS}\n#include "kernel.cu"\n'
    return ptx(source, headers, architecture, "the step")


def ptx(source: str, headers: Mapping[str, str], architecture: str, what: str) -> str:
    """PTX of a source that includes headers, {name: text}, compiled once.

    Args:
      architecture: of the device, `9.0`.
      what: it is, for a message.

    Raises:
      TaskError: no NVRTC, or it refuses the source.
    """
    options = (f"--gpu-architecture=compute_{architecture.replace('.', '')}", *_OPTIONS)
    made_of = [*_version(), source, *options, *(part for item in headers.items() for part in item)]
    key = hashlib.sha256("\0".join(map(str, made_of)).encode()).hexdigest()[:32]
    kept = cache_of_user() / "fused" / f"{key}.ptx"
    with contextlib.suppress(OSError, UnicodeDecodeError):
        return kept.read_text()
    text = compiled(source, headers, options, what)
    with contextlib.suppress(OSError):  # a home that cannot be written: the next process compiles again
        _put(kept, text)
    return text


def _put(path: pathlib.Path, text: str) -> None:
    """Writes a file that other processes see whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=path.parent)
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(text)
        os.replace(name, path)
    except BaseException:
        pathlib.Path(name).unlink(missing_ok=True)
        raise


@functools.cache
def library() -> ctypes.CDLL:
    """NVRTC; its builtins come first, as it looks for them in no folder of its own.

    Raises:
      TaskError: there is none.
    """
    found = next((folder for folder in folders() if any(folder.glob("libnvrtc.so*"))), None)
    try:
        if found is None:
            return ctypes.CDLL("libnvrtc.so")
        for builtins in sorted(found.glob("libnvrtc-builtins.so*")):
            ctypes.CDLL(str(builtins), mode=ctypes.RTLD_GLOBAL)
        return ctypes.CDLL(str(sorted(found.glob("libnvrtc.so*"))[-1]))
    except OSError as error:
        raise TaskError(f"needs NVIDIA's run-time compiler; {error}; pip install -U 'jax[cuda13]'") from None


def folders() -> list[pathlib.Path]:
    """Where NVIDIA's wheels put libraries."""
    spec = importlib.util.find_spec("nvidia")
    roots = [pathlib.Path(root) for root in (spec.submodule_search_locations or ())] if spec else []
    return [folder for root in roots for pattern in ("cu13/lib", "cuda_nvrtc/lib") for folder in root.glob(pattern)]


def obstacle() -> str | None:
    """Why nothing can be compiled here, as the rest of a sentence; None if it can."""
    try:
        library()
    except TaskError as error:
        return str(error)
    return None


@functools.cache
def _version() -> tuple[int, int]:
    major, minor = ctypes.c_int(), ctypes.c_int()
    library().nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    return major.value, minor.value


def compiled(source: str, headers: Mapping[str, str], options: tuple[str, ...], what: str) -> str:
    """PTX of a source that includes headers, {name: text}.

    Raises:
      TaskError: NVRTC is missing, does not start or refuses the source.
    """
    nvrtc, program = library(), ctypes.c_void_p()
    names, texts = (list_of(part) for part in (headers.keys(), headers.values()))
    created = nvrtc.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"source.cu", len(headers), texts, names)
    if created:
        raise TaskError(f"NVIDIA's run-time compiler does not start (error {created})")
    try:
        failed = nvrtc.nvrtcCompileProgram(program, len(options), list_of(options))
        if failed:
            log = _text(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, program)
            first = next((line for line in log.splitlines() if "error" in line), log[:200])
            raise TaskError(f"NVIDIA's run-time compiler {'.'.join(map(str, _version()))} refuses {what}: {first}")
        return for_older_drivers(_text(nvrtc.nvrtcGetPTXSize, nvrtc.nvrtcGetPTX, program))
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def list_of(texts: object) -> ctypes.Array[ctypes.c_char_p]:
    """C strings."""
    encoded = [text.encode() for text in texts]  # pyright: ignore[reportGeneralTypeIssues]
    return (ctypes.c_char_p * len(encoded))(*encoded)


def _text(size_of: object, text_of: object, program: ctypes.c_void_p) -> str:
    size = ctypes.c_size_t()
    size_of(program, ctypes.byref(size))  # pyright: ignore[reportCallIssue]
    buffer = ctypes.create_string_buffer(size.value)
    text_of(program, buffer)  # pyright: ignore[reportCallIssue]
    return buffer.value.decode()


def for_older_drivers(ptx: str) -> str:
    """PTX marked as that of its major version's first release.

    Drivers refuse what a newer minor version marked, even where, as here, it uses nothing new. CUDA 13 writes PTX 9.
    """
    return re.sub(r"^\.version (\d+)\.\d+", r".version \1.0", ptx, count=1, flags=re.MULTILINE)
