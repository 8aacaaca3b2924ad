"""Ctrl-C and SIGTERM, noted instead of raised: an exception could land inside the physics."""

from __future__ import annotations

import contextlib
import signal
import types
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def noted(act: Callable[[int], None]) -> Iterator[list[int]]:
    """Yields the list of the signals that have arrived; `act` is called with each at once.

    Outside of the main thread, where signals cannot be caught, none arrives.
    """
    received: list[int] = []

    def note(number: int, _: types.FrameType | None) -> None:
        received.append(number)
        act(number)

    try:
        before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:
        before = {}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
