"""Rows of a bench on disk, with where, when and with what they were measured."""

from __future__ import annotations

import datetime
import json
import os
import pathlib
import platform
import subprocess
import time
from collections.abc import Sequence
from typing import Any

import jax

from envs.physics import usable_cpus
from pmt_jax.files import replace_text
from pmt_jax.training.run_folder import version

Rows = list[dict[str, Any]]

PACKAGES = ("jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "warp-lang", "numpy")
_BEGIN = time.monotonic()


def write(out: pathlib.Path, rows: Rows, packages: Sequence[str] = (), **more: Any) -> None:
    """Writes `rows` below their `conditions` and whatever else belongs there; the old file stays until all is written.

    A figure's name ends in its unit: `_second` for a rate (more is better); `_seconds`, `_gb` (1e9 bytes) and `_mb`
    for what should be small. By that `bench compare` knows which way is worse.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    replace_text(out, json.dumps({**conditions(packages), **more, "rows": rows}, indent=1) + "\n")


def read(source: pathlib.Path) -> Rows:
    """The rows that `write` wrote."""
    return json.loads(source.read_text())["rows"]


def conditions(packages: Sequence[str] = ()) -> dict[str, Any]:
    """Machine, device, versions (of `packages` too), commit, date (UTC), load average, seconds this process took."""
    return {
        "machine": machine(),
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "versions": {"python": platform.python_version(), **{p: version(p) for p in (*PACKAGES, *packages)}},
        "commit": _git("rev-parse", "--short", "HEAD") + ("+changes" if _git("status", "--porcelain", "-uno") else ""),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "load_average": [round(x, 2) for x in os.getloadavg()],
        "seconds": round(time.monotonic() - _BEGIN),
    }


def machine() -> dict[str, Any]:
    """The CPU's name, how many of its threads this process may use, memory in GB (1e9 bytes), operating system."""
    cpu = platform.processor()
    if (info := pathlib.Path("/proc/cpuinfo")).exists():
        cpu = next((x.split(":")[1].strip() for x in info.read_text().splitlines() if x.startswith("model name")), cpu)
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    return {"cpu": cpu, "threads": usable_cpus(), "memory_gb": round(memory), "system": platform.platform()}


def _git(*words: str) -> str:
    """What git says, empty where there is no git or no repository."""
    here = pathlib.Path(__file__).parent
    try:
        return subprocess.run(["git", *words], cwd=here, capture_output=True, text=True, check=False).stdout.strip()
    except FileNotFoundError:
        return ""
