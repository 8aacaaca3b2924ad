"""A run folder: what it holds, whether a run may start or continue there, and what is written to it."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import pathlib
import platform
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from .. import numerics
from ..config.load import load_config, to_toml
from ..errors import UsageError
from ..files import read_rows, replace_text
from ..learning import fused, learner
from ..learning.setup import Setup, make_setup
from ..learning.types import Best, LearnerState
from ..output import Say
from ..tasks import installed_version
from . import final, lock, processes
from .checkpoint import Checkpoints, Saved, check_name, newest, nothing_finished, unpack
from .history import Row, checkpoint_steps, missing_rows, read_changes
from .loggers import Jsonl, Logger, open_loggers
from .provenance import Provenance, check_machine, check_settings, listed, recorded_versions

PACKAGES = ("pmt-jax", "jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy")
BEFORE_START = ("versions.json",)  # what a run that was killed at its start may leave
MATMUL_PRECISION = "highest"  # NVIDIA's default, TF32, changes results


@dataclasses.dataclass(frozen=True)
class Rescue:
    """Where a run is saved whose folder is gone.

    Attributes:
      of: the run folder or the sweep's; the place is next to it, `OF-rescued`.
      files: {path below that: text} of what it needs besides the run's own files.
    """

    of: pathlib.Path
    files: Mapping[str, str] = dataclasses.field(default_factory=dict)


class RunFolder:
    """The folder of a run that trains here: its lock, settings, versions, rows and the place of its checkpoints.

    The first process reads and writes. All others must call the same methods at the same points, and get its results;
    if it fails, they end with its exit code.

    Attributes:
      path: where it is.
      saved: the checkpoint to continue from; None if there is none, or the run is new.
      checkpoints: where the run's states go.
    """

    def __init__(self, setup: Setup, say: Say, rescue: Rescue | None = None) -> None:
        """A folder for a run of `setup`, which `acquire` gives a path; `rescue` is next to that path if None."""
        self.path, self.saved = pathlib.Path(), None
        self._setup, self._say, self._rescue = setup, say, rescue
        self._provenance = self._run = Provenance.of(setup)
        self._changes: list[Row] = []
        self._is_edited = False
        self._loggers: list[Logger] = []
        self._lock, self._open = contextlib.ExitStack(), contextlib.ExitStack()

    def acquire(self, out: pathlib.Path | None, resume: bool, change: bool = False) -> None:
        """Takes the folder `out`, or a new one if None, until `close`.

        Args:
          resume: it holds a run to continue, which `saved` is then of; otherwise it must hold none.
          change: the settings may differ from that run's, all but `provenance.FIXED`.

        Raises:
          UsageError: another process has it, it holds something else, or the run was made with other settings, on
            another physics engine, or has no checkpoint that can be read.
        """
        self.path, self.saved = self._take(out, resume, change)
        self.checkpoints = self._open.enter_context(contextlib.closing(Checkpoints(self.path)))

    @processes.in_first
    def _take(self, out: pathlib.Path | None, resume: bool, change: bool) -> tuple[pathlib.Path, Saved | None]:
        self.path = out or create(self._setup)
        _check_path(self.path, resume)
        self._lock.enter_context(lock.acquire(self.path, created=out is None))
        self._home = self.path.absolute()  # the working folder may be renamed
        rescue = self._rescue or Rescue(self.path)
        self._rescue = dataclasses.replace(rescue, of=rescue.of.absolute())
        return self.path, self._check_content(resume, change)

    def close(self) -> None:
        """Ends writing, then gives the folder up.

        Raises:
          OSError: what was written last does not fit on the disk.
        """
        with self._lock:
            self._open.close()

    def _check_content(self, resume: bool, change: bool) -> Saved | None:
        """The checkpoint to continue from, if there is one."""
        existing = self.path / "config.toml"
        if not resume:
            if existing.exists() or any(x.name not in BEFORE_START and x.name[0] != "." for x in self.path.iterdir()):
                what = "another run" if existing.exists() else "other files"
                raise UsageError(
                    f"{self.path} already holds {what}; choose another --out, or --resume to continue the run"
                )
            return None
        saved = newest(self.path, self._say, to_continue=True) if checkpoint_steps(self.path) else None
        self._changes = read_changes(self.path)
        written, edited = load_config(existing), {}
        self._run = Provenance(written)
        if saved and saved.provenance:
            edited = saved.provenance.unexplained(saved.step, written, self._changes)
            self._run = Provenance(saved.provenance.config if edited else written, saved.provenance.trials)
        check_settings(self.path, self._run, self._provenance, edited, change, self._say)
        planned, asked = (made.config.total_steps for made in (self._run, self._provenance))
        if saved and asked < saved.step < planned:  # of a run that has ended, nothing is left to train
            raise UsageError(
                f"the run in {self.path} has {saved.step:,} of {planned:,} steps already, more than the {asked:,} asked"
                f" for; ask for {saved.step} or more, or leave --steps out"
            )
        self._is_edited = bool(edited)
        check_machine(self.path, self._setup.config.physics, versions(self._setup), self._say)
        return saved

    # -----------------------------------------------------------------------------------------------------------------
    # Writing

    def check(self) -> None:
        """Whether the folder is still the one that was locked, which must be so before anything is written.

        Raises:
          Gone: it, or the file of its rows, was deleted, renamed or replaced.
        """
        if gone := self._gone():
            raise lock.Gone(f"{gone} was deleted, renamed or replaced while the run trained")

    @processes.in_first
    def _gone(self) -> pathlib.Path | None:
        if not lock.is_held(self.path):
            return self.path
        whole = all(logger.is_there for logger in self._loggers if isinstance(logger, Jsonl))
        return None if whole else self.path / "metrics.jsonl"

    def begin(self) -> None:
        """Makes the folder that of a new run."""
        self.check()
        self._write_settings()

    @processes.in_first
    def _write_settings(self) -> None:
        write_settings(self.path, self._setup)

    def resume(self, step: int, ended: bool) -> list[Row]:
        """Prepares the folder for the run that continues after `step`, the step of `saved` or 0.

        What lies behind that step is set aside or dropped, and changed settings are recorded.

        Args:
          ended: no update is left to make, so that the settings stay as they are.

        Returns:
          the rows up to there.

        Raises:
          UsageError: a row is not one of a run; or other settings were asked for, and the run has ended.
        """
        self.check()
        saved, self.saved = self.saved, None  # as large as the run's state
        if ended:
            self._check_unchanged(step)
        if saved:
            self.checkpoints.set_aside(saved.damaged)
        return self._continue(step, ended, saved and saved.provenance)

    @processes.in_first
    def _check_unchanged(self, step: int) -> None:
        if self._run.differences(self._provenance):
            raise UsageError(
                f"the run in {self.path} has {step:,} steps already, so nothing is left to train with other settings; "
                f"ask for --steps of {step + self._setup.config.batch_size} or more"
            )

    @processes.in_first
    def _continue(self, step: int, ended: bool, old: Provenance | None) -> list[Row]:
        rows = _keep_rows_until(self.path, step, self._say)
        if not ended:
            self._record_changes(step, old)
            (self.path / final.FILE).unlink(missing_ok=True)  # of policies that train on
        if not ended or self._is_edited:  # a run that has ended gets back what it was trained with
            write_settings(self.path, self._setup)
        if missing := missing_rows(self._setup.config, self._changes, rows, step):
            self._say(f"{self.path / 'metrics.jsonl'} lacks {missing}; tables are made of the others")
        return rows

    def _record_changes(self, step: int, old: Provenance | None) -> None:
        """Makes changes.jsonl say what has changed since the checkpoint after `step`, which belongs to `old`."""
        kept = [row for row in self._changes if row["step"] < step + (old is None)]
        changed = (old or self._run).differences(self._provenance)
        if changed:
            self._say(f"from step {step:,} on: {', '.join(f'{name} {change}' for name, change in changed.items())}")
            kept.append({"step": step, "changed": changed})
        if kept != self._changes:
            replace_text(self.path / "changes.jsonl", _lines(kept))
        self._changes = kept

    @processes.in_first
    def open_loggers(self, names: Sequence[str], step: int) -> None:
        """Opens metrics.jsonl, and what `names` says besides, for the rows after `step`."""
        for logger in open_loggers(names, self.path, self._setup.config, step):
            self._loggers.append(self._open.enter_context(contextlib.closing(logger)))

    @processes.in_first
    def log(self, rows: list[Row]) -> None:
        """Writes a chunk's rows into files that are open, so never into those of another run.

        Raises:
          OSError: they cannot be written.
        """
        for logger in self._loggers:
            logger.write(rows)

    @processes.in_first
    def is_evaluated(self, step: int) -> bool:
        """Whether the policies after `step` have the evaluation that ends a run."""
        return bool(final.read(self.path, step, note=lambda _: None))

    def write_evaluation(self, rows: list[Row]) -> None:
        """Writes the evaluation that ends the run.

        Raises:
          Gone: the folder is no longer the one that was locked.
        """
        self.check()
        self._write_evaluation(rows)

    @processes.in_first
    def _write_evaluation(self, rows: list[Row]) -> None:
        final.write(self.path, rows)

    def save(self, step: int, tree: Any) -> None:
        """Writes a checkpoint, as `Checkpoints.save`.

        Raises:
          Gone: the folder is no longer the one that was locked.
        """
        self.check()
        self.checkpoints.save(step, tree, self._provenance)

    def rescue(self, step: int, tree: Any) -> pathlib.Path:
        """Saves the run in a new folder next to the one that is gone, whole but for older checkpoints.

        Returns:
          its path.

        Raises:
          OSError: it cannot be written.
        """
        path = self._make_rescue()
        with contextlib.closing(Checkpoints(path)) as checkpoints:
            checkpoints.save(step, tree, self._provenance)
        return path

    @processes.in_first
    def _make_rescue(self) -> pathlib.Path:
        assert self._rescue
        of, inside = self._rescue.of, self._home.relative_to(self._rescue.of)
        tops = (of.with_name(f"{of.name}-rescued{end}") for end in ("", *(f"-{i}" for i in range(2, 10**6))))
        top = next(top for top in tops if not (top / inside).exists())
        (top / inside).mkdir(parents=True)
        for name, text in self._rescue.files.items():
            (top / name).parent.mkdir(parents=True, exist_ok=True)
            replace_text(top / name, text)
        write_settings(top / inside, self._setup)
        rows = (logger.text() for logger in self._loggers if isinstance(logger, Jsonl))
        replace_text(top / inside / "metrics.jsonl", "".join(rows))
        if self._changes:
            replace_text(top / inside / "changes.jsonl", _lines(self._changes))
        return top / inside


def create(setup: Setup) -> pathlib.Path:
    """A new folder runs/TASK-METHOD-TIME, with a number behind it if another run has taken the name."""
    task = re.sub(r"[^\w.+-]+", "-", setup.vector.spec.name).strip(".-") or "task"
    name = f"{task}-{setup.label}-{time.strftime('%Y%m%d-%H%M%S')}"
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


def _check_path(out: pathlib.Path, resume: bool) -> None:
    """Whether `out` can be a run's folder, as far as that can be said before it is locked.

    Raises:
      UsageError: it is a file, has a name that cannot be encoded, or holds no run to resume.
    """
    check_name(out)
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file, not a folder; choose another --out")
    if resume and not (out / "config.toml").is_file():
        raise UsageError(f"there is no run to resume in {out}: it has no config.toml")


def versions(setup: Setup) -> dict[str, Any]:
    """What the results of a run depend on besides its settings."""
    found: dict[str, Any] = {name: installed_version(name) for name in PACKAGES}
    found |= {"python": platform.python_version(), "device": jax.devices()[0].device_kind}
    found |= {"devices": setup.mesh.size if setup.mesh else 1, "workers": setup.workers}
    found |= {"networks": "fused" if fused.available() else "xla"}
    return found | {"engine": setup.vector.env.engine, "matmul_precision": MATMUL_PRECISION} | numerics.record()


def write_settings(out: pathlib.Path, setup: Setup) -> None:
    """Writes versions.json and config.toml, which makes the folder that of a run."""
    replace_text(out / "versions.json", json.dumps(versions(setup), indent=2) + "\n")
    replace_text(out / "config.toml", to_toml(setup.config))


def _keep_rows_until(out: pathlib.Path, step: int, say: Say) -> list[Row]:
    """Drops the rows after the checkpoint that the run continues from, and a line that was cut off.

    If there is no checkpoint, all rows are kept under another name.

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
    if metrics.exists():
        replace_text(metrics, _lines(rows))
    return rows


def _lines(rows: Sequence[Row]) -> str:
    return "".join(json.dumps(row) + "\n" for row in rows)


def _check_number(metrics: pathlib.Path, row: Row, name: str) -> None:
    if not isinstance(row.get(name), int | float) or isinstance(row[name], bool) or not abs(row[name]) < 2**63:
        raise UsageError(
            f"{metrics} holds a row with {name} = {json.dumps(row.get(name))}, where a number was expected; delete "
            "that line and --resume again"
        )


def state_like(setup: Setup) -> LearnerState:
    """Shapes and dtypes of the run's state, with a leading [seeds]."""
    keys = jax.vmap(jax.random.key)(jnp.arange(setup.config.seeds))
    return jax.eval_shape(jax.vmap(functools.partial(learner.init, setup), (None, 0)), setup.hyper, keys)


def _what_it_is(folder: pathlib.Path) -> str:
    """Of a path that holds no run: why, and what to name instead."""
    if folder.is_file():
        return f"it is a file; name its folder, {folder.parent}" if folder.name == "config.toml" else "it is a file"
    if not folder.exists():
        return "there is no such folder"
    runs = sorted(str(file.parent) for file in folder.glob("*/config.toml"))
    return f"it holds {len(runs)} run(s); name one, as {runs[0]}" if runs else "it has no config.toml"


def load_saved(
    folder: pathlib.Path, physics: str | None = None, warn: Callable[[str], object] = warnings.warn
) -> tuple[Setup, int, dict[str, Any]]:
    """A run's settings, the step of its newest whole checkpoint, and all that it holds: `last` and `best`.

    Raises:
      UsageError: the folder holds no run or no checkpoint, or its config.toml is not that of the checkpoint.
    """
    if not (folder / "config.toml").is_file():
        raise UsageError(f"{folder} is not a run folder: {_what_it_is(folder)}")
    if not (folder / "checkpoints").is_dir():
        raise nothing_finished(folder)
    config = load_config(folder / "config.toml")
    setup = make_setup(config if physics is None else config.replace(physics=physics))
    saved = _newest(folder, warn)
    changes = read_changes(folder)
    if edited := saved.provenance.unexplained(saved.step, config, changes) if saved.provenance else {}:
        raise UsageError(
            f"{folder / 'config.toml'} does not say what the checkpoint after {saved.step:,} steps was trained with; "
            f"mend that file, or move the checkpoint elsewhere if it is of another run:{listed(edited)}"
        )
    with numerics.keys_of(recorded_versions(folder) or {}):
        like = state_like(setup)
        return setup, saved.step, unpack(saved.packed, {"last": like, "best": jax.eval_shape(Best.initial, like)})


_newest = processes.in_first(newest)
