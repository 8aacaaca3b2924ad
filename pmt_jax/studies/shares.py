"""A sweep that several processes finish together, on one host or many with one shared folder: each trains a share.

Which points train together, and under which number, is written into the sweep's folder by whoever comes first. Share I
of N is every program whose number is I, I + N, I + 2 N, ... What another process has left unfinished is taken up when
the own share is done.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from ..errors import UsageError
from ..training.lock import InUse, acquire
from . import program_folder, sweep
from .points import Part, Points

PATIENCE = 120.0  # seconds for other processes to look up what there is to do
PAUSE = 0.2
_SLURM = "SLURM_ARRAY_TASK_"


class Share(NamedTuple):
    """Share `number`, from 1, of `count`."""

    number: int
    count: int

    def has(self, program: sweep.Program) -> bool:
        """Whether a program belongs to it."""
        return (program.number - self.number) % self.count == 0

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


def read(text: str) -> Share:
    """The share that `I/N` means.

    Raises:
      UsageError: it means none.
    """
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    share = Share(*map(int, match.groups())) if match else Share(0, 0)
    if not 1 <= share.number <= share.count:
        raise UsageError(f"--part must be I/N with I from 1 to N, like 2/8, not '{text}'")
    return share


def of_array(environment: Mapping[str, str] = os.environ) -> Share | None:
    """The share of a task of a SLURM job array; None outside of one.

    Raises:
      UsageError: the tasks' numbers have gaps, so that a task cannot know its place.
    """
    if f"{_SLURM}ID" not in environment:
        return None
    task, count, first, last, step = (
        int(environment.get(_SLURM + name, default))
        for name, default in (("ID", ""), ("COUNT", "1"), ("MIN", "0"), ("MAX", "0"), ("STEP", "1"))
    )
    place, rest = divmod(task - first, step)
    if rest or place >= count or last - first != (count - 1) * step:
        raise UsageError(
            "the numbers of this SLURM job array have gaps, so a task does not know its place; "
            "submit --array=1-N, or name the share with --part I/N"
        )
    return Share(place + 1, count)


def train(
    share: Share,
    parts: Sequence[Part],
    points: Points,
    out: pathlib.Path,
    launch: sweep.Launch = sweep.ONE_AT_A_TIME,
) -> int:
    """Trains a share of what is missing of the `points` of `parts`, then what others have begun and left.

    Whoever finishes the last point prints the table.

    Returns:
      The exit code of `trainer.train`.

    Raises:
      UsageError: as `sweep.prepare`.
    """
    with _locked_soon(out):
        programs = sweep.prepare(parts, points, out, launch.say)
        for program in programs:
            if not program_folder.point_files(program.folder):  # others may be reading what is there
                sweep.write_points(program)
    mine = [program for program in programs if share.has(program)]
    launch.say(f"share {share}: {len(mine)} of {len(programs)} programs that are not finished")
    for program in [*mine, *(program for program in programs if not share.has(program))]:
        if not share.has(program) and not (program.folder / "run" / "config.toml").is_file():
            continue  # not begun: it is another's
        if code := _train(program, launch):
            return code
    left = [name for name in points if not (out / name / "config.toml").is_file()]
    launch.say(f"share {share} is done; {len(points) - len(left)} of {len(points)} points are finished")
    if not left:
        sweep.say_best(points, out, launch.say)
    return 0


def _train(program: sweep.Program, launch: sweep.Launch) -> int:
    """Trains a program unless another process does, or has done so; returns the exit code."""
    if program.is_finished:
        return 0
    launch.say(f"program {program.number}: {', '.join(program.points)}")
    try:
        return sweep.train_program(program.folder, program.out, launch.cache, launch.say, launch.devices)
    except InUse as used:
        launch.say(f"left to the process that trains it: {used}")
        return 0
    except UsageError:
        if program.is_finished:  # by another process, in this moment
            return 0
        raise


@contextlib.contextmanager
def _locked_soon(out: pathlib.Path) -> Iterator[None]:
    """As `lock.acquire`, but waits for others that do the same."""
    begin = time.monotonic()
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(acquire(out))
                break
            except InUse:
                if time.monotonic() - begin > PATIENCE:
                    raise
                time.sleep(PAUSE)
        yield
