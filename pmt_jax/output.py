"""Standard output that may close at any time (`pmt train | head`, a terminal that is gone)."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator
from typing import TextIO

from .errors import UsageError

Say = Callable[[str], None]
CLOSED = (errno.EPIPE, errno.EIO)  # the reader has ended, or the terminal is gone: nobody waits for the rest
_dropped: list[OSError] = []  # why output is no longer written


def say(line: str) -> None:
    """Prints a line at once, into a pipe too; drops it if standard output is closed.

    Line and newline are one write: threads that repeat what worker processes say would mix theirs otherwise.
    """
    with dropped_if_closed():
        print(f"{fitted(line, sys.stdout)}\n", end="", flush=True)


def fitted(text: str, file: TextIO) -> str:
    """`text` as it is printed: on a terminal, lines of prose that are too wide for it break between words.

    Lines with columns (two spaces in a row) stay as they are, and so does all that goes into a pipe or a file.
    """
    try:
        width = shutil.get_terminal_size().columns if file.isatty() else 0
    except ValueError:  # it is closed
        width = 0
    if not width:
        return text
    return "\n".join(_broken(line, width) if len(line) > width else line for line in text.split("\n"))


def _broken(line: str, width: int) -> str:
    prose = line.lstrip()
    if "  " in prose:
        return line
    indent = " " * (len(line) - len(prose))
    wrapper = textwrap.TextWrapper(width, indent, f"{indent}  ", break_long_words=False, break_on_hyphens=False)
    return wrapper.fill(prose)


def result(text: str) -> None:
    """Prints what a command was asked for, lines without the last newline; drops it if the reader has ended.

    Raises:
      UsageError: as `check_written`.
    """
    say(text)
    check_written()


def check_written() -> None:
    """Whether all that this command has printed was written, or its reader has ended.

    Raises:
      UsageError: it was not: a full disk, a quota.
    """
    lost = next((error for error in _dropped if error.errno not in CLOSED), None)
    if lost is not None:
        raise UsageError(f"cannot write to standard output: {lost.strerror or lost}; the result is not complete")


def begin() -> None:
    """Forgets what an earlier command of this process could not write."""
    _dropped.clear()


def silent(line: str) -> None:
    """Prints nothing."""
    del line


@contextlib.contextmanager
def dropped_if_closed() -> Iterator[None]:
    """Output that fails inside is dropped, and so is all that follows; the program continues."""
    try:
        yield
    except OSError as error:  # EPIPE of a pipe, EIO of a terminal, ENOSPC of a file
        _dropped.append(error)
        with contextlib.suppress(OSError):  # a captured standard output has no descriptor
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
