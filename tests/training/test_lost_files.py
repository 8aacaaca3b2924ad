"""Files of a run that are deleted or cut off at random: each command works on what is whole, or says one sentence.

And nothing that was whole is lost: `eval`, `table` and `report` change nothing, and a run that continues keeps every
checkpoint and row that it could read, and ends where the run ends that nothing befell.
"""

from __future__ import annotations

import contextlib
import io
import json
import pathlib
import shutil
import tempfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pmt_jax.cli import main
from pmt_jax.training import checkpoint
from runs import ARGUMENTS, STEPS, rows, saved

NAMES = ("config.toml", "metrics.jsonl", "versions.json", "checkpoints")
CHECKPOINTS = (STEPS - 200, STEPS)

# What happens to a run: a place in it, as a path or as a share of the way through a checkpoint's files, and what share
# of the file is left; None deletes it.
places = st.one_of(st.sampled_from(NAMES), st.tuples(st.sampled_from(CHECKPOINTS), st.floats(0, 1, exclude_max=True)))
harms = st.lists(st.tuples(places, st.none() | st.floats(0, 1, exclude_max=True)), min_size=1, max_size=3)


def harm(folder: pathlib.Path, where: str | tuple[int, float], left: float | None) -> None:
    """Deletes or cuts off a file; a folder is deleted."""
    if isinstance(where, str):
        path = folder / where
    else:
        step = folder / "checkpoints" / str(where[0])
        found = [step, *sorted(step.rglob("*"))]
        path = found[int(where[1] * len(found))]
    if path.is_dir():
        shutil.rmtree(path)
    elif path.is_file() and left is None:
        path.unlink()
    elif path.is_file():
        data = path.read_bytes()
        path.write_bytes(data[: int(left * len(data))])


def content(folder: pathlib.Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def command(*words: object) -> tuple[int, str]:
    """The exit code of a command, and what it said on standard error; none may end in a traceback."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(word) for word in words])
    said = err.getvalue()
    assert code in (0, 2), (words, said)
    assert "Traceback" not in said + out.getvalue() and "Warning" not in said
    refusals = [line for line in said.splitlines() if line.startswith("pmt: ")]
    assert code == 0 or (refusals and said.startswith("pmt: ")), (words, said)
    return code, said


def reads_only(folder: pathlib.Path, whole: pathlib.Path, report: bool) -> None:
    before = content(folder)
    with tempfile.TemporaryDirectory() as other:
        command("table", folder)
        code, said = command("eval", folder, "--episodes", 1)
        assert code == 0 or not settings_and_checkpoint(folder, whole), said
        if report:
            command("report", folder, "-o", pathlib.Path(other, "report.html"), "--episodes", 1)
    assert content(folder) == before


def whole_checkpoints(folder: pathlib.Path, of: pathlib.Path) -> list[int]:
    """The steps of which a copy has every file of the run `of` that matters, newest first."""
    found = []
    for step in CHECKPOINTS:
        with contextlib.suppress(checkpoint.Damaged):
            ours, theirs = (checkpoint.read_table(run / "checkpoints" / str(step)) for run in (folder, of))
            assert all(
                np.array_equal(ours[path], theirs[path]) for path in theirs if not path.startswith(checkpoint.ROW)
            )
            found.append(step)
    return found[::-1]


def settings_and_checkpoint(folder: pathlib.Path, whole: pathlib.Path) -> bool:
    """Whether all that a run needs to go on is left."""
    same = content(folder).get("config.toml") == (whole / "config.toml").read_bytes()
    return same and bool(whole_checkpoints(folder, whole))


def row_keys(lines: list[str]) -> list[tuple[int, int]]:
    found = []
    for line in lines:
        with contextlib.suppress(ValueError):
            row = json.loads(line)
            found.append((row["step"], row["seed"]))
    return found


def lines(file: pathlib.Path) -> list[str]:
    return file.read_text().splitlines() if file.is_file() else []


def continues(folder: pathlib.Path, whole: pathlib.Path, by_file: bool) -> None:
    """Resumes what is left of a run, by its config.toml or by the flags that it was begun with."""
    before, kept, had = content(folder), whole_checkpoints(folder, whole), row_keys(lines(folder / "metrics.jsonl"))
    settings_whole = before.get("config.toml") == (whole / "config.toml").read_bytes()
    source = (folder / "config.toml", "--no-cache") if by_file else (*ARGUMENTS, "--steps", STEPS)
    code, said = command("train", *source, "--out", folder, "--resume")
    if code == 2:
        assert content(folder) == before
        assert not (settings_whole and kept), said  # what is whole can be continued
        return
    for step in kept:
        assert whole_checkpoints(folder, whole).count(step) == 1
    behind = kept[0] if kept else 0
    now = row_keys(lines(folder / "metrics.jsonl"))
    aside = [key for file in folder.glob("metrics-before-*.jsonl") for key in row_keys(lines(file))]
    assert {key for key in had if key[0] <= behind} <= set(now) and (behind or set(had) <= set(aside))
    if settings_whole or kept or not by_file:
        theirs, ours = saved(whole), saved(folder)
        assert all(np.array_equal(ours[path], theirs[path]) for path in theirs if not path.startswith(checkpoint.ROW))
    assert {(row["step"], row["seed"]) for row in rows(folder)} == set(now)


QUIETLY = {"deadline": None, "suppress_health_check": list(HealthCheck), "derandomize": True, "database": None}


@settings(max_examples=8, **QUIETLY)
@given(harms, st.booleans())
def test_a_run_continues_from_what_is_whole(whole: pathlib.Path, harmed: list, by_file: bool):
    with tempfile.TemporaryDirectory() as place:
        folder = pathlib.Path(shutil.copytree(whole, pathlib.Path(place, "run")))
        for where, left in harmed:
            harm(folder, where, left)
        continues(folder, whole, by_file)


@settings(max_examples=3, **QUIETLY)
@given(harms)
def test_commands_that_read_work_on_what_is_whole(whole: pathlib.Path, harmed: list):
    with tempfile.TemporaryDirectory() as place:
        folder = pathlib.Path(shutil.copytree(whole, pathlib.Path(place, "run")))
        for where, left in harmed:
            harm(folder, where, left)
        reads_only(folder, whole, report=False)


@pytest.mark.full
@pytest.mark.timeout(3600)
@settings(max_examples=5, **(QUIETLY | {"derandomize": False}))
@given(harms, st.booleans())
def test_both_on_many_more(whole: pathlib.Path, harmed: list, by_file: bool):
    with tempfile.TemporaryDirectory() as place:
        folder = pathlib.Path(shutil.copytree(whole, pathlib.Path(place, "run")))
        for where, left in harmed:
            harm(folder, where, left)
        reads_only(folder, whole, report=True)
        continues(folder, whole, by_file)
