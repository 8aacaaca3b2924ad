"""Results: rows on disk, with where, when, with what and by which command they were measured."""

from __future__ import annotations

import datetime
import json
import os
import pathlib
import platform
import subprocess
import time
from collections.abc import Iterable
from typing import Any

import jax

from envs.physics import usable_cpus
from pmt_jax.errors import UsageError
from pmt_jax.files import replace_text
from pmt_jax.tasks import installed_version

Record = dict[str, Any]
Records = list[Record]
Report = dict[str, Any]  # conditions and rows

RESULTS = pathlib.Path(__file__).parent / "results"
PACKAGES = ("jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "warp-lang", "numpy")
PACKAGES += ("pandapower", "lightsim2grid", "power-grid-model", "orbax-checkpoint", "brax", "jaxmarl", "torch")
_BEGIN = time.monotonic()


def write(out: pathlib.Path, rows: Records, command: str) -> None:
    """Writes `rows` below their `conditions`; the old file stays until all is written.

    A figure's name ends in its unit: `_second` for a rate (more is better); `_seconds`, `_gb` (1e9 bytes) and `_mb`
    for what should be small. By that `bench compare` knows which way is worse.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    replace_text(out, json.dumps({"command": command, **conditions(), "rows": rows}, indent=1) + "\n")


def conditions() -> dict[str, Any]:
    """Machine, device, versions, commit, date (UTC), load average, seconds this process took."""
    changed = "+changes" if git("status", "--porcelain", "-uno", "--", ":/", ":!results") else ""
    return {
        "machine": machine(),
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "versions": {"python": platform.python_version(), **{p: v for p in PACKAGES if (v := installed_version(p))}},
        "commit": (git("rev-parse", "--short", "HEAD") or "unknown").strip() + changed,
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


def load(source: str | pathlib.Path = RESULTS) -> dict[str, Report]:
    """Results by name: of a JSON file, of a folder, or as committed in a git revision.

    Raises:
      UsageError: it is none of these, or a file without measurements.
    """
    path = pathlib.Path(source)
    if path.is_dir():
        return _reports((p.stem, p.read_text()) for p in sorted(path.glob("*.json")))
    if path.is_file():
        if found := _reports([(path.stem, path.read_text())]):
            return found
        raise UsageError(f"{path} holds no measurements; give a file that python -m bench run wrote")
    if (listed := git("ls-tree", "--name-only", str(source), "results/")) is None:
        raise UsageError(f"'{source}' is neither a file of results, a folder of them nor a git revision")
    names = [name for name in listed.splitlines() if name.endswith(".json")]
    return _reports((pathlib.Path(name).stem, git("show", f"{source}:./{name}") or "") for name in names)


def _reports(texts: Iterable[tuple[str, str]]) -> dict[str, Report]:
    """Those of `texts` that `write` wrote."""
    parsed = {}
    for name, text in texts:
        try:
            parsed[name] = json.loads(text)
        except ValueError as error:
            raise UsageError(f"{name}.json is damaged: {error}") from None
    return {name: x for name, x in parsed.items() if isinstance(x, dict) and {"rows", "device"} <= set(x)}


def git(*words: str) -> str | None:
    """What git says in this folder; None if it fails or is missing."""
    try:
        done = subprocess.run(["git", *words], cwd=RESULTS.parent, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout if done.returncode == 0 else None
