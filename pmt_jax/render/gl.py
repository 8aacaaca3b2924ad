"""Which way to OpenGL works here."""

from __future__ import annotations

import os
import sys

from ..errors import UsageError
from ..probe import run_python

_BACKENDS = {"linux": ("egl", "osmesa", "glfw"), "darwin": ("cgl", "glfw")}
PROBE = """
import mujoco, mujoco.{0} as platform
context = platform.GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string('<mujoco/>'), mujoco.mjtFontScale.mjFONTSCALE_50)
"""


def backends() -> tuple[str, ...]:
    """What may work on this system, the fastest first; MUJOCO_GL, if set, is the only one."""
    wanted = os.environ.get("MUJOCO_GL")
    return (wanted,) if wanted else _BACKENDS.get(sys.platform, ("glfw",))


def obstacle(backend: str) -> str | None:
    """Why a backend does not draw here, None if it does.

    A backend that fails leaves PyOpenGL unusable for the next, or kills its process, so each is tried in a new one.
    """
    return run_python(PROBE.format(backend))


def choose() -> str:
    """The first backend that draws here: egl, osmesa, glfw or cgl.

    Raises:
      UsageError: none does.
    """
    for backend in backends():
        if obstacle(backend) is None:
            return backend
    raise UsageError(
        f"no OpenGL works here (tried {', '.join(backends())}): install a software one (apt-get install libosmesa6), "
        "or write a page, which needs none: -o replay.html"
    )
