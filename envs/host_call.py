"""Calling Python on the host from inside a jitted program on CPU, without JAX in between.

`jax.pure_callback` wraps every argument into a JAX array first, which waits for XLA's thread pool from inside that very
pool (a known deadlock on machines with few cores), and on jax 0.9 a program that contains one is never written to the
persistent compile cache. Here XLA calls a C function pointer made by ctypes, through its foreign function interface:
arguments and result are views of XLA's own buffers, and the program names its function by a number that is the same in
every process, so it caches. The structures below are the beginnings of those in jaxlib's `xla/ffi/api/c_api.h`; with
a jax newer than those looked at, `call` falls back to `jax.pure_callback`.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

HostFunction = Callable[[np.ndarray, np.ndarray], None]  # (arguments [..., D], result [..., E] to fill)

_LOOKED_AT = ((0, 9), (0, 13))  # jax versions from, and up to but without, whose C interface is the one below
_TARGET = "pmt_host_call"
_METADATA = 1  # XLA_FFI_Extension_Metadata: XLA asks which interface version the handler was written for
_INTERNAL = 13  # XLA_FFI_Error_Code_INTERNAL
_DTYPES = {11: np.dtype(np.float32), 12: np.dtype(np.float64)}  # XLA_FFI_DataType_F32, _F64

_functions: dict[int, HostFunction] = {}


def register(key: int, function: HostFunction) -> None:
    """Makes `function` callable as `key`, a 63-bit number that means the same function in every process."""
    _functions[key] = function


def call(key: int, width: int, argument: jax.Array) -> jax.Array:
    """`argument` [D] to the registered function's result [width] of the same dtype; under `vmap` one call for all rows.

    The function must be pure, must not call JAX, and runs on one of XLA's threads.
    """
    result = jax.ShapeDtypeStruct((width,), argument.dtype)
    if _LOOKED_AT[0] <= jax.__version_info__[:2] < _LOOKED_AT[1]:
        _register_target()
        return jax.ffi.ffi_call(_TARGET, result, vmap_method="broadcast_all")(argument, key=np.int64(key))
    return jax.pure_callback(functools.partial(_returning, key, width), result, argument, vmap_method="broadcast_all")


def _returning(key: int, width: int, argument: Any) -> np.ndarray:
    argument = np.asarray(argument)
    result = np.empty((*argument.shape[:-1], width), argument.dtype)
    _functions[key](argument, result)
    return result


@functools.cache
def _register_target() -> None:
    jax.ffi.register_ffi_target(_TARGET, jax.ffi.pycapsule(_handler_pointer), platform="cpu")


# Every structure starts with its size and a list of extensions.
_HEAD = [("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p)]


class _Buffer(ctypes.Structure):
    _fields_ = [
        *_HEAD,
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    ]


class _Buffers(ctypes.Structure):  # XLA_FFI_Args and XLA_FFI_Rets
    _fields_ = [
        *_HEAD,
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("items", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    ]


class _Scalar(ctypes.Structure):
    _fields_ = [("dtype", ctypes.c_int), ("value", ctypes.POINTER(ctypes.c_int64))]


class _Attributes(ctypes.Structure):
    _fields_ = [
        *_HEAD,
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("names", ctypes.c_void_p),
        ("items", ctypes.POINTER(ctypes.POINTER(_Scalar))),
    ]


class _Version(ctypes.Structure):
    _fields_ = [*_HEAD, ("major", ctypes.c_int), ("minor", ctypes.c_int)]


class _Error(ctypes.Structure):  # XLA_FFI_Error_Create_Args
    _fields_ = [*_HEAD, ("message", ctypes.c_char_p), ("code", ctypes.c_int)]


class _Api(ctypes.Structure):
    _fields_ = [
        *_HEAD,
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("create_error", ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Error))),
    ]


class _Metadata(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("version", _Version)]


class _Extension(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),
    ]


class _CallFrame(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
        ("attributes", _Attributes),
    ]


def _view(buffer: _Buffer) -> np.ndarray:
    """XLA's memory as an array; valid until the handler returns."""
    shape, dtype = buffer.dims[: buffer.rank], _DTYPES[buffer.dtype]
    size = int(np.prod(shape)) * dtype.itemsize
    if not size:
        return np.empty(shape, dtype)
    return np.frombuffer((ctypes.c_char * size).from_address(buffer.data), dtype).reshape(shape)


def _handle(frame_pointer: Any) -> int | None:
    """What XLA calls: None where all went well, else a pointer to XLA's own kind of error."""
    frame = frame_pointer.contents
    if frame.extension and frame.extension.contents.type == _METADATA:
        version, offered = frame.extension.contents.metadata.contents.version, frame.api.contents.version
        version.major, version.minor = offered.major, offered.minor
        return None
    try:
        key = frame.attributes.items[0].contents.value[0]
        _functions[key](_view(frame.arguments.items[0].contents), _view(frame.results.items[0].contents))
    except BaseException as error:  # nothing may unwind through C; XLA raises it again as a JaxRuntimeError
        message = f"{type(error).__name__}: {error}".encode()
        return frame.api.contents.create_error(_Error(ctypes.sizeof(_Error), None, message, _INTERNAL))
    return None


_handler_pointer = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_CallFrame))(_handle)
