"""One process at a time in a folder: a file `.lock` names the process that trains there.

On one host the file is locked, and the lock ends with its process, however that ends. Locks may not reach other hosts,
so there the name in the file counts. The open file also tells whether the folder at a path is still the one that was
locked: a folder that was deleted, renamed or replaced has no such file, or another one.
"""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import socket
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

from ..errors import UsageError
from ..files import is_open_at

NAME = ".lock"


class Gone(UsageError):
    """A folder was deleted, renamed or replaced while this process worked in it."""


class InUse(UsageError):
    """Another process works in a folder."""


class _Lock(NamedTuple):
    """A lock of this process: the absolute path of its file, the open file, and whether the folder was made for it."""

    path: pathlib.Path
    file: int
    created: bool

    @property
    def holds(self) -> bool:
        """Whether the file at the path is still the one that was opened."""
        return is_open_at(self.file, self.path)


_held: dict[pathlib.Path, _Lock] = {}  # by folder, as its path was given


@contextlib.contextmanager
def acquire(folder: pathlib.Path, created: bool = False) -> Iterator[None]:
    """Keeps other processes out of `folder` until the end of the block.

    A folder that is not there is made. Made here, or `created` for this, it is removed if it stays empty.

    Raises:
      InUse: another process has it.
      UsageError: it cannot be written.
    """
    path = folder.absolute() / NAME
    try:
        created |= not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        file, locked = _open(folder, path)
        owner = _read(file)
        if _may_be_alive(owner, locked):
            os.close(file)
            raise _refusal(folder, owner)
        _held[folder] = _Lock(path, file, created)
        _write(file)
    except OSError as error:
        _release(folder)
        raise UsageError(f"cannot write into {folder}: {error.strerror}; choose another --out") from None
    try:
        yield
    finally:
        _release(folder)


def is_held(folder: pathlib.Path) -> bool:
    """Whether this process has locked `folder`, and it is still the folder at its path.

    Raises:
      OSError: the path cannot be looked up (a network share that is away).
    """
    return folder in _held and _held[folder].holds


def owner_of(folder: pathlib.Path) -> str | None:
    """Which process may train in `folder` now, and since when, as words; None if none does."""
    try:  # only to read: a lock, even a short one, would refuse a run that begins meanwhile
        file = os.open(folder / NAME, os.O_RDONLY)
    except OSError:
        return None
    try:
        owner = _read(file)
    finally:
        os.close(file)
    return _words(owner) if _may_be_alive(owner, locked=False) else None


def release_all() -> None:
    """Releases all locks of this process, for an end at once."""
    for folder in list(_held):
        _release(folder)


def _release(folder: pathlib.Path) -> None:
    if folder in _held:
        lock = _held.pop(folder)
        with contextlib.suppress(OSError):
            if lock.holds:  # another process may have the folder that is there now
                lock.path.unlink()
                if lock.created:
                    lock.path.parent.rmdir()
        os.close(lock.file)


def _open(folder: pathlib.Path, path: pathlib.Path) -> tuple[int, bool]:
    """The descriptor of the lock file `path`, and whether the system locks it; UsageError if for another process."""
    import fcntl  # not on every system, and only training needs it

    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = _read(file)
            os.close(file)
            raise _refusal(folder, owner) from None
        except OSError:  # a file system without locks
            return file, False
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file), path.stat()):
                return file, True
        os.close(file)  # its owner has just released it


def _read(file: int) -> dict[str, Any]:
    """Who locked the folder: pid, host, since; empty if the file is."""
    try:
        owner = json.loads(os.pread(file, 4096, 0))
    except ValueError:
        return {}
    return owner if isinstance(owner, dict) else {}


def _write(file: int) -> None:
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    owner = {"pid": os.getpid(), "host": socket.gethostname(), "since": since, "slurm": _slurm_job()}
    os.ftruncate(file, 0)
    os.pwrite(file, json.dumps(owner).encode(), 0)
    os.fsync(file)


def _slurm_job() -> list[str] | None:
    """The job's number and how often SLURM has started it again."""
    job = os.environ.get("SLURM_JOB_ID")
    return None if job is None else [job, os.environ.get("SLURM_RESTART_COUNT", "0")]


def _may_be_alive(owner: dict[str, Any], locked: bool) -> bool:
    """Whether the owner may still be at work, although this process could open its file and perhaps lock it."""
    if not owner:
        return False
    theirs, ours = owner.get("slurm"), _slurm_job()
    if theirs and ours and theirs[0] == ours[0] and theirs[1] != ours[1]:
        return False  # the same job, which SLURM has started again, perhaps on another host
    if owner.get("host") != socket.gethostname():
        return True
    try:
        os.kill(int(owner["pid"]), 0)
    except (KeyError, ValueError, TypeError, ProcessLookupError):
        return False
    except PermissionError:
        pass
    return not locked


def _refusal(folder: pathlib.Path, owner: dict[str, Any]) -> InUse:
    here = owner.get("host", socket.gethostname()) == socket.gethostname()
    gone = "" if here else f"; if that process is gone, delete {folder / NAME}"
    return InUse(f"{folder} is in use by {_words(owner)}{gone}; wait for it, or choose another --out")


def _words(owner: dict[str, Any]) -> str:
    host = owner.get("host", socket.gethostname())
    who = f"process {owner.get('pid', '?')}{'' if host == socket.gethostname() else f' on {host}'}"
    return f"{who} since {owner['since']}" if "since" in owner else who
