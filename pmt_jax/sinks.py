"""Where a run's figures go: metrics.jsonl always, a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import json
import math
import pathlib
import sys
import time
from typing import Any, Protocol

from rich.console import Console
from rich.live import Live
from rich.table import Table

Row = dict[str, Any]


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
            f"{rows[0]['cost_limit']:g}",
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
