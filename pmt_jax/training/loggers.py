"""Where a run's figures go: metrics.jsonl and the terminal always; CSV, TensorBoard and Weights & Biases when asked.

What is optional is imported when it is opened.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib
import importlib.util
import json
import math
import pathlib
import sys
import time
import uuid
from collections.abc import Sequence
from typing import Any, Protocol

import jax
from rich.console import Console
from rich.live import Live
from rich.table import Table

from ..config.settings import Config
from ..errors import UsageError
from ..files import read_rows
from ..tasks import did_you_mean

Row = dict[str, Any]
NEEDS = {"csv": None, "tensorboard": "tensorboardX", "wandb": "wandb"}  # the packages of the optional sinks


def check_sinks(names: Sequence[str]) -> None:
    """Whether the optional sinks exist and their packages are installed.

    Raises:
      UsageError: one is unknown, or needs a package that is missing.
    """
    for name in names:
        if name not in NEEDS:
            raise UsageError(f"unknown sink '{name}'{did_you_mean(name, NEEDS)}")
        package = NEEDS[name]
        if package and importlib.util.find_spec(package) is None:
            raise UsageError(f"sink '{name}' needs {package}; install it with pip install 'pmt-jax[log]'")


def open_sinks(names: Sequence[str], out: pathlib.Path, config: Config, step: int) -> list[Sink]:
    """All sinks of a run that goes on after `step` steps; metrics.jsonl holds the rows up to there."""
    optional = {"csv": Csv, "tensorboard": TensorBoard, "wandb": Wandb}
    others = [optional[name](out, config, step) for name in dict.fromkeys(names)]
    progress = Progress(config.num_updates * config.batch_size, step)
    return [Jsonl(out / "metrics.jsonl"), *others, progress]


class Sink(Protocol):
    """Gets a chunk's rows, one per seed, then is closed."""

    def write(self, rows: list[Row]) -> None:
        """Takes a chunk's rows."""
        ...

    def close(self) -> None:
        """Comes once, after the last rows."""
        ...


class Jsonl:
    """metrics.jsonl: one JSON object a line; what is not finite becomes null."""

    def __init__(self, path: pathlib.Path) -> None:
        self._file = path.open("a")

    def write(self, rows: list[Row]) -> None:
        for row in rows:
            self._file.write(json.dumps(finite(row)) + "\n")
        self._file.flush()

    def close(self) -> None:
        self._file.close()


class Csv:
    """metrics.csv: the rows of metrics.jsonl with a header; what is not finite stays empty."""

    def __init__(self, out: pathlib.Path, config: Config, step: int) -> None:
        del config, step
        self._file = (out / "metrics.csv").open("w", newline="")
        self._writer: csv.DictWriter[str] | None = None
        self.write(read_rows(out / "metrics.jsonl"))

    def write(self, rows: list[Row]) -> None:
        if rows and self._writer is None:
            self._writer = csv.DictWriter(self._file, list(rows[0]), extrasaction="ignore")
            self._writer.writeheader()
        if self._writer:
            self._writer.writerows([finite(row) for row in rows])
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def _numbers(row: Row) -> dict[str, float]:
    """The figures of a row that a curve can be drawn of."""
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
    """One Weights & Biases run in project pmt-jax, figures as seedN/NAME over environment steps.

    Its id stands in the run folder, so that a resumed run continues it. WANDB_MODE=offline needs no network.
    """

    def __init__(self, out: pathlib.Path, config: Config, step: int) -> None:
        del step
        wandb = importlib.import_module("wandb")
        place = out / "wandb-id"
        if not place.exists():
            place.write_text(uuid.uuid4().hex[:12])
        settings = dataclasses.asdict(config)
        self._run = wandb.init(
            project="pmt-jax", name=out.name, id=place.read_text(), resume="allow", dir=str(out), config=settings
        )

    def write(self, rows: list[Row]) -> None:
        figures = {f"seed{row['seed']}/{name}": x for row in rows for name, x in _numbers(row).items()}
        self._run.log(figures, step=rows[0]["step"])

    def close(self) -> None:
        self._run.finish()


class Profile:
    """A JAX profiler trace of a few chunks, the first left out, in which everything still warms up."""

    FIRST, END = 1, 4

    def __init__(self, folder: pathlib.Path | None) -> None:
        self._folder, self._chunks, self._running = folder, 0, False

    def before_chunk(self) -> None:
        """Starts or stops the trace where it is time to."""
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


def duration(seconds: float) -> str:
    """Seconds as a person writes them."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


class Progress:
    """What the person at the terminal sees: means over seeds of the newest figures, rate and time left.

    Episode figures are those of the last chunk in which an episode ended. A terminal gets a live table, a pipe one line
    every few seconds.
    """

    COLUMNS = ("steps", "episode reward", "episode cost", "limit", "violation rate", "lambda", "steps/s", "time left")

    def __init__(self, total: int, done: int = 0, console: Console | None = None, every: float = 5.0) -> None:
        self._console = console or Console(file=sys.stdout, highlight=False)
        self._total, self._first, self._every = total, done, every
        self._start = time.monotonic()
        self._printed = -math.inf
        self._latest: dict[str, float] = {}
        self._history: list[tuple[str, ...]] = []
        self._live = Live(console=self._console, auto_refresh=False) if self._console.is_terminal else None
        if self._live:
            self._live.start()

    def write(self, rows: list[Row]) -> None:
        for name in ("episode_reward", "episode_cost", "violation_rate", "lambda"):
            values = [row[name] for row in rows if math.isfinite(row[name])]
            if values:
                self._latest[name] = sum(values) / len(values)
        step, seconds = rows[0]["step"], time.monotonic() - self._start
        rate = (step - self._first) * len(rows) / max(seconds, 1e-9)
        left = (self._total - step) * len(rows) / max(rate, 1e-9)
        cells = (
            f"{step:,}",
            self._number("episode_reward", ".1f"),
            self._number("episode_cost", ".2f"),
            ", ".join(f"{limit:g}" for limit in dict.fromkeys(row["cost_limit"] for row in rows)),
            self._number("violation_rate", ".2%"),
            self._number("lambda", ".3f"),
            f"{rate:,.0f}",
            duration(left),
        )
        self._show(cells, last=step >= self._total)

    def _number(self, name: str, form: str) -> str:
        return format(self._latest[name], form) if name in self._latest else "-"

    def _show(self, cells: tuple[str, ...], last: bool) -> None:
        self._history = [*self._history, cells][-12:]
        if self._live:
            table = Table(*self.COLUMNS, box=None, header_style="bold", padding=(0, 2, 0, 0))
            for column in table.columns:
                column.justify = "right"
            for row in self._history:
                table.add_row(*row)
            self._live.update(table, refresh=True)
        elif last or time.monotonic() - self._printed >= self._every:
            self._printed = time.monotonic()
            print(*(f"{name} {cell}" for name, cell in zip(self.COLUMNS, cells, strict=True)), sep=", ", flush=True)

    def close(self) -> None:
        if self._live:
            self._live.stop()
