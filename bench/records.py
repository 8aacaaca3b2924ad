"""Rows of a bench on disk, with what they were measured on."""

from __future__ import annotations

import json
import pathlib
from typing import Any

import jax

Rows = list[dict[str, Any]]


def write(out: pathlib.Path, rows: Rows, **more: Any) -> None:
    """Writes `rows` with versions and device beside them, and whatever else belongs there."""
    versions = {"jax": jax.__version__, "device": jax.devices()[0].device_kind}
    out.write_text(json.dumps({"versions": versions, **more, "rows": rows}, indent=1) + "\n")


def read(source: pathlib.Path) -> Rows:
    """The rows that `write` wrote."""
    return json.loads(source.read_text())["rows"]
