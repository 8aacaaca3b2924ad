"""A run folder: what it holds, and whether a run may start or continue there."""

from __future__ import annotations

import functools
import json
import pathlib
import platform
import re
import time
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..config.settings import Config, differences, load_config, to_toml
from ..errors import UsageError
from ..files import read_rows, replace_text
from ..learning import learner
from ..learning.setup import Setup, make_setup
from ..learning.types import Best, LearnerState
from ..output import Say
from ..tasks import installed_version
from .checkpoint import Checkpoints
from .metrics import Row

PACKAGES = ("pmt-jax", "jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy")
# What --change keeps: who the run is, and what is read at its start only.
IDENTITY = ("task", "method", "seed", "seeds", "init", "init_fear", "num_envs", "rollout_length", "episode_starts")
BEFORE_START = ("versions.json",)  # what a run that was killed at its start may leave
MATMUL_PRECISION = "highest"  # NVIDIA's default, TF32, changes results


def create(setup: Setup) -> pathlib.Path:
    """A new folder runs/TASK-METHOD-TIME, with a number behind it if another run has taken the name."""
    task = re.sub(r"[^\w.+-]+", "-", setup.vector.spec.name).strip(".-") or "task"
    name = f"{task}-{setup.config.method}-{time.strftime('%Y%m%d-%H%M%S')}"
    number = 1
    while True:
        out = pathlib.Path("runs") / (name if number == 1 else f"{name}-{number}")
        try:
            out.mkdir(parents=True)
            return out
        except FileExistsError:
            number += 1
        except OSError as error:
            raise UsageError(f"cannot write into {out.parent}: {error.strerror}; choose an --out") from None


def check_out(out: pathlib.Path, resume: bool) -> None:
    """Whether `out` can be a run's folder, as far as that can be said before it is claimed.

    Raises:
      UsageError: it is a file, or holds no run to resume.
    """
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file, not a folder; choose another --out")
    if resume and not (out / "config.toml").is_file():
        raise UsageError(f"there is no run to resume in {out}: it has no config.toml")


def check_content(out: pathlib.Path, setup: Setup, resume: bool, say: Say, change: bool = False) -> None:
    """Whether a claimed folder is empty, or holds the run to resume.

    Args:
      change: the settings may differ from the run's, all but `IDENTITY`.

    Raises:
      UsageError: it does not, or the run was made with other settings or another physics engine.
    """
    existing = out / "config.toml"
    if resume:
        _same_settings(load_config(existing), setup.config, out, change)
        _same_machine(out, setup, say)
    elif existing.exists() or any(path.name not in BEFORE_START and path.name[0] != "." for path in out.iterdir()):
        what = "another run" if existing.exists() else "other files"
        raise UsageError(f"{out} already holds {what}; choose another --out, or --resume to continue the run")


def _same_settings(old: Config, new: Config, out: pathlib.Path, change: bool) -> None:
    """Only `steps` may change when a run is continued; with `change` all settings but IDENTITY."""
    changed = {name: x for name, x in differences(old, new).items() if name in IDENTITY or not change}
    if changed.keys() - {"steps"}:
        advice = "resume it unchanged (only --steps may grow), add --change to continue with the new ones"
        if change:
            advice = f"--change cannot change {', '.join(changed)}; leave them as they are"
        difference = "".join(f"\n  {name}: {x}" for name, x in changed.items() if name != "steps")
        raise UsageError(
            f"the run in {out} was made with other settings; {advice}, or choose another --out:{difference}"
        )


def _changed(out: pathlib.Path, config: Config) -> dict[str, str]:
    """What `config` changes of the run's settings, all but the steps: {name: 'old -> new'}."""
    return {x: y for x, y in differences(load_config(out / "config.toml"), config).items() if x != "steps"}


def check_unchanged(out: pathlib.Path, step: int, config: Config) -> None:
    """Whether a run that has ended after `step` is asked for as it is.

    Raises:
      UsageError: its settings changed, and no update is left to make with them.
    """
    if _changed(out, config):
        raise UsageError(
            f"the run in {out} has {step:,} steps already, so nothing is left to train with other settings; "
            f"ask for --steps of {step + config.batch_size} or more"
        )


def record_changes(out: pathlib.Path, step: int, config: Config, say: Say) -> None:
    """Appends what `config` changes of the run's settings after `step` to changes.jsonl, if anything."""
    if changed := _changed(out, config):
        with (out / "changes.jsonl").open("a") as file:
            file.write(json.dumps({"step": step, "changed": changed}) + "\n")
        say(f"from step {step:,} on: {', '.join(f'{name} {change}' for name, change in changed.items())}")


def _same_machine(out: pathlib.Path, setup: Setup, say: Say) -> None:
    """Refuses another engine, which computes another run; says which versions changed, which costs the last bits."""
    try:
        old = dict(json.loads((out / "versions.json").read_text()))
    except (OSError, ValueError, TypeError):
        say(f"{out / 'versions.json'} cannot be read: the engine and the versions of the run are unknown")
        return
    new = versions(setup)
    if old.get("engine", new["engine"]) != new["engine"]:
        raise UsageError(
            f"the run in {out} was simulated by engine '{old['engine']}', but physics = {setup.config.physics} means "
            f"'{new['engine']}' on this {new['device']}, whose numbers differ; resume it where '{old['engine']}' runs, "
            "or choose another --out"
        )
    changed = [f"{name} {old[name]} -> {new[name]}" for name in new if name in old and old[name] != new[name]]
    if changed:
        say(f"changed since the run began: {', '.join(changed)}; the run may not continue bit for bit")


def versions(setup: Setup) -> dict[str, Any]:
    """What the results of a run depend on besides its settings."""
    found: dict[str, Any] = {name: installed_version(name) for name in PACKAGES}
    found |= {"python": platform.python_version(), "device": jax.devices()[0].device_kind}
    found |= {"devices": setup.mesh.size if setup.mesh else 1, "jobs": setup.jobs}
    return found | {"engine": setup.vector.env.engine, "matmul_precision": MATMUL_PRECISION}


def write_settings(out: pathlib.Path, setup: Setup) -> None:
    """Writes versions.json and config.toml, which makes the folder that of a run."""
    replace_text(out / "versions.json", json.dumps(versions(setup), indent=2) + "\n")
    replace_text(out / "config.toml", to_toml(setup.config))


def keep_rows_until(out: pathlib.Path, step: int, say: Say, open_steps: int = 0) -> list[Row]:
    """Drops the rows after the checkpoint that the run continues from, and a line that was cut off.

    If there is no checkpoint, all rows are kept under another name.

    Args:
      open_steps: the last steps of the checkpoint, of which there is no row yet.

    Returns:
      the rows up to `step`.

    Raises:
      UsageError: a row is not one of a run.
    """
    metrics = out / "metrics.jsonl"
    rows = read_rows(metrics, note=say)
    for row in rows:
        _check_number(metrics, row, "step")
    if step == 0 and rows:
        kept = next(path for i in range(1, 10**6) if not (path := out / f"metrics-before-{i}.jsonl").exists())
        metrics.rename(kept)
        say(f"there is no checkpoint in {out}: the run starts over, and its rows so far are kept in {kept.name}")
        return []
    rows = [row for row in rows if row["step"] <= step]
    for row in rows:
        _check_number(metrics, row, "seed")
        _check_number(metrics, row, "seconds")
    last = rows[-1]["step"] if rows else 0
    if last < step - open_steps:
        say(f"{metrics} ends at step {last:,}, but the checkpoint is of step {step:,}: the rows between are lost")
    if metrics.exists():
        replace_text(metrics, "".join(json.dumps(row) + "\n" for row in rows))
    return rows


def _check_number(metrics: pathlib.Path, row: Row, name: str) -> None:
    if not isinstance(row.get(name), int | float) or isinstance(row[name], bool):
        raise UsageError(
            f"{metrics} holds a row with {name} = {json.dumps(row.get(name))}, where a number was expected; delete "
            "that line and --resume again"
        )


def state_like(setup: Setup) -> LearnerState:
    """Shapes and dtypes of the run's state, with a leading [seeds]."""
    keys = jax.vmap(jax.random.key)(jnp.arange(setup.config.seeds))
    return jax.eval_shape(jax.vmap(functools.partial(learner.init, setup), (None, 0)), setup.hyper, keys)


def initial_best(state: LearnerState) -> Best:
    """Before anything is known of a run of any number of seeds."""
    nothing = np.full(state.update.shape, np.inf, np.float32)
    return Best(_copy(state), -nothing, nothing)


def _what_it_is(folder: pathlib.Path) -> str:
    """Of a path that holds no run: why, and what to name instead."""
    if folder.is_file():
        return f"it is a file; name its folder, {folder.parent}" if folder.name == "config.toml" else "it is a file"
    if not folder.exists():
        return "there is no such folder"
    runs = sorted(str(file.parent) for file in folder.glob("*/config.toml"))
    return f"it holds {len(runs)} run(s); name one, as {runs[0]}" if runs else "it has no config.toml"


@jax.jit
def _copy(state: LearnerState) -> LearnerState:
    return jax.tree.map(jnp.copy, state)  # in one program: a copy of each array would compile one for each shape


def load_saved(
    folder: pathlib.Path, physics: str | None = None, warn: Callable[[str], object] = warnings.warn
) -> tuple[Setup, int, dict[str, Any]]:
    """A run's settings, the step of its newest whole checkpoint, and all that it holds: `last` and `best`.

    Raises:
      UsageError: the folder holds no run, or no checkpoint.
    """
    if not (folder / "config.toml").is_file():
        raise UsageError(f"{folder} is not a run folder: {_what_it_is(folder)}")
    if not (folder / "checkpoints").is_dir():
        raise UsageError(f"there is no finished checkpoint in {folder / 'checkpoints'}; train the run first")
    config = load_config(folder / "config.toml")
    setup = make_setup(config if physics is None else config.replace(physics=physics))
    like = state_like(setup)
    checkpoints = Checkpoints(folder, read_only=True)
    try:
        step, saved = checkpoints.load({"last": like, "best": jax.eval_shape(initial_best, like)}, warn)
    finally:
        checkpoints.close()
    return setup, step, saved
