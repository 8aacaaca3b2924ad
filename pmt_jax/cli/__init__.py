"""The command line: words into settings, nothing else; one file for the commands of each package.

Imports everything below it, most of it only when a command runs."""

from __future__ import annotations

import gc
from collections.abc import Sequence

OBJECTS = 100_000  # new ones before Python looks for garbage; a trace makes many that stay


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code: 2 for a user's mistake, 130 for Ctrl-C, while Python imports too."""
    try:
        gc.set_threshold(OBJECTS)  # with Python's 700, a sixth of the time to start is spent on that
        from . import commands

        return commands.run(argv)
    except KeyboardInterrupt:
        return 130
