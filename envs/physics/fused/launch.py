"""A kernel launched from the host, where XLA does not launch PTX by itself: through its foreign-function interface."""

from __future__ import annotations

import ctypes
import functools
import math
import threading
from typing import TYPE_CHECKING, Any

import jax

from ..host_call import Frame, register_handler, stream_of

if TYPE_CHECKING:
    from .gpu import Kernel


def call(kernel: Kernel, *arrays: jax.Array) -> Any:
    """The kernel's results of arrays; batch axes come from vmap."""
    lead = kernel.batch(arrays[0])
    results = [jax.ShapeDtypeStruct((*lead, *item), arrays[0].dtype) for item in kernel.results]
    return jax.ffi.ffi_call(_registered(kernel), results, vmap_method="broadcast_all")(*arrays)


@functools.cache
def _registered(kernel: Kernel) -> str:
    loaded = {each: _Loaded(each) for each in (kernel, *(kernel.crowded or ())[1:])}

    def handle(frame: Frame) -> None:
        buffers = [*frame.operands.buffers(), *frame.results.buffers()]
        items = math.prod(kernel.batch(buffers[0]))
        if items:
            loaded[kernel.of(items)].launch(stream_of(frame), items, [buffer.data for buffer in buffers])

    return register_handler(handle, platform="CUDA")


class _Loaded:
    """The kernel's code on each device that has launched it."""

    def __init__(self, kernel: Kernel):
        self._kernel, self._functions = kernel, {}
        self._loading = threading.Lock()

    def launch(self, stream: int, items: int, addresses: list[int]) -> None:
        driver, context = _driver(), ctypes.c_void_p()
        _check("cuStreamGetCtx", driver.cuStreamGetCtx(ctypes.c_void_p(stream), ctypes.byref(context)))
        _check("cuCtxPushCurrent", driver.cuCtxPushCurrent_v2(context))
        try:
            values = [ctypes.c_void_p(address) for address in addresses]
            arguments = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
            sizes = (items * self._kernel.blocks, 1, 1, self._kernel.threads, 1, 1, 0)
            function = self._function(context.value)
            _check("cuLaunchKernel", driver.cuLaunchKernel(function, *sizes, ctypes.c_void_p(stream), arguments, None))
        finally:
            driver.cuCtxPopCurrent_v2(ctypes.byref(context))

    def _function(self, context: int | None) -> ctypes.c_void_p:
        with self._loading:
            if context not in self._functions:
                driver, module, function = _driver(), ctypes.c_void_p(), ctypes.c_void_p()
                code = self._kernel.ptx.encode()
                _check("cuModuleLoadData", driver.cuModuleLoadData(ctypes.byref(module), code))
                entry = self._kernel.entry.encode()
                _check("cuModuleGetFunction", driver.cuModuleGetFunction(ctypes.byref(function), module, entry))
                self._functions[context] = function
            return self._functions[context]


@functools.cache
def _driver() -> ctypes.CDLL:
    return ctypes.CDLL("libcuda.so.1")


def _check(what: str, code: int) -> None:
    if code:
        text = ctypes.c_char_p()
        _driver().cuGetErrorString(code, ctypes.byref(text))
        raise RuntimeError(f"{what}: {(text.value or b'error').decode()} ({code})")
