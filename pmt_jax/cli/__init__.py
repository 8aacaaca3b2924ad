"""The command line: words into settings, nothing else; one file for the commands of each package.

Imports everything below it, most of it only when a command runs."""

from __future__ import annotations

import atexit
import codecs
import contextlib
import gc
import os
import sys
import threading
from collections.abc import Sequence
from typing import NoReturn

OBJECTS = 100_000  # new ones before Python looks for garbage; a trace makes many that stay


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code: 2 for a user's mistake, 130 for Ctrl-C, while Python imports too."""
    if argv is None:
        _use_utf8()
    try:
        gc.set_threshold(OBJECTS)  # with Python's 700, a sixth of the time to start is spent on that
        from . import commands

        return commands.run(argv)
    except KeyboardInterrupt:
        return 130


def run(argv: Sequence[str] | None = None) -> NoReturn:
    """`main`, then the end of the process without that of the interpreter.

    A thread of C++ that frees an array of Python's while the interpreter ends aborts the process, with the run saved
    and another exit code. What is registered to run at the end runs before.
    """
    end(main(argv))


def end(code: int) -> NoReturn:
    """The end of the process, without that of the interpreter, as `run` says."""
    with contextlib.suppress(KeyboardInterrupt):
        # As Python does: the threads of pools wait until this tells them to end.
        threading._shutdown()  # pyright: ignore[reportAttributeAccessIssue]
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # closed, or nobody reads it any more
            stream.flush()
    os._exit(code)


def _use_utf8() -> None:
    """Starts this process anew in Python's UTF-8 mode where the locale has another encoding (LC_ALL=C).

    Checkpoints take file names in UTF-8 alone, and the program reads and writes texts in it.
    """
    if codecs.lookup(sys.getfilesystemencoding()).name == "utf-8" or "utf8" in sys._xoptions or not sys.executable:
        return
    os.environ["PYTHONUTF8"] = "1"  # for processes that this one starts
    os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
