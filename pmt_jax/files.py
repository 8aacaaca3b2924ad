"""Files that are either whole or not there, and the rows of metrics.jsonl."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import shutil
import sys
from collections.abc import Callable, Iterator
from typing import Any

from .errors import UsageError

Note = Callable[[str], object]  # called with a sentence about what is left out


@contextlib.contextmanager
def writing(out: pathlib.Path, flag: str = "-o") -> Iterator[pathlib.Path]:
    """A file next to `out`, which `flag` named, to write to; it replaces `out` when all has gone well.

    Raises:
      UsageError: the folder cannot be written.
    """
    if not out.name:  # "", "." and "/", next to which no file can lie
        raise UsageError(f"cannot write {out}: it is a folder; choose another {flag}")
    target = pathlib.Path(os.path.realpath(out)) if out.is_symlink() else out  # a link stays one
    partial = target.with_stem(f".{target.stem}.partial")
    try:
        if _is_stream(out):
            yield out  # is written and never replaced
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(target)
    except OSError as error:
        raise UsageError(f"cannot write {out}: {error.strerror or error}; choose another {flag}") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def _is_stream(out: pathlib.Path) -> bool:
    """Whether `out` is a device or a pipe, as /dev/stdout."""
    return os.path.exists(out) and not os.path.isfile(out) and not os.path.isdir(out)


def check_writable(out: pathlib.Path, flag: str = "-o") -> None:
    """Refuses early what `writing` would refuse after the work.

    Raises:
      UsageError: `out` is a folder, or the nearest folder that is there cannot be written.
    """
    there = out if _is_stream(out) else next((path for path in out.parents if os.path.exists(path)), out)
    if os.path.isdir(out):
        reason = "it is a folder"
    elif os.path.isfile(there):
        reason = f"{there} is a file, not a folder"
    elif not os.access(there, os.W_OK):
        reason = f"{there} cannot be written"
    else:
        return
    raise UsageError(f"cannot write {out}: {reason}; choose another {flag}")


@contextlib.contextmanager
def writing_folder(out: pathlib.Path) -> Iterator[pathlib.Path]:
    """A new folder next to `out` to write to; when all has gone well it becomes `out`, or its files move into it.

    Raises:
      UsageError: the folder cannot be written.
    """
    if not out.absolute().name:
        raise UsageError(f"cannot write into {out}: it is the root of all folders; choose another folder")
    partial = out.absolute().with_name(f".{out.absolute().name}.partial-{os.getpid()}")
    try:
        partial.mkdir(parents=True)
        yield partial
        if not out.is_dir():
            partial.rename(out)  # which a file refuses
        else:
            for file in partial.iterdir():
                file.replace(out / file.name)
    except OSError as error:
        raise UsageError(f"cannot write into {out}: {error.strerror or error}; choose another folder") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def replace_text(path: pathlib.Path, text: str) -> None:
    """Writes a file whole or, if that fails, leaves the old one."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text)
    partial.replace(path)


def is_open_at(file: int, path: pathlib.Path) -> bool:
    """Whether the descriptor `file` is of what is at `path` now: it was not deleted, renamed or replaced since.

    Raises:
      OSError: the path cannot be looked up (a network share that is away).
    """
    try:
        return os.path.samestat(os.fstat(file), path.stat())
    except (FileNotFoundError, NotADirectoryError):
        return False


def to_stderr(line: str) -> None:
    """Prints a line that is no result."""
    print(line, file=sys.stderr)


def read_rows(metrics: pathlib.Path, missing_ok: bool = True, note: Note = to_stderr) -> list[dict[str, Any]]:
    """The rows of a metrics.jsonl. Lines that are none are left out with a note; of the last, a cut-off write, without.

    Raises:
      OSError: it cannot be read; if there is no file and `missing_ok`, there are no rows.
    """
    lines = [] if missing_ok and not metrics.exists() else metrics.read_text(errors="replace").splitlines()
    rows, broken = [], []
    for number, line in enumerate(lines, start=1):
        row = None
        with contextlib.suppress(ValueError, RecursionError):
            row = json.loads(line)
        if isinstance(row, dict):
            rows.append(row)
        elif number < len(lines) and line.strip():
            broken.append(number)
    if broken:
        note(f"left out: {len(broken)} damaged line(s) of {metrics}, the first of them line {broken[0]}")
    return rows
