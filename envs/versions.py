"""Which packages are installed."""

from __future__ import annotations

import importlib.metadata


def installed_version(package: str) -> str | None:
    """A package's version; None where it is missing."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
