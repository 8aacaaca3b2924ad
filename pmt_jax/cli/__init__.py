"""The command line: words into settings, nothing else; one file for the commands of each package.

Imports everything below it, most of it only when a command runs."""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code: 2 for a user's mistake, 130 for Ctrl-C, while Python imports too."""
    try:
        from . import commands

        return commands.run(argv)
    except KeyboardInterrupt:
        return 130
