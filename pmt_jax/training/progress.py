"""What the terminal shows while a run trains."""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time
from collections.abc import Iterator

from rich.console import Console
from rich.live import Live
from rich.table import Table

from ..limits import WORST, Limits
from ..output import Say, dropped_if_closed
from .metrics import Row

HISTORY = 12  # rows of the live table
GAP = 2  # characters between its columns
# The columns of the live table, and how early each gives way in a narrow terminal: the largest number first.
COLUMNS = {
    "steps": 0,
    "episode reward": 1,
    "episode cost": 2,
    "limit": 6,
    "violation rate": 7,
    "lambda": 5,
    "steps/s": 4,
    "time left": 3,
}
AVERAGED = ("episode_reward", "episode_cost", f"episode_cost{WORST}", "violation_rate", "lambda")


def duration(seconds: float) -> str:
    """Seconds as a person writes them."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


@contextlib.contextmanager
def alive(what: str, say: Say, first: float = 5.0, longest: float = 30.0) -> Iterator[None]:
    """Says how long `what` has taken, while the code inside prints nothing: after 5 s, 10 s, 20 s, then every 30 s."""
    begin, ended = time.monotonic(), threading.Event()

    def speak() -> None:
        wait = first
        while not ended.wait(wait):
            passed = time.monotonic() - begin
            say(f"{what}: {duration(passed)} so far ...")
            wait = min(passed, longest)

    thread = threading.Thread(target=speak, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class Progress:
    """Means over seeds of the newest metrics, steps per second of training alone, and the time left of everything.

    Metrics of episodes are those of the last row in which an episode ended. A terminal gets a live table, whose last
    line is always the newest and which grows every few seconds; a pipe gets a line every few seconds.
    """

    def __init__(self, total: int, done: int = 0, console: Console | None = None, every: float = 5.0) -> None:
        self._console = console or Console(file=sys.stdout, highlight=False)
        self._total, self._first, self._every = total, done, every
        self._start = time.monotonic()
        self._printed = -math.inf
        self._latest: dict[str, float] = {}
        self._history: list[tuple[str, ...]] = []
        self._live = Live(console=self._console, auto_refresh=False) if self._console.is_terminal else None
        if self._live:
            with dropped_if_closed():
                self._live.start()

    def show(self, rows: list[Row], steps_per_second: float) -> None:
        """Shows a chunk's rows, one per seed; `steps_per_second` are of all seeds."""
        for name in AVERAGED:
            values = [row[name] for row in rows if math.isfinite(row.get(name, math.nan))]
            if values:
                self._latest[name] = sum(values) / len(values)
        step = rows[0]["step"]
        left = (time.monotonic() - self._start) * (self._total - step) / max(step - self._first, 1)
        cells = (
            f"{step:,}",
            self._number("episode_reward", ".1f"),
            self._cost(),
            ", ".join(dict.fromkeys(str(Limits.of_row(row)) for row in rows)),
            self._number("violation_rate", ".2%"),
            self._number("lambda", ".3f"),
            f"{steps_per_second:,.0f}",
            duration(left),
        )
        with dropped_if_closed():
            self._print(cells, last=step >= self._total)

    def _number(self, name: str, spec: str) -> str:
        return format(self._latest[name], spec) if name in self._latest else "-"

    def _cost(self) -> str:
        """The mean over agents; where they do not share costs, also what is held against the limit."""
        worst = self._number(f"episode_cost{WORST}", ".2f")
        return self._number("episode_cost", ".2f") + (f", worst agent {worst}" if worst != "-" else "")

    def _print(self, cells: tuple[str, ...], last: bool) -> None:
        is_due = time.monotonic() - self._printed >= self._every
        if self._live:
            older = self._history if is_due else self._history[:-1]  # the newest row is replaced until it is old enough
            self._history = [*older, cells][-HISTORY:]
            self._live.update(self._table(), refresh=True)
        elif is_due or last:
            print(*(f"{name} {cell}" for name, cell in zip(COLUMNS, cells, strict=True)), sep=", ", flush=True)
        if is_due:
            self._printed = time.monotonic()

    def _table(self) -> Table:
        """The history, with as many columns as fit."""
        columns = list(zip(COLUMNS, zip(*self._history, strict=True), strict=True))
        widths = {name: max(map(len, (name, *cells))) + GAP for name, cells in columns}
        shown: set[str] = set()
        for name in sorted(COLUMNS, key=COLUMNS.__getitem__):
            if sum(widths[other] for other in (*shown, name)) > self._console.width and shown:
                break
            shown.add(name)
        table = Table(box=None, header_style="bold", padding=(0, GAP, 0, 0))
        for name in COLUMNS:
            if name in shown:
                table.add_column(name, justify="right", no_wrap=True)
        for row in zip(*(cells for name, cells in columns if name in shown), strict=True):
            table.add_row(*row)
        return table

    def close(self) -> None:
        """Leaves the last table on the terminal."""
        if self._live:
            with dropped_if_closed():
                self._live.stop()
