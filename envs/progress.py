"""Lines about what takes long while a task is made, for whoever shows progress."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

Listener = Callable[[str], object]

_listeners: list[Listener] = []  # the last one gets the lines


def announce(line: str) -> None:
    """Passes a line on, before what it names begins."""
    for listener in _listeners[-1:]:
        listener(line)


@contextlib.contextmanager
def announcing(listener: Listener) -> Iterator[None]:
    """Calls `listener` with the lines about what is made inside."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)
