"""Standard output that may close at any time (`pmt train | head`, a terminal that is gone)."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator

Say = Callable[[str], None]


def say(line: str) -> None:
    """Prints a line at once, into a pipe too; drops it if standard output is closed.

    Line and newline are one write: threads that repeat what worker processes say would mix theirs otherwise.
    """
    with dropped_if_closed():
        print(f"{line}\n", end="", flush=True)


def silent(line: str) -> None:
    """Prints nothing."""
    del line


@contextlib.contextmanager
def dropped_if_closed() -> Iterator[None]:
    """Output that fails inside is dropped, and so is all that follows; the program continues."""
    try:
        yield
    except OSError:  # EPIPE of a pipe, EIO of a terminal, ENOSPC of a file
        with contextlib.suppress(OSError):  # a captured standard output has no descriptor
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
