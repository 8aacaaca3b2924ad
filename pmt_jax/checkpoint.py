"""Learner states on disk: orbax's atomic steps holding one flat table {path: array}.

Flat, because orbax refuses typed keys and empty leaves, and because partial loads of trees are silent: here the two
sets of paths are compared, and a difference is a sentence.
"""

from __future__ import annotations

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from .errors import UsageError

KEEP = 2


def pack(tree: Any) -> dict[str, np.ndarray]:
    """A pytree as {path: array}; typed keys become their numbers, empty leaves are left out."""
    leaves = {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_leaves_with_path(tree)}
    plain = {path: jax.random.key_data(x) if _is_key(x) else x for path, x in leaves.items()}
    return {path: np.asarray(x) for path, x in plain.items() if x.size}


def unpack(packed: dict[str, np.ndarray], like: Any) -> Any:
    """The inverse of `pack`; `like` gives structure, shapes and dtypes.

    Raises:
      UsageError: paths, shapes or dtypes differ.
    """
    leaves, treedef = jax.tree_util.tree_flatten_with_path(like)
    expected = {jax.tree_util.keystr(path): x for path, x in leaves}
    wanted = {path for path, x in expected.items() if x.size}
    if wanted != set(packed):
        difference = sorted(wanted ^ set(packed))
        raise UsageError(f"the checkpoint belongs to another kind of run: it differs in {', '.join(difference[:3])}")

    def restore(path: str, x: Any) -> jax.Array:
        if not x.size:
            return jnp.zeros(x.shape, x.dtype)
        data = jnp.asarray(packed[path])
        value = jax.random.wrap_key_data(data) if _is_key(x) else data
        if (value.shape, value.dtype) != (x.shape, x.dtype):
            raise UsageError(f"the checkpoint's {path} is {value.dtype}{value.shape}, expected {x.dtype}{x.shape}")
        return value

    return treedef.unflatten([restore(path, x) for path, x in expected.items()])


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


class Checkpoints:
    """The checkpoints of a run folder, one per update, the last `KEEP` of them kept."""

    def __init__(self, folder: pathlib.Path) -> None:
        options = ocp.CheckpointManagerOptions(max_to_keep=KEEP, create=True, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager((folder / "checkpoints").absolute(), options=options)

    def save(self, update: int, state: Any) -> None:
        """Writes `state` as the checkpoint after `update` updates; a crash meanwhile leaves the older ones whole."""
        if update not in self._manager.all_steps():
            self._manager.save(update, args=ocp.args.StandardSave(pack(state)))

    def latest(self) -> int | None:
        """The newest complete checkpoint's update, None if there is none."""
        return self._manager.latest_step()

    def load(self, like: Any) -> Any:
        """The newest checkpoint, in the structure of `like`.

        Raises:
          UsageError: there is none, or it belongs to another kind of run.
        """
        update = self.latest()
        if update is None:
            raise UsageError(f"there is no finished checkpoint in {self._manager.directory}; train the run first")
        return unpack(dict(self._manager.restore(update, args=ocp.args.StandardRestore())), like)

    def close(self) -> None:
        """Lets go of the folder."""
        self._manager.close()
