"""The command line: words into settings, one file a command. Imports everything below it."""

from .main import answer, main

__all__ = ["answer", "main"]
