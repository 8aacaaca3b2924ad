"""The command line: words into settings, nothing else; one file for the commands of each package.

Imports everything below it, most of it only when a command runs."""

from __future__ import annotations

import codecs
import gc
import os
import sys
from collections.abc import Sequence

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


def _use_utf8() -> None:
    """Starts this process anew in Python's UTF-8 mode where the locale has another encoding (LC_ALL=C).

    Checkpoints take file names in UTF-8 alone, and the program reads and writes texts in it.
    """
    if codecs.lookup(sys.getfilesystemencoding()).name == "utf-8" or "utf8" in sys._xoptions or not sys.executable:
        return
    os.environ["PYTHONUTF8"] = "1"  # for processes that this one starts
    os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
