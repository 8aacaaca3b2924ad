"""Learner states on disk: orbax's atomic steps, each holding one flat table {path: array} as the bytes of an npz.

Flat, because orbax refuses typed keys and empty leaves, and loads parts of trees without an error: here the two sets
of paths are compared, and a difference is an error. Bytes with a checksum, because orbax does not notice a flipped
bit, and reports a lost one with a traceback for each of hundreds of arrays. Each step is read by itself, because orbax
takes what a checkpoint holds from the newest one, and would read none where that one is incomplete.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import pathlib
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from ..errors import UsageError
from ..learning import sharding
from . import lock, processes
from .history import checkpoint_steps
from .provenance import Provenance

KEEP = 2
CHECKPOINT_SECONDS = 300.0  # of training between two
DAMAGED = "checkpoints-damaged"  # where a run that continues puts what it could not read
_PROVENANCE = "provenance"  # its name in the npz, next to the paths of arrays
ROW = "['row']"  # before the names of what is known of a row that has not ended
_INFO = ".rollout.vector.env.info["  # in the paths of the environments' info


def pack(tree: Any) -> dict[str, np.ndarray]:
    """A pytree as {path: array}; typed keys become their numbers, empty leaves are left out.

    If the arrays lie in several processes, all of them must call it.
    """
    leaves = {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_leaves_with_path(tree)}
    plain = sharding.gather({path: jax.random.key_data(x) if _is_key(x) else x for path, x in leaves.items()})
    return {path: np.asarray(x) for path, x in plain.items() if x.size}


def unpack(packed: dict[str, np.ndarray], like: Any) -> Any:
    """The inverse of `pack`; `like` gives structure, shapes and dtypes.

    The environments' `info` may differ, because training does not continue from it: a task may add to it, and older
    checkpoints can still be read. What is missing is 0.

    Raises:
      UsageError: paths, shapes or dtypes differ.
    """
    leaves, treedef = jax.tree_util.tree_flatten_with_path(like)
    expected = {jax.tree_util.keystr(path): x for path, x in leaves}
    wanted = {path for path, x in expected.items() if x.size}
    difference = sorted(path for path in wanted ^ set(packed) if _INFO not in path)
    if difference:
        raise UsageError(f"the checkpoint belongs to another kind of run: it differs in {', '.join(difference[:3])}")

    def restore(path: str, x: Any) -> jax.Array:
        if path not in packed:
            return jnp.zeros(x.shape, x.dtype)
        data = jnp.asarray(packed[path])
        value = _as_key(data) if _is_key(x) else data
        if (value.shape, value.dtype) != (x.shape, x.dtype):
            raise UsageError(f"the checkpoint's {path} is {value.dtype}{value.shape}, expected {x.dtype}{x.shape}")
        return value

    return treedef.unflatten([restore(path, x) for path, x in expected.items()])


def _as_key(data: jax.Array) -> jax.Array:
    """Random keys from their numbers, of the kind that this process draws with."""
    try:
        return jax.random.wrap_key_data(data)
    except TypeError:
        raise UsageError(
            "the checkpoint's random keys are of another kind than those of this process; set JAX_DEFAULT_PRNG_IMPL to "
            "what the run was trained with"
        ) from None


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _to_bytes(table: dict[str, np.ndarray]) -> np.ndarray:
    """[bytes] uint8: an npz of the table, and its CRC-32."""
    file = io.BytesIO()
    np.savez(file, **table)  # pyright: ignore[reportArgumentType] (its stub takes any name for its own flag)
    data = file.getvalue()
    return np.frombuffer(data + zlib.crc32(data).to_bytes(4), np.uint8)


def _from_bytes(array: np.ndarray) -> dict[str, np.ndarray]:
    """The inverse of `_to_bytes`; a ValueError if the checksum does not fit."""
    data, checksum = array[:-4].tobytes(), array[-4:].tobytes()
    if zlib.crc32(data).to_bytes(4) != checksum:
        raise ValueError("its checksum does not fit")
    with np.load(io.BytesIO(data)) as file:
        return dict(file)


class Saved(NamedTuple):
    """A checkpoint as it was read.

    Attributes:
      step: environment steps of each seed; packed: {path: array}, see `pack`.
      row: what is known of a row that had not ended: arrays [seeds, ...] by their names.
      provenance: what it belongs to; None if that is unknown.
      damaged: the steps of newer ones that are not whole.
    """

    step: int
    packed: dict[str, np.ndarray]
    row: dict[str, np.ndarray]
    provenance: Provenance | None
    damaged: list[int]


def newest(folder: pathlib.Path, warn: Callable[[str], object], to_continue: bool = False) -> Saved:
    """The newest checkpoint of a run folder that is whole; only the first of several processes may call it.

    Args:
      warn: called with a sentence for every newer one that is not, and if it does not say what it belongs to.
      to_continue: a newer one that the disk does not give now is an error, because it may be whole.

    Raises:
      UsageError: there is none, or it is of another step than its name says.
    """
    check_name(folder)
    damaged, place, steps = [], folder / "checkpoints", checkpoint_steps(folder)
    for step in steps:
        try:
            packed = read_table(place / str(step))
        except (Damaged, OSError) as error:
            said = f"the checkpoint after {step:,} steps in {place} cannot be read ({_reason(error)})"
            if to_continue and isinstance(error, OSError):
                raise UsageError(
                    f"{said}; it may be whole: mend the cause and resume again, or move that folder elsewhere to "
                    "continue from the one before"
                ) from None
            warn(said)
            damaged.append(step)
            continue
        row = {path[len(ROW) + 2 : -2]: packed.pop(path) for path in list(packed) if path.startswith(ROW)}
        return Saved(step, packed, row, _provenance(place, step, packed.pop(_PROVENANCE, None), warn), damaged)
    if steps:
        raise UsageError(f"no checkpoint in {place} can be read; restore one from a backup or train anew")
    raise nothing_finished(folder)


def nothing_finished(folder: pathlib.Path) -> UsageError:
    """The error of a run folder without a checkpoint, which says if the run trains now."""
    none, owner = f"there is no finished checkpoint in {folder / 'checkpoints'}", lock.owner_of(folder)
    if owner is None:
        return UsageError(f"{none}; train the run first")
    return UsageError(
        f"{none}: {owner} trains the run; try again after its first checkpoint, which comes after "
        f"{CHECKPOINT_SECONDS / 60:g} minutes of training, or when training ends"
    )


def _provenance(
    place: pathlib.Path, step: int, data: np.ndarray | None, warn: Callable[[str], object]
) -> Provenance | None:
    if data is None:
        warn(f"the checkpoint after {step:,} steps in {place} does not say which run it belongs to")
        return None
    try:
        written, provenance = Provenance.from_bytes(data)
    except UsageError as error:
        raise UsageError(f"the checkpoint after {step:,} steps in {place}: {error}") from None
    if written != step:
        raise UsageError(
            f"{place / str(step)} holds the checkpoint after {written:,} steps; give it its name back, "
            f"{written}, or move it elsewhere"
        )
    return provenance


def check_name(folder: pathlib.Path) -> None:
    """Refuses a folder whose path cannot be encoded in UTF-8: orbax would end in a traceback.

    Raises:
      UsageError: it cannot.
    """
    try:
        str(folder.absolute()).encode()
    except UnicodeEncodeError:
        raise UsageError(
            f"the path {folder} is not UTF-8, which checkpoints need; rename the folder, or set PYTHONUTF8=1 if the "
            "locale has another encoding"
        ) from None


class Checkpoints:
    """The checkpoints of a run folder, named by their step; the newest `KEEP` are kept.

    Of several processes, all must call the methods, and the first reads and writes.
    """

    def __init__(self, folder: pathlib.Path) -> None:
        check_name(folder)
        self._folder = (folder / "checkpoints").absolute()
        self._manager: Any = None

    def _open(self) -> Any:
        several = jax.process_count() > 1
        if several:
            self._folder.mkdir(parents=True, exist_ok=True)  # orbax does not if one process uses it alone
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEEP,
            create=not several,
            cleanup_tmp_directories=True,  # what a kill in the middle of a save left behind
            enable_async_checkpointing=False,
            multiprocessing_options=_alone(),
        )
        return ocp.CheckpointManager(self._folder, options=options)

    def save(self, step: int, tree: Any, provenance: Provenance) -> None:
        """Writes `tree` as the checkpoint after `step` environment steps; a crash meanwhile leaves the older one whole.

        Raises:
          OSError: it could not be written (a full disk, a quota, a share that went away).
        """
        if step in self.steps():
            return
        self.write_table(step, pack(tree) | {_PROVENANCE: provenance.to_bytes(step)})

    @processes.in_first
    def write_table(self, step: int, table: dict[str, np.ndarray]) -> None:
        """Writes {path: array} as the checkpoint after `step`.

        Raises:
          OSError: it cannot be written.
        """
        data = _to_bytes(table)
        try:
            with _quiet():
                self._manager = self._manager or self._open()
                self._manager.save(step, args=ocp.args.StandardSave({"npz": data}))
        except ValueError as error:  # tensorstore's, whatever went wrong
            raise OSError(_reason(error)) from error

    @processes.in_first
    def steps(self) -> list[int]:
        """The steps of the checkpoints that were written to their end, newest first.

        Raises:
          OSError: the folder cannot be read.
        """
        return checkpoint_steps(self._folder.parent)

    @processes.in_first
    def set_aside(self, steps: list[int]) -> None:
        """Moves checkpoints that are not whole into `DAMAGED`, where nothing reads them and nothing is lost.

        Raises:
          OSError: they cannot be moved.
        """
        for step in steps:
            folder = self._folder.with_name(DAMAGED)
            folder.mkdir(exist_ok=True)
            names = (f"{step}{end}" for end in ("", *(f"-{i}" for i in range(2, 10**6))))
            (self._folder / str(step)).rename(next(folder / name for name in names if not (folder / name).exists()))

    def close(self) -> None:
        """Closes the folder."""
        if self._manager is not None:
            self._manager.close()


class Damaged(Exception):
    """A checkpoint whose files can be read, but do not hold what was written."""


def read_table(step: pathlib.Path) -> dict[str, np.ndarray]:
    """The table of one checkpoint.

    Raises:
      OSError: the disk does not give its files.
      Damaged: they are not whole.
    """
    try:
        for folder, _, names in os.walk(step, onerror=_raise):  # this fails with the system's reason, orbax does not
            for name in names:
                pathlib.Path(folder, name).read_bytes()
        with _quiet(), ocp.StandardCheckpointer(multiprocessing_options=_alone()) as checkpointer:
            restored: Any = checkpointer.restore((step / "default").absolute())
        if "npz" not in restored:
            raise Damaged("it is of another version of pmt-jax")
        return _from_bytes(np.asarray(restored["npz"]))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise Damaged("it is incomplete") from error
    except (OSError, MemoryError, Damaged):
        raise
    except Exception as error:  # whatever orbax and tensorstore make of damaged files
        raise Damaged(_reason(error)) from error


def _alone() -> ocp.options.MultiprocessingOptions:
    """For the first of several processes, which would else wait for the others to read and write with it."""
    return ocp.options.MultiprocessingOptions(active_processes={0} if jax.process_count() > 1 else None)


def _raise(error: OSError) -> None:
    raise error


def _reason(error: Exception) -> str:
    """The system's words, or the end of an error's first line: tensorstore begins with a page of paths."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error).split("\n")[0].split(": ")[-1].split(" [")[0]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Orbax logs every error with the tracebacks of all its threads; the caller gets the error, and one is enough."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)
