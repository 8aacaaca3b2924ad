"""Warp's kernels before the first step. Warp itself compiles each where it is first launched, one after the other."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from typing import Any

import jax

_Launches = dict[tuple[Any, int], None]  # Warp's modules, and the threads a block that each is compiled for


def of_launches(step: Callable[[], None]) -> list[Callable[[], Any]]:
    """What `step` launches; each entry compiles a part and loads it, on any thread.

    Only the step determines which kernels a model needs, so it is called here. Its launches are recorded, and nothing
    runs. Warp compiles modules, most of which hold one kernel. A module in Warp's cache is only loaded.
    """
    import warp

    device = devices()[0]
    with warp.ScopedDevice(device), _recorded() as launches:
        step()
    return [functools.partial(module.load, device, block_dim=size) for module, size in launches]


def devices() -> list[Any]:
    """Warp's devices that are JAX's local ones, in JAX's order; a CPU's host devices are one of Warp's."""
    import warp

    present = jax.local_devices()
    if present[0].platform != "gpu":
        return [warp.get_device("cpu")]
    return [warp.get_cuda_device(device.local_hardware_id) for device in present]


_HOOKING = threading.Lock()


@contextlib.contextmanager
def _recorded() -> Iterator[_Launches]:
    """Yields the launches of this thread without running them: Warp launches nothing whose module does not load."""
    import warp
    from warp._src.context import Module

    launches, thread = _Launches(), threading.get_ident()
    load, suggest = Module.load, warp.get_suggested_block_size

    def record(module: Any, device: Any, block_dim: int | None = None, *rest: Any, **named: Any) -> Any:
        if threading.get_ident() != thread:
            return load(module, device, block_dim, *rest, **named)
        launches[module, block_dim or module.options["block_dim"]] = None

    def record_asked(kernel: Any, device: Any = None) -> tuple[int, int]:
        if threading.get_ident() != thread or not warp.get_device(device).is_cuda:
            return suggest(kernel, device)
        record(kernel.module, device)  # it is loaded to be asked
        return 256, 1

    with _HOOKING:
        Module.load, warp.get_suggested_block_size = record, record_asked
        try:
            yield launches
        finally:
            Module.load, warp.get_suggested_block_size = load, suggest
