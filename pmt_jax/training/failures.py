"""What ends a compiled program in the middle: a host callback of the task, the device, or its memory."""

from __future__ import annotations

import contextlib
import logging
import pathlib
import re
from collections.abc import Iterator

import jax

from ..errors import UsageError
from . import processes

NO_MEMORY = "RESOURCE_EXHAUSTED: "
LESS = "other programs may share the device: take fewer (--jobs), or a smaller num_envs, rollout_length or seeds"
_FRAME = re.compile(r'  File "(.*)", line (\d+)')


class Failed(UsageError):
    """A program did not return; the sentence says why. Its arguments are whole, because none is donated."""


@contextlib.contextmanager
def named() -> Iterator[None]:
    """Whatever ends a program inside, its sentence is raised.

    Raises:
      Parted: another process of the run is gone.
      Failed: the program failed; JAX's log of it, a traceback, is not printed.
    """
    log = logging.getLogger("jax._src.callback")
    before, log.disabled = log.disabled, True
    try:
        with processes.reaching_others():
            yield
    except (jax.errors.JaxRuntimeError, MemoryError) as error:
        raise Failed(explain(error)) from error
    finally:
        log.disabled = before


def explain(error: BaseException) -> str:
    """Why a program failed, in one sentence."""
    text = str(error)
    if isinstance(error, MemoryError) or text.startswith(NO_MEMORY):
        why = (text.splitlines() or ["out of memory"])[0].removeprefix(NO_MEMORY)
        return f"{why or 'out of memory'}; {LESS}"
    lines = text.splitlines()
    frames = [i for i, line in enumerate(lines) if _FRAME.match(line)]
    if not frames:
        return f"the device failed: {lines[0] if lines else type(error).__name__}"
    raised = next((line for line in lines[frames[-1] + 1 :] if line[:1].strip()), "an exception")
    file, line = _FRAME.findall(lines[frames[-1]])[0]
    return f"a host callback raised {raised} ({pathlib.Path(file).name}, line {line})"
