"""policies.py OUT RUN...: the newest checkpoint of each run as OUT/NAME.tar.xz, without what only more training needs.

What the optimisers remember and the environments' states become zeros, which pack to nothing; `python -m bench publish`
reads the rest. Runs that an earlier call has packed are left out, and those beyond MOST, which the next call packs.
"""

from __future__ import annotations

import pathlib
import shutil
import subprocess
import sys
import tempfile
from typing import Any

import jax
import jax.numpy as jnp

from pmt_jax.training.checkpoint import Checkpoints, Provenance
from pmt_jax.training.run_folder import load_saved

SENT = pathlib.Path("/tmp/sent")  # an empty file for each run that is packed
MOST = 7  # a call brings eight files home, and the metrics are one


def slim(run: pathlib.Path, to: pathlib.Path) -> None:
    """Copies a run folder; see the module."""
    setup, step, saved = load_saved(run, physics="auto")

    def kept(path: tuple[Any, ...], leaf: jax.Array) -> jax.Array:
        name = jax.tree_util.keystr(path)
        random = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        forgotten = ".opt_state" in name or ".rollout." in name
        return jnp.zeros_like(leaf) if forgotten and not random else leaf

    to.mkdir(parents=True)
    for name in ("config.toml", "versions.json", "metrics.jsonl"):
        shutil.copy(run / name, to)
    checkpoints = Checkpoints(to)
    checkpoints.save(step, jax.tree_util.tree_map_with_path(kept, saved), Provenance(setup.config))
    checkpoints.close()


def main() -> None:
    out, runs = pathlib.Path(sys.argv[1]), [pathlib.Path(name) for name in sys.argv[2:]]
    SENT.mkdir(exist_ok=True)
    for run in [run for run in runs if not (SENT / run.name).exists()][:MOST]:
        with tempfile.TemporaryDirectory() as folder:
            slim(run, pathlib.Path(folder, run.name))
            subprocess.run(["tar", "cJf", str(out / f"{run.name}.tar.xz"), "-C", folder, run.name], check=True)
        (SENT / run.name).touch()


if __name__ == "__main__":
    main()
