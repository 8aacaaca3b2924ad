"""Where the rows of a run are written: metrics.jsonl always; CSV, TensorBoard, Weights & Biases when asked.

The optional packages are imported when their logger is opened.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib
import importlib.util
import json
import math
import os
import pathlib
import uuid
from collections.abc import Sequence
from typing import Any, Protocol

import jax

from ..config.settings import Config
from ..errors import UsageError
from ..files import is_open_at, read_rows
from ..tasks import did_you_mean
from .metrics import Row

NEEDS = {"csv": None, "tensorboard": "tensorboardX", "wandb": "wandb"}  # the packages of the optional loggers


def check_loggers(names: Sequence[str]) -> None:
    """Whether the optional loggers exist, their packages are installed, and Weights & Biases has a key.

    Raises:
      UsageError: one is unknown, or lacks its package or key.
    """
    for name in names:
        if name not in NEEDS:
            raise UsageError(f"unknown logger '{name}'{did_you_mean(name, NEEDS)}")
        package = NEEDS[name]
        if package and importlib.util.find_spec(package) is None:
            raise UsageError(f"logger '{name}' needs {package}; install it with pip install 'pmt-jax[log]'")
    if "wandb" in names:
        _check_wandb_key()


def _check_wandb_key() -> None:
    if os.environ.get("WANDB_MODE") in ("offline", "disabled", "dryrun"):
        return
    if not importlib.import_module("wandb").api.api_key:
        raise UsageError(
            "logger 'wandb' has no key; run wandb login, set WANDB_API_KEY, or set WANDB_MODE=offline to log without "
            "one"
        )


def open_loggers(names: Sequence[str], out: pathlib.Path, config: Config, step: int) -> list[Logger]:
    """All loggers of a run that continues after `step` steps; metrics.jsonl holds the rows up to there."""
    optional = {"csv": Csv, "tensorboard": TensorBoard, "wandb": Wandb}
    return [Jsonl(out / "metrics.jsonl"), *(optional[name](out, config, step) for name in dict.fromkeys(names))]


class Logger(Protocol):
    """Writes a chunk's rows, one per seed."""

    def write(self, rows: list[Row]) -> None:
        """Writes a chunk's rows."""
        ...

    def close(self) -> None:
        """Is called once, after the last rows."""
        ...


class Jsonl:
    """metrics.jsonl: one JSON object a line; null for what is not finite."""

    def __init__(self, path: pathlib.Path) -> None:
        self._path, self._file = path.absolute(), path.open("a+")

    @property
    def is_there(self) -> bool:
        """Whether the file at the path is still the one that is written to; an OSError if the disk does not say."""
        return is_open_at(self._file.fileno(), self._path)

    def write(self, rows: list[Row]) -> None:
        for row in rows:
            self._file.write(json.dumps(finite(row)) + "\n")
        self._file.flush()

    def text(self) -> str:
        """All that the file holds, even if it was deleted or renamed meanwhile."""
        self._file.seek(0)
        return self._file.read()

    def close(self) -> None:
        self._file.close()


class Csv:
    """metrics.csv: the rows of metrics.jsonl with a header; empty for what is not finite."""

    def __init__(self, out: pathlib.Path, config: Config, step: int) -> None:
        del config, step
        self._file = (out / "metrics.csv").open("w", newline="")
        self._before: list[Row] | None = read_rows(out / "metrics.jsonl")
        self._begin(self._before)

    def _begin(self, rows: list[Row]) -> None:
        columns = dict.fromkeys(name for row in rows for name in row)
        self._file.seek(0)
        self._file.truncate()
        self._writer = csv.DictWriter(self._file, list(columns), extrasaction="ignore")
        if columns:
            self._writer.writeheader()
        self._append(rows)

    def _append(self, rows: list[Row]) -> None:
        self._writer.writerows([finite(row) for row in rows])
        self._file.flush()

    def write(self, rows: list[Row]) -> None:
        if self._before is None:
            self._append(rows)
        elif rows:  # a run that goes on with other settings may have other columns
            self._begin([*self._before, *rows])
            self._before = None

    def close(self) -> None:
        self._file.close()


def _numbers(row: Row) -> dict[str, float]:
    """The metrics of a row that have a curve."""
    known = {name: x for name, x in row.items() if isinstance(x, int | float) and math.isfinite(x)}
    return {name: x for name, x in known.items() if name not in ("step", "seed")}


class TensorBoard:
    """Event files in tensorboard/seedN, over environment steps."""

    def __init__(self, out: pathlib.Path, config: Config, step: int) -> None:
        tensorboard = importlib.import_module("tensorboardX")
        self._writers = {
            seed: tensorboard.SummaryWriter(str(out / "tensorboard" / f"seed{seed}"), purge_step=step + 1)
            for seed in range(config.seed, config.seed + config.seeds)
        }

    def write(self, rows: list[Row]) -> None:
        for row in rows:
            for name, x in _numbers(row).items():
                self._writers[row["seed"]].add_scalar(name, x, row["step"])

    def close(self) -> None:
        for writer in self._writers.values():
            writer.close()


class Wandb:
    """One Weights & Biases run in project pmt-jax, metrics as seedN/NAME over environment steps.

    Its id is in the run folder, so that a resumed run continues it. WANDB_MODE=offline needs no network.
    """

    def __init__(self, out: pathlib.Path, config: Config, step: int) -> None:
        del step
        wandb = importlib.import_module("wandb")
        place = out / "wandb-id"
        if not place.exists():
            place.write_text(uuid.uuid4().hex[:12])
        settings = dataclasses.asdict(config)
        identity = {"project": "pmt-jax", "name": out.name, "id": place.read_text(), "dir": str(out)}
        try:
            self._run = wandb.init(**identity, resume="allow", config=settings)
        except wandb.errors.Error as error:
            raise UsageError(f"logger 'wandb' cannot start: {str(error).splitlines()[0]}") from error

    def write(self, rows: list[Row]) -> None:
        metrics = {f"seed{row['seed']}/{name}": x for row in rows for name, x in _numbers(row).items()}
        self._run.log(metrics, step=rows[0]["step"])

    def close(self) -> None:
        self._run.finish()


class Profile:
    """A JAX profiler trace of a few chunks, without the first, which warms up."""

    FIRST, END = 1, 4

    def __init__(self, folder: pathlib.Path | None) -> None:
        self._folder, self._chunks, self._running = folder, 0, False

    def before_chunk(self) -> None:
        """Starts or stops the trace."""
        if self._folder is not None and self._chunks == self.FIRST:
            jax.profiler.start_trace(str(self._folder))
            self._running = True
        elif self._chunks == self.END:
            self.close()
        self._chunks += 1

    def close(self) -> None:
        if self._running:
            self._running = False
            jax.profiler.stop_trace()


def finite(value: Any) -> Any:
    """`value` with every number that JSON cannot hold replaced by None."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
