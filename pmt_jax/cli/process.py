"""What a command does to its process: exit codes, output, and the environment that JAX finds."""

from __future__ import annotations

import contextlib
import io
import os
import pathlib
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from .. import numerics, output
from ..errors import UsageError

_PACKAGE = pathlib.Path(__file__).parents[1]


def answer(name: str, command: Callable[[], int]) -> int:
    """The exit code of `command`; a user's mistake gets one sentence that begins with the program's `name`, and 2."""
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))  # >&- closes
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a path may hold what the terminal cannot show
    output.begin()
    try:
        with _plain_warnings(name):
            code = command()
        sys.stdout.flush()  # here, where a closed pipe is noticed, and not when Python ends
        return code
    except UsageError as error:
        return _refuse(name, str(error))
    except KeyboardInterrupt:
        return 130
    except SystemExit as end:  # argparse has printed its help
        return int(end.code or 0)
    except BrokenPipeError:  # the reader of our output, head for example, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:  # a path that is too long, a folder that may not be read, a full disk
        return _refuse(name, f"{f'{error.filename}: ' if error.filename else ''}{error.strerror or error}")
    except UnicodeError as error:
        if sys.getfilesystemencoding() == "utf-8":
            raise
        return _refuse(name, f"the locale has another encoding than UTF-8 ({error.args[0]}); set PYTHONUTF8=1")
    except ValueError as error:
        if not numerics.is_bad_variable(error):
            raise
        return _refuse(name, f"JAX cannot start: {str(error).splitlines()[0]}; correct or unset that variable")
    except RuntimeError as error:
        if type(error).__name__ not in ("JaxRuntimeError", "XlaRuntimeError"):  # JAX, which defines them, loads slowly
            raise
        from ..training import failures

        if not str(error).startswith(failures.NO_MEMORY):  # outside of a run's programs it is a mistake of ours
            raise
        return _refuse(name, failures.explain(error))


@contextlib.contextmanager
def _plain_warnings(name: str) -> Iterator[None]:
    """Inside, our own warnings are a sentence each, without the place in our code; those of others are as they are."""
    with warnings.catch_warnings():
        others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], filename: str, *rest: Any, **more: Any) -> None:
            if pathlib.Path(filename).is_relative_to(_PACKAGE):
                _print(name, str(message))
            else:
                others(message, category, filename, *rest, **more)

        warnings.showwarning = show
        yield


def _refuse(name: str, sentence: str) -> int:
    """Prints why `name` did nothing; returns the exit code."""
    _print(name, sentence)
    return 2


def _print(name: str, sentence: str) -> None:
    """Prints a sentence that is no result, control characters escaped."""
    shown = "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in sentence)
    print(output.fitted(f"{name}: {shown}", sys.stderr), file=sys.stderr)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C ends the process at once, for commands or moments that leave nothing half written.

    As an exception it would be lost in JAX's callbacks, wait for the compiler, or leave half a module imported. XLA's
    C++ log is silenced before it loads: it would print a page of CPU features for every program from the compile cache.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        yield  # ignored, as in the background, or handled by the calling program
        return
    signal.signal(signal.SIGINT, lambda number, _: os._exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def system_obstacle() -> str | None:
    """Why no run can be trained on this operating system, in a sentence; None if it can."""
    try:
        import fcntl
    except ImportError:
        return (
            "this system has no file locks (Python's fcntl), without which two processes could train in one folder; "
            "train on Linux or macOS, or on Windows in WSL"
        )
    del fcntl
    return None


def check_system() -> None:
    """Raises UsageError where no run can be trained on this operating system."""
    if found := system_obstacle():
        raise UsageError(found)


def refuse_many(command: str, jobs: int, devices: int | None) -> None:
    """Refuses to run once in each of several processes, which would write into the same folders."""
    from ..studies.jobs import share_memory
    from ..training import processes

    processes.make_room(devices)
    if jobs > 1:
        share_memory()
    check_system()
    numerics.check()
    if processes.in_step():
        raise UsageError(f"{command} runs in one process; start it without srun, or with srun --ntasks=1")
