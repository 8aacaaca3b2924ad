"""A Python function inside a compiled CPU program, through XLA's stable foreign-function interface.

`jax.pure_callback` would do the same in fewer lines, but it (1) turns the operands into JAX arrays inside the callback,
which waits for the very threads that wait for the callback once a batch is large, and (2) keeps every program that
contains one out of the persistent compile cache. A target registered by name does neither: the function gets NumPy
views of XLA's own buffers, and the program on disk holds only the name.

The C structures below are version 0.3 of XLA's FFI ABI (`jaxlib/include/xla/ffi/api/c_api.h`); XLA supports an ABI
version for at least twelve months and only ever appends fields; `tests/envs/physics/test_host_call.py` fails
when that ends.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import threading
import traceback
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

HostFunction = Callable[[np.ndarray, np.ndarray], None]  # (operand, result to be filled)

ABI = (0, 3)
_EXECUTE = 3
METADATA = 1
_INTERNAL = 13
_DTYPES = {code: np.dtype(name) for code, name in ((4, "int32"), (5, "int64"), (11, "float32"), (12, "float64"))}


def _struct(name: str, *fields: tuple[str, type]) -> type[ctypes.Structure]:
    header = [("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p)]
    return type(name, (ctypes.Structure,), {"_fields_": [*header, *fields]})


class Buffer(ctypes.Structure):
    """XLA_FFI_Buffer: an operand or a result."""

    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    ]

    @property
    def shape(self) -> tuple[int, ...]:
        """Its sizes."""
        return tuple(self.dims[: self.rank])


class Buffers(ctypes.Structure):
    """XLA_FFI_Args and XLA_FFI_Rets: all operands or all results."""

    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("items", ctypes.POINTER(ctypes.POINTER(Buffer))),
    ]

    def buffers(self) -> list[Buffer]:
        """Each of them."""
        return [self.items[k].contents for k in range(self.size)]


class Frame(ctypes.Structure):
    """XLA_FFI_CallFrame: what a handler gets. `operands` and `results` have `buffers()` with `data` and `shape`."""

    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("api", ctypes.c_void_p),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("operands", Buffers),
        ("results", Buffers),
    ]


Version = _struct("XLA_FFI_Api_Version", ("major", ctypes.c_int), ("minor", ctypes.c_int))
ErrorArguments = _struct("XLA_FFI_Error_Create_Args", ("message", ctypes.c_char_p), ("code", ctypes.c_int))
_Stream = _struct("XLA_FFI_Stream_Get_Args", ("context", ctypes.c_void_p), ("stream", ctypes.c_void_p))
Api = _struct(
    "XLA_FFI_Api",
    ("version", Version),
    ("internal", ctypes.c_void_p),
    *((name, ctypes.c_void_p) for name in ("create_error", "error_message", "destroy_error", "register", "get_stream")),
)


class Metadata(ctypes.Structure):
    """XLA_FFI_Metadata: the version of the ABI that a handler answers in."""

    _fields_ = [("struct_size", ctypes.c_size_t), ("version", Version), ("traits", ctypes.c_uint32)]


class Extension(ctypes.Structure):
    """XLA_FFI_Metadata_Extension: how XLA asks a handler for its metadata."""

    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(Metadata)),
    ]


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(Frame))
_Entry = ctypes.PYFUNCTYPE(None, ctypes.POINTER(Frame))
_CreateError = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(ErrorArguments))
_GetStream = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Stream))

_names = itertools.count()
handlers: list[Any] = []  # XLA keeps the addresses for the life of the process
_arrived: set[int] = set()  # threads that got from XLA into Python


class GivenUp(RuntimeError):
    """Raised by a host function to end the program on purpose: its message becomes the error, without a traceback."""


def register(function: HostFunction) -> str:
    """Makes `function` callable from compiled programs on CPUs and returns the name to call it by.

    `function` runs on XLA's thread with the interpreter lock held, must fill its result and must not call JAX; what it
    raises becomes the program's error, and its traceback goes to stderr.
    """
    return register_handler(lambda frame: function(_array(frame.operands), _array(frame.results)), "cpu")


def register_handler(function: Callable[[Frame], None], platform: str) -> str:
    """Like `register`, of a function of XLA's call frame, for programs on `platform` (cpu, CUDA).

    Names count up in the order of registration, so a program compiled in one process is found in the cache by the next
    that registers in the same order.
    """

    def handle(_: None, __: Any, arguments: tuple[Any, ...]) -> int | None:
        try:
            if threading.get_ident() not in _arrived:
                raise GivenUp("interrupted (Ctrl-C)")
            _arrived.discard(threading.get_ident())
            frame = arguments[0].contents
            if not (frame.extension and describe(frame.extension)) and frame.stage == _EXECUTE:
                function(frame)
            return None
        except BaseException as error:
            return _error(arguments[0].contents.api, error)

    # ctypes prints what a callback raises, and XLA then reads whatever is on the stack as the returned error. A `try`
    # does not help against Ctrl-C, which strikes at the first bytecode after XLA's own work, before any `try`. So the
    # first Python to run is `entry`, whose result is not used; `handle` then checks that it ran.
    entry = _Entry(lambda _: _arrived.add(threading.get_ident()))
    entry.errcheck = handle  # pyright: ignore[reportAttributeAccessIssue]
    handler = _Handler(entry)
    name = f"pmt_host_call_{next(_names)}"
    handlers.append(handler)
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler), platform=platform)
    return name


def stream_of(frame: Frame) -> int:
    """The CUDA stream that a program on a GPU calls from."""
    arguments = _Stream(ctypes.sizeof(_Stream), None, frame.context, None)
    failed = _GetStream(Api.from_address(frame.api).get_stream)(ctypes.byref(arguments))
    if failed:
        raise RuntimeError("XLA gives no stream")
    return arguments.stream or 0


def host_call(name: str, operand: jax.Array, width: int) -> jax.Array:
    """The registered function `name` on `operand` [..., I]: [..., width] of its dtype; batch axes come from vmap."""
    result = jax.ShapeDtypeStruct((*operand.shape[:-1], width), operand.dtype)
    return jax.ffi.ffi_call(name, result, vmap_method="broadcast_all")(operand)


def describe(extension_address: int) -> bool:
    """Reports the ABI version to XLA; False if XLA did not query it."""
    extension = Extension.from_address(extension_address)
    if extension.type != METADATA:
        return False
    version = extension.metadata.contents.version
    version.major, version.minor = ABI
    extension.metadata.contents.traits = 0
    return True


def _array(buffers: Buffers) -> np.ndarray:
    """The first of XLA's buffers as an array that shares its memory."""
    buffer = buffers.buffers()[0]
    shape, dtype = buffer.shape, _DTYPES[buffer.dtype]
    size = math.prod(shape) * dtype.itemsize
    if size == 0:
        return np.empty(shape, dtype)
    return np.frombuffer(memoryview((ctypes.c_char * size).from_address(buffer.data)), dtype).reshape(shape)


def _error(api_address: int, error: BaseException) -> int | None:
    """Converts an exception to XLA's error, which XLA then owns."""
    if isinstance(error, Exception) and not isinstance(error, GivenUp):
        traceback.print_exception(error)
    message = f"{type(error).__name__}: {error}".encode(errors="replace")
    arguments = ErrorArguments(ctypes.sizeof(ErrorArguments), None, message, _INTERNAL)
    return _CreateError(Api.from_address(api_address).create_error)(ctypes.byref(arguments))
