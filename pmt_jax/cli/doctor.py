"""`pmt doctor`: checks what pmt-jax can use on this machine, and gives the reason for the rest."""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import pmt_jax

from .. import numerics, tasks
from ..errors import UsageError
from ..output import result
from ..probe import run_python
from ..render import gl
from .parser import command
from .process import interruptible, system_obstacle

PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy")
EXTRAS = {  # which of our extras brings an optional package
    "warp-lang": "warp",
    "imageio-ffmpeg": "render",
    "onnxruntime": "onnx",
    "minari": "minari",
    "gymnasium": "adapters",
    "pettingzoo": "adapters",
    "brax": "adapters",
    "tensorboardX": "log",
    "wandb": "log",
}
_CACHE_PROBE = """
import jax
from pmt_jax.training.compile import cache_events
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
with cache_events() as events:
    jax.jit(lambda x: x @ x).lower(jax.ShapeDtypeStruct((3, 3), "float32")).compile()
assert "cache_hits" in events, "no hit"
"""


class Finding(NamedTuple):
    """One line of the report.

    Attributes:
      mark: `ok`, `no` for what cannot be used but need not be, `bad` for what keeps pmt-jax from working.
      what: the part looked at.
      text: what was found and, if it is a problem, what to do.
    """

    mark: Literal["ok", "no", "bad"]
    what: str
    text: str


def add(commands: Any) -> None:
    """Adds the command."""
    command(commands, "doctor", run, "check versions, devices, engines and packages of this machine")


@interruptible()
def run(arguments: argparse.Namespace) -> int:
    """Prints all findings."""
    del arguments
    return report(result)


def report(say: Callable[[str], None]) -> int:
    """Prints all findings; returns 0, or 1 if one is bad."""
    bad = 0
    for finding in examine():
        say(f"{finding.mark:4}{finding.what:20}{finding.text}")
        bad += finding.mark == "bad"
    say(f"{bad} problem(s): see the lines marked bad" if bad else "pmt can train here")
    return int(bad > 0)


def examine() -> Iterator[Finding]:
    """Looks at everything in turn. If JAX is missing or a version is wrong, the checks that need it are left out."""
    yield Finding("ok", "pmt-jax", f"{pmt_jax.__version__} in {os.path.dirname(pmt_jax.__file__)}")
    yield Finding("ok", "python", f"{platform.python_version()} on {platform.platform()}")
    found = {name: tasks.installed_version(name) for name in PACKAGES}
    for name, version in found.items():
        missing = "missing; reinstall with pip install pmt-jax"
        yield Finding("ok", name, version) if version else Finding("bad", name, missing)
    if obstacle := system_obstacle():
        yield Finding("bad", "operating system", obstacle)
    if found["jax"] and found["jaxlib"]:
        yield from _computing()
    yield from check_rendering()
    for name, extra in EXTRAS.items():
        version = tasks.installed_version(name)
        absent = Finding("no", name, f"not installed; optional: pip install 'pmt-jax[{extra}]'")
        yield Finding("ok", name, version) if version else absent


def _computing() -> Iterator[Finding]:
    """What JAX can use, as far as its settings let it start."""
    try:
        numerics.check_settings()
    except (UsageError, ValueError) as error:  # ValueError: of JAX itself, about a variable
        yield Finding("bad", "settings of JAX", str(error).splitlines()[0])
        return
    yield _devices()
    yield from check_engines()
    yield check_cache()


def _devices() -> Finding:
    if obstacle := numerics.device_obstacle():
        return Finding("bad", "devices", obstacle)
    import jax

    from ..training.processes import usable_cpus

    devices = jax.devices()
    kinds = ", ".join(f"{d.device_kind} ({d.platform})" for d in devices)
    return Finding("ok", "devices", f"{kinds}; {usable_cpus()} CPUs usable")


def check_engines() -> Iterator[Finding]:
    """Whether each physics engine can be used here, and which one `auto` takes."""
    try:
        chosen, obstacles = tasks.engines()
    except (UsageError, ImportError, RuntimeError) as error:
        yield Finding("bad", "physics engines", str(error))
        return
    for name, obstacle in obstacles.items():
        usable = "usable"
        if name == chosen:
            where = " for the models that it can step" if name == "fused" else ""
            usable += f", and what physics = auto takes{where}"
        if name == "fused" and not obstacle:
            usable += f"; {tasks.compiler()}"
        yield Finding("no", f"engine {name}", obstacle) if obstacle else Finding("ok", f"engine {name}", usable)


def check_cache() -> Finding:
    """What the persistent compile cache holds, and whether one process finds what another has put into one."""
    from ..training.compile import ANEW, cache_folder, can_keep

    try:
        place = cache_folder()
    except RuntimeError as error:
        return Finding("no", "compile cache", f"there is no place for it ({error}), so {ANEW}")
    programs = list(place.glob("*-cache")) if place.is_dir() else []
    holds = f"{place} holds {len(programs)} programs, {sum(p.stat().st_size for p in programs) / 1e6:.1f} MB"
    if not can_keep(place):
        return Finding("no", "compile cache", f"{holds}; it cannot be written, so {ANEW}")
    with tempfile.TemporaryDirectory() as folder:
        environment = {"JAX_COMPILATION_CACHE_DIR": folder, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        _, second = (run_python(_CACHE_PROBE, **environment) for _ in range(2))
    if second:
        return Finding("no", "compile cache", f"{holds}; it never hits on this machine, so every start compiles anew")
    return Finding("ok", "compile cache", f"{holds}; a second process hits what a first has compiled")


def check_rendering() -> Iterator[Finding]:
    """Tries each of MuJoCo's ways to draw."""
    for backend in gl.backends():
        error = gl.obstacle(backend)
        yield Finding("no", f"GL {backend}", error) if error else Finding("ok", f"GL {backend}", "draws")
