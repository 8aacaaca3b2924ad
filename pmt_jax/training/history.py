"""What a run folder records of the past of its run: settings that changed, and the rows that should be there.

Without JAX, because tables read it.
"""

from __future__ import annotations

import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

from ..config.settings import Config
from ..errors import UsageError
from ..files import Note, read_rows, to_stderr

Row = dict[str, Any]
SHOWN = 3  # seeds that a sentence about missing rows names


def read_changes(folder: pathlib.Path, note: Note = to_stderr) -> list[Row]:
    """What changes.jsonl holds: {step, changed: {setting: 'old -> new'}}, in the order of the steps.

    Raises:
      UsageError: a line is not of that form.
    """
    file = folder / "changes.jsonl"
    rows = read_rows(file, note=note)
    for row in rows:
        changed = row.get("changed")
        if not (
            isinstance(row.get("step"), int) and isinstance(changed, dict) and all(map(_is_change, changed.values()))
        ):
            raise UsageError(f"{file}: a line is not of the form that --resume --change writes; mend or remove it")
    return sorted(rows, key=lambda row: row["step"])


def _is_change(value: Any) -> bool:
    return isinstance(value, str) and len(value.split(" -> ")) == 2


def row_steps(config: Config, changes: Sequence[Row], until: int) -> Iterator[int]:
    """The steps after which a run writes rows, up to `until`; `changes` may have changed how often."""
    found = [(row["step"], row["changed"]["log_interval"].split(" -> ")) for row in changes if _has_interval(row)]
    ends = [*(min(step, until) for step, _ in found), until]
    intervals = [*(int(old) for _, (old, _) in found), config.log_interval]
    begin, last = 0, config.total_steps
    for end, interval in zip(ends, intervals, strict=True):
        row = interval * config.batch_size
        yield from range((begin // row + 1) * row, end + 1, row)
        begin = end
    if until == last and last % (config.log_interval * config.batch_size):
        yield last  # the last row is what is left


def _has_interval(row: Row) -> bool:
    old = row["changed"].get("log_interval", "").split(" -> ")[0]
    return old.isdecimal() and int(old) > 0


def missing_rows(config: Config, changes: Sequence[Row], rows: Sequence[Row], until: int) -> str | None:
    """Which rows up to step `until` are not among `rows`, in words; None if all are.

    Args:
      rows: as metrics.jsonl holds them, each with a step and a seed. If some are of steps at which `config` writes
        none, the seeds are only compared with each other.
    """
    seen = {(row["seed"], row["step"]) for row in rows if row["step"] <= until}
    present = {step for _, step in seen}
    steps = list(row_steps(config, changes, until))
    if not present <= set(steps):
        steps = sorted(present)
    seeds = range(config.seed, config.seed + config.seeds)
    missing = {seed: [step for step in steps if (seed, step) not in seen] for seed in seeds}
    missing = {seed: lost for seed, lost in missing.items() if lost}
    if not missing:
        return None
    each = [f"{len(lost)} of seed {seed} ({_between(lost)})" for seed, lost in missing.items()]
    more = f" and of {len(each) - SHOWN} more seeds" if len(each) > SHOWN else ""
    others = sorted({seed for seed, _ in seen} - set(seeds))
    foreign = f"; it has rows of other seeds: {', '.join(map(str, others[:SHOWN]))}" if others else ""
    count, wanted = sum(map(len, missing.values())), len(steps) * len(seeds)
    return f"{count} of {wanted} rows up to step {until:,}: {', '.join(each[:SHOWN])}{more}{foreign}"


def _between(steps: list[int]) -> str:
    return f"step {steps[0]:,}" if len(steps) == 1 else f"between steps {steps[0]:,} and {steps[-1]:,}"


def checkpoint_steps(folder: pathlib.Path) -> list[int]:
    """The steps of a run folder's checkpoints that have their final name, newest first; none if there is no such place.

    Raises:
      OSError: the place cannot be read.
    """
    try:
        names = [path.name for path in (folder / "checkpoints").iterdir()]
    except (FileNotFoundError, NotADirectoryError):
        return []
    return sorted((int(name) for name in names if name.isdecimal() and name == str(int(name))), reverse=True)
