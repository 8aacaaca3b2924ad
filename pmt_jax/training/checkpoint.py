"""Learner states on disk: orbax's atomic steps, each holding one flat table {path: array} as the bytes of an npz.

Flat, because orbax refuses typed keys and empty leaves, and loads parts of trees without an error: here the two sets
of paths are compared, and a difference is an error. Bytes with a checksum, because orbax does not notice a flipped
bit, and reports a lost one with a traceback for each of hundreds of arrays.
"""

from __future__ import annotations

import contextlib
import io
import logging
import pathlib
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from ..errors import UsageError
from ..learning import sharding
from . import processes

KEEP = 2
_ROW = "['row']"  # before the names of what is known of a row that has not ended
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
        value = jax.random.wrap_key_data(data) if _is_key(x) else data
        if (value.shape, value.dtype) != (x.shape, x.dtype):
            raise UsageError(f"the checkpoint's {path} is {value.dtype}{value.shape}, expected {x.dtype}{x.shape}")
        return value

    return treedef.unflatten([restore(path, x) for path, x in expected.items()])


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


def has_checkpoint(folder: pathlib.Path) -> bool:
    """Whether a run folder holds a checkpoint that was written to its end."""
    return processes.by_first(lambda: any(path.name.isdigit() for path in (folder / "checkpoints").glob("*")))


class Checkpoints:
    """The checkpoints of a run folder, named by their step; the newest `KEEP` are kept.

    Of several processes, all must call the methods, and the first reads and writes.
    """

    def __init__(self, folder: pathlib.Path, read_only: bool = False) -> None:
        """Opens the checkpoints of `folder`; `read_only` changes nothing on disk."""
        self._folder = (folder / "checkpoints").absolute()
        self._manager: Any = None
        processes.by_first(lambda: self._open(read_only))

    def _open(self, read_only: bool) -> None:
        several = jax.process_count() > 1
        if several and not read_only:
            self._folder.mkdir(parents=True, exist_ok=True)  # orbax does not if one process uses it alone
        with _quiet():
            options = ocp.CheckpointManagerOptions(
                max_to_keep=KEEP,
                create=not read_only and not several,
                cleanup_tmp_directories=not read_only,  # what a kill in the middle of a save left behind
                read_only=read_only,
                enable_async_checkpointing=False,
                multiprocessing_options=ocp.options.MultiprocessingOptions(active_processes={0} if several else None),
            )
            self._manager = ocp.CheckpointManager(self._folder, options=options)

    def save(self, step: int, tree: Any) -> None:
        """Writes `tree` as the checkpoint after `step` environment steps; a crash meanwhile leaves the older one whole.

        Raises:
          OSError: it could not be written (a full disk, a quota, a share that went away).
        """
        if step in self.steps():
            return
        table = pack(tree)
        processes.by_first(lambda: self._write(step, table))

    def _write(self, step: int, table: dict[str, np.ndarray]) -> None:
        data = _to_bytes(table)
        try:
            with _quiet():
                self._manager.save(step, args=ocp.args.StandardSave({"npz": data}))
        except ValueError as error:  # tensorstore's, whatever went wrong
            raise OSError(_reason(error)) from error

    def steps(self) -> list[int]:
        """The steps of the complete checkpoints, newest first."""
        return processes.by_first(lambda: sorted(self._manager.all_steps(), reverse=True))

    def load(self, like: Any, warn: Callable[[str], object]) -> tuple[int, Any]:
        """The newest checkpoint that is whole: its step, and its tree in the structure of `like`, a dictionary.

        The tree's `row`, arrays [seeds, ...] by their names, has no structure: it is what was saved, {} if nothing was.

        Args:
          warn: called with a sentence for every newer one that cannot be read.

        Raises:
          UsageError: there is none, or it belongs to another kind of run.
        """
        step, packed = processes.by_first(lambda: self._newest(warn))
        row = {path: packed.pop(path) for path in list(packed) if path.startswith(_ROW)}
        return step, unpack(packed, like) | {"row": {path[len(_ROW) + 2 : -2]: x for path, x in row.items()}}

    def _newest(self, warn: Callable[[str], object]) -> tuple[int, dict[str, np.ndarray]]:
        steps = sorted(self._manager.all_steps(), reverse=True)
        for step in steps:
            try:
                with _quiet():
                    restored: Any = self._manager.restore(step, args=ocp.args.StandardRestore())
                if "npz" not in restored:
                    raise ValueError("it is of another version of pmt-jax")
                packed = _from_bytes(np.asarray(restored["npz"]))
            except (ValueError, KeyError, OSError) as error:
                warn(f"the checkpoint after {step:,} steps in {self._folder} cannot be read ({_reason(error)})")
                continue
            return step, packed
        if steps:
            raise UsageError(f"no checkpoint in {self._folder} can be read; restore one from a backup or train anew")
        raise UsageError(f"there is no finished checkpoint in {self._folder}; train the run first")

    def forget_after(self, step: int) -> None:
        """Deletes the checkpoints of later steps, from which the run does not continue."""
        processes.by_first(lambda: [self._manager.delete(s) for s in self._manager.all_steps() if s > step])

    def close(self) -> None:
        """Closes the folder."""
        if self._manager is not None:
            self._manager.close()


def _reason(error: Exception) -> str:
    """The end of an error's first line: tensorstore begins with a page of paths."""
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
