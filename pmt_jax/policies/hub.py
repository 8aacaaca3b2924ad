"""Trained policies that come with the package, one a task and method, under names like `hub:ant_2x4/r4sg`.

The policies of a task are an archive, `ant_2x4.zip`, and each is a small npz in it: the run's settings, the part of its
best seed's learner state that acts, and its evaluation. SHA256SUMS next to the archives has the checksum of each
policy, as `sha256sum` writes it. Kernels are 8-bit integers with a scale per output, the rest is stored as it is:
docs/howto/pretrained.md has the error.
"""

from __future__ import annotations

import hashlib
import io
import json
import pathlib
import tomllib
import zipfile
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
# What zipfile raises, by where an archive is damaged.
UNREADABLE = (OSError, EOFError, KeyError, RuntimeError, ValueError, zipfile.BadZipFile)
LEVELS = 127  # of an 8-bit integer, on either side of 0
NOTHING = np.float32(1e-30)  # a weight so small is none
_SCALE = "/scale"  # of the kernel whose path stands before it


def is_name(source: str | pathlib.Path) -> bool:
    """Whether a run's folder is the name of a pretrained policy."""
    return str(source).startswith(PREFIX)


def names() -> list[str]:
    """All pretrained policies, those that are damaged or lost included."""
    found = {f"{file.stem}/{member}" for file in FOLDER.glob("*.zip") for member in _members(file)}
    return sorted(PREFIX + policy.removesuffix(".npz") for policy in found | _checksums().keys())


def file_of(name: str) -> pathlib.Path:
    """The archive in which a policy of that name is kept, whether or not there is one."""
    return FOLDER / f"{_task(name)}.zip"


def size(name: str) -> int:
    """How many bytes a policy has.

    Raises:
      UsageError: as `about`.
    """
    return len(_bytes(name))


def about(name: str) -> dict[str, Any]:
    """The description of a policy: its evaluation, its origin, the error of packing (see docs/howto/pretrained.md).

    Raises:
      UsageError: there is no such policy, or it is damaged.
    """
    return json.loads(str(_read(name)["about"]))


def load(name: str, physics: str | None = None) -> tuple[Setup, ActingState]:
    """The settings of the run that a policy comes from, cut down to its one seed, and what acts, with a leading [1].

    Args:
      physics: the engine to simulate with, in place of the fastest for the device.

    Raises:
      UsageError: there is no such policy, it is damaged, or the engine cannot run here.
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
    file, packed = file_of(name), io.BytesIO()
    np.savez_compressed(packed, **table)  # pyright: ignore[reportArgumentType] (its stub)
    policies = {member: _stored(file, member) for member in _members(file)} | {_member(name): packed.getvalue()}
    with writing(file) as partial, zipfile.ZipFile(partial, "w") as archive:
        for member in sorted(policies):
            archive.writestr(zipfile.ZipInfo(member), policies[member])  # without the time: the same bytes every time
    sums = _checksums() | {f"{_task(name)}/{_member(name)}": hashlib.sha256(packed.getvalue()).hexdigest()}
    with writing(FOLDER / CHECKSUMS) as partial:
        partial.write_text("".join(f"{sums[policy]}  {policy}\n" for policy in sorted(sums)))


def _read(name: str) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(_bytes(name))) as table:
        return dict(table)


def _bytes(name: str) -> bytes:
    """A policy's npz, which is as it was when its checksum was written."""
    if name not in names():
        raise UsageError(f"unknown policy '{name}'{did_you_mean(name, names())} (pmt hub lists all)")
    data = _stored(file_of(name), _member(name))
    if _checksums().get(f"{_task(name)}/{_member(name)}") != hashlib.sha256(data).hexdigest():
        raise UsageError(
            f"{name} is damaged: {file_of(name)} is missing, or has it not as {CHECKSUMS} lists it; install "
            "pmt-jax anew"
        )
    return data


def _task(name: str) -> str:
    return name.removeprefix(PREFIX).partition("/")[0]


def _member(name: str) -> str:
    return f"{name.partition('/')[2]}.npz"


def _members(file: pathlib.Path) -> list[str]:
    """The policies of an archive; none if it cannot be read."""
    try:
        with zipfile.ZipFile(file) as archive:
            return archive.namelist()
    except UNREADABLE:
        return []


def _stored(file: pathlib.Path, member: str) -> bytes:
    """A policy's npz as it is in the archive; nothing if it cannot be read."""
    try:
        with zipfile.ZipFile(file) as archive:
            info = archive.getinfo(member)
            return archive.read(info) if info.compress_type == zipfile.ZIP_STORED else b""
    except UNREADABLE:
        return b""


def _checksums() -> dict[str, str]:
    """The policies that belong to the package, as TASK/METHOD.npz, and their checksums."""
    file = FOLDER / CHECKSUMS
    lines = file.read_text(errors="replace").splitlines() if file.is_file() else []
    return {policy: checksum for checksum, _, policy in (line.partition("  ") for line in lines)}


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
