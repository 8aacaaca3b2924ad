"""Trained policies that come with the package, one a task and method, under names like `hub:ant_2x4/r4sg`.

Each is a small npz: the run's settings, the part of its best seed's learner state that acts, and its evaluation.
SHA256SUMS next to them has the checksum of each, as `sha256sum` writes it. Kernels are 8-bit integers with a scale per
output, the rest is stored as it is: docs/howto/pretrained.md has the error.
"""

from __future__ import annotations

import hashlib
import json
import pathlib
import tomllib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..config.load import load_config, to_toml
from ..config.settings import FIELDS, Config
from ..errors import UsageError
from ..files import writing
from ..learning.maths import running_moments
from ..learning.setup import Setup, make_setup
from ..learning.types import ActingState, TrainState
from ..tasks import did_you_mean
from ..training import checkpoint

FOLDER = pathlib.Path(__file__).parent / "pretrained"
CHECKSUMS = "SHA256SUMS"
PREFIX = "hub:"
LEVELS = 127  # of an 8-bit integer, on either side of 0
NOTHING = np.float32(1e-30)  # a weight so small is none
_SCALE = "/scale"  # of the kernel whose path stands before it


def is_name(source: str | pathlib.Path) -> bool:
    """Whether a run's folder is the name of a pretrained policy."""
    return str(source).startswith(PREFIX)


def names() -> list[str]:
    """All pretrained policies, those whose file is damaged or lost included."""
    files = {file.name for file in FOLDER.glob("*.npz")} | _checksums().keys()
    return sorted(PREFIX + file.removesuffix(".npz").replace("-", "/") for file in files)


def file_of(name: str) -> pathlib.Path:
    """Where a policy of that name is kept, whether or not there is one."""
    return FOLDER / f"{name.removeprefix(PREFIX).replace('/', '-')}.npz"


def about(name: str) -> dict[str, Any]:
    """The description of a policy: its evaluation, its origin, the error of packing (see docs/howto/pretrained.md).

    Raises:
      UsageError: there is no such policy, or its file is damaged.
    """
    return json.loads(str(_read(name)["about"]))


def load(name: str, physics: str | None = None) -> tuple[Setup, ActingState]:
    """The settings of the run that a policy comes from, cut down to its one seed, and what acts, with a leading [1].

    Args:
      physics: the engine to simulate with, in place of the fastest for the device.

    Raises:
      UsageError: there is no such policy, its file is damaged, or the engine cannot run here.
    """
    table = _read(name)
    stored = tomllib.loads(str(table.pop("config")))
    # A policy only acts, so settings of its training that no longer exist say nothing about it.
    config = load_config({name: value for name, value in stored.items() if name in FIELDS})
    setup = make_setup(config if physics is None else config.replace(physics=physics))
    del table["about"]
    return setup, checkpoint.unpack(_widened(table), _like(setup))


def save(name: str, config: Config, state: ActingState, facts: dict[str, Any]) -> None:
    """Makes a policy available under `name`.

    Args:
      config: of its run.
      state: of one seed, with a leading [1].
      facts: what `about` returns; `seed` says which of the run's seeds it is.

    Raises:
      UsageError: the file cannot be written.
    """
    settings = to_toml(config.replace(seeds=1, seed=facts["seed"], physics="auto"))
    _write(
        name, _narrowed(checkpoint.pack(state)) | {"config": np.array(settings), "about": np.array(json.dumps(facts))}
    )


def store_facts(name: str, facts: dict[str, Any]) -> None:
    """Replaces the facts that `about` returns.

    Raises:
      UsageError: there is no such policy, or its file cannot be written.
    """
    _write(name, _read(name) | {"about": np.array(json.dumps(facts))})


def rounded(state: ActingState) -> ActingState:
    """The state that `load` returns for a saved one."""
    return checkpoint.unpack(_widened(_narrowed(checkpoint.pack(state))), state)


def _write(name: str, table: dict[str, np.ndarray]) -> None:
    with writing(file_of(name)) as partial:
        np.savez_compressed(partial, **table)  # pyright: ignore[reportArgumentType] (its stub)
        checksum = _checksum(partial)
    sums = _checksums() | {file_of(name).name: checksum}
    with writing(FOLDER / CHECKSUMS) as partial:
        partial.write_text("".join(f"{sums[file]}  {file}\n" for file in sorted(sums)))


def _read(name: str) -> dict[str, np.ndarray]:
    if name not in names():
        raise UsageError(f"unknown policy '{name}'{did_you_mean(name, names())} (pmt hub lists all)")
    file = file_of(name)
    if _checksums().get(file.name, "none") != _checksum(file):
        raise UsageError(
            f"{name} is damaged: {file} is missing or not as {CHECKSUMS} next to it lists it; install pmt-jax anew"
        )
    with np.load(file) as table:
        return dict(table)


def _checksums() -> dict[str, str]:
    """The files that belong to the package, and their checksums."""
    file = FOLDER / CHECKSUMS
    lines = file.read_text(errors="replace").splitlines() if file.is_file() else []
    return {name: checksum for checksum, _, name in (line.partition("  ") for line in lines)}


def _checksum(file: pathlib.Path) -> str:
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError:
        return "unreadable"


def _narrowed(table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Kernels [..., I, J] as int8 and a scale [..., 1, J] each: the largest weight of an output becomes LEVELS."""
    narrow = {}
    for path, x in table.items():
        if path.endswith("['kernel']"):
            scale = np.maximum(np.abs(x).max(-2, keepdims=True), NOTHING) / np.float32(LEVELS)
            narrow |= {path: np.round(x / scale).astype(np.int8), path + _SCALE: scale}
        else:
            narrow[path] = x
    return narrow


def _widened(table: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The inverse of `_narrowed`, but for half a level."""
    weights = {path: x for path, x in table.items() if not path.endswith(_SCALE)}
    return {path: x * table[path + _SCALE] if path + _SCALE in table else x for path, x in weights.items()}


def _like(setup: Setup) -> ActingState:
    """Shapes and dtypes of what acts, with a leading [1]."""

    def of_one_seed(key: jax.Array) -> ActingState:
        params = setup.nets.init_actor(key)
        return ActingState(
            TrainState(params, None), running_moments.init((setup.nets.obs_dim,)), jnp.zeros((), jnp.int32)
        )

    return jax.eval_shape(lambda: jax.vmap(of_one_seed)(jax.random.split(jax.random.key(0), 1)))
