"""A folder that is deleted, renamed or replaced while a run trains in it: the run is saved, no other is touched."""

from __future__ import annotations

import contextlib
import io
import json
import pathlib
import shlex
import shutil
import tempfile
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pmt_jax.cli import main
from pmt_jax.training import checkpoint, lock, loggers, loop, trainer
from runs import ARGUMENTS, STEPS, assert_same_run, rows, saved

RUN = ("train", *ARGUMENTS, "--steps", STEPS)


def content(folder: pathlib.Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def deleted(folder: pathlib.Path) -> None:
    shutil.rmtree(folder)


def renamed(folder: pathlib.Path) -> None:
    folder.rename(folder.with_name("elsewhere"))


def emptied(folder: pathlib.Path) -> None:
    shutil.rmtree(folder)
    folder.mkdir()


def copied(folder: pathlib.Path) -> None:
    """As by a tool that restores or moves to another disk: the same names and bytes, but other files."""
    renamed(folder)
    shutil.copytree(folder.with_name("elsewhere"), folder)


def unlocked(folder: pathlib.Path) -> None:
    (folder / ".lock").unlink()


def without_rows(folder: pathlib.Path) -> None:
    (folder / "metrics.jsonl").unlink()


def rows_edited(folder: pathlib.Path) -> None:
    """As an editor saves: a new file takes the name."""
    (folder / "new").write_text((folder / "metrics.jsonl").read_text()[:-100])
    (folder / "new").rename(folder / "metrics.jsonl")


def locked_by_another(folder: pathlib.Path) -> None:
    emptied(folder)
    (folder / ".lock").write_text('{"pid": 1, "host": "node7", "since": "2026-01-01 00:00:00"}')
    (folder / "config.toml").write_text("# another run's\n")


def with_its_parent(folder: pathlib.Path) -> None:
    shutil.rmtree(folder.parent)


OF_A_LOCK = (deleted, renamed, emptied, copied, unlocked, locked_by_another, with_its_parent)
HOW = (*OF_A_LOCK, without_rows, rows_edited)


@pytest.fixture
def happens(monkeypatch: pytest.MonkeyPatch):
    """Makes something happen to a folder when a run has written its rows after `step`."""

    def arrange(what: Callable[[pathlib.Path], None], folder: pathlib.Path, step: int) -> None:
        write = loggers.Jsonl.write

        def write_and(self: loggers.Jsonl, some: list) -> None:
            write(self, some)
            if some[0]["step"] == step and folder.exists():
                what(folder)

        monkeypatch.setattr(loggers.Jsonl, "write", write_and)

    return arrange


QUICK = ((deleted, 600), (renamed, STEPS))
REST = {(what, step): pytest.mark.full if step == 600 else pytest.mark.slow for what in HOW for step in (600, STEPS)}


@pytest.mark.parametrize(
    ("what", "step"), [*QUICK, *(pytest.param(*x, marks=mark) for x, mark in REST.items() if x not in QUICK)]
)
def test_a_run_whose_folder_is_gone_is_saved_beside_it_and_goes_on_bit_for_bit(
    what: Callable, step: int, whole: pathlib.Path, tmp_path: pathlib.Path, cli, happens, monkeypatch
):
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
    out = tmp_path / "runs" / "a b"
    happens(what, out, step)
    seen: list[dict[str, bytes]] = []
    monkeypatch.setattr(lock.Gone, "__init__", lambda self, *_: seen.append(content(out) if out.exists() else {}))
    code, text, err = cli(*RUN, "--out", out)
    assert code == 1 and not err and "Traceback" not in text
    said, saved = text.splitlines()[-1], out.with_name("a b-rescued")
    assert said.startswith("stopped: ") and f"saved as of step {step:,} in {saved}. Continue with: pmt " in said
    left = content(out) if out.exists() else {}
    ours = {".lock"} if what in (without_rows, rows_edited) else set()  # there the folder is still the run's
    assert left == {name: data for name, data in seen[0].items() if name not in ours}  # nothing was written after it
    monkeypatch.undo()
    assert [row["step"] for row in rows(saved)][-1] == step
    assert cli(*shlex.split(said.partition("Continue with: pmt ")[2]), "--no-cache")[0] == 0
    assert_same_run(saved, whole)


def test_two_that_go_do_not_overwrite_each_other(tmp_path: pathlib.Path, cli, happens):
    out = tmp_path / "run"
    happens(deleted, out, 200)
    for name in ("run-rescued", "run-rescued-2"):
        code, text, _ = cli(*RUN, "--out", out)
        assert code == 1 and f"in {tmp_path / name}. Continue" in text
    assert {path.name for path in tmp_path.iterdir()} == {"run-rescued", "run-rescued-2"}


@pytest.mark.full
def test_a_run_that_goes_on_says_so_before_it_writes(copy: pathlib.Path, cli, monkeypatch):
    """The folder may go while the program compiles."""
    compile_run = trainer.compile_run

    def compile_and_replace(*arguments):
        result = compile_run(*arguments)
        copied(copy)
        return result

    monkeypatch.setattr(trainer, "compile_run", compile_and_replace)
    (copy / "checkpoints" / "2000").mkdir()  # what it would set aside
    before = content(copy)
    code, text, _ = cli(*RUN, "--out", copy, "--resume", "--steps", STEPS + 200)
    assert code == 1 and f"stopped: {copy} was deleted, renamed or replaced" in text and "nothing new" in text
    assert content(copy) == before | {".lock": (copy / ".lock").read_bytes()}
    assert (copy / "checkpoints" / "2000").is_dir() and not copy.with_name("copy-rescued").exists()


def test_no_place_beside_it(tmp_path: pathlib.Path, cli, happens, monkeypatch):
    out = tmp_path / "run"
    happens(deleted, out, 200)

    def full(self: pathlib.Path, *_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    begin = loggers.Jsonl.write
    monkeypatch.setattr(
        loggers.Jsonl, "write", lambda self, some: (begin(self, some), monkeypatch.setattr(pathlib.Path, "mkdir", full))
    )
    code, text, err = cli(*RUN, "--out", out)
    assert code == 1 and not err and text.splitlines()[-1].endswith("No space left on device")


@pytest.mark.parametrize("what", OF_A_LOCK)
def test_a_lock_ends_without_touching_the_folder_that_took_its_place(what: Callable, tmp_path: pathlib.Path):
    out = tmp_path / "runs" / "x"
    with lock.acquire(out):
        assert lock.is_held(out)
        what(out)
        assert not lock.is_held(out)
        before = content(tmp_path)
    assert content(tmp_path) == before and not lock.is_held(out)


@pytest.mark.full
def test_a_program_of_a_sweep_is_saved_beside_the_sweep_and_goes_on_there(tmp_path: pathlib.Path, cli, happens):
    words = ("sweep", "lane", *ARGUMENTS[1:11], "--method", "mappo_l", "--steps", 600, "--no-cache")
    words = (*words, "--set", "clip=0.1,0.2", "--seeds", 2)
    out, other = tmp_path / "sweep", tmp_path / "other"
    assert cli(*words, "--out", other)[0] == 0

    def replaced(_: pathlib.Path) -> None:
        out.rename(tmp_path / "moved")
        shutil.copytree(other, out)

    happens(replaced, out / ".group-1" / "run", 400)
    before = content(other)
    code, text, err = cli(*words, "--out", out)
    assert code == 1 and not err and f"saved as of step 400 in {tmp_path / 'sweep-rescued'}/.group-1/run" in text
    assert content(out) == before
    code, text, _ = cli(*words, "--out", tmp_path / "sweep-rescued")
    assert code == 0 and "resuming after 400 steps" in text
    for name in ("clip=0.1", "clip=0.2"):
        assert_same_run(tmp_path / "sweep-rescued" / name, other / name)


@pytest.mark.full
def test_what_follows_in_a_sweep_that_is_gone_is_not_trained(tmp_path: pathlib.Path, cli, monkeypatch):
    from pmt_jax.studies import sweep

    words = ("sweep", "lane", *ARGUMENTS[1:11], "--method", "mappo_l", "--steps", 200, "--no-cache")
    out = tmp_path / "sweep"
    cut = sweep.cut_points
    monkeypatch.setattr(sweep, "cut_points", lambda *a: (cut(*a), emptied(out)))
    code, text, err = cli(*words, "--set", "activation=relu,tanh", "--out", out)
    assert code == 1 and not err and f"stopped: {out} was deleted, renamed or replaced" in text
    assert not list(out.iterdir())


# ---------------------------------------------------------------------------------------------------------------------
# Files of a run that are deleted or cut off at random: each command works on what is whole, or says one sentence
# And nothing that was whole is lost: `eval`, `table` and `report` change nothing, and a run that continues keeps every
# checkpoint and row that it could read, and ends where the run ends that nothing befell.


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


def bytes_of(folder: pathlib.Path) -> dict[str, bytes]:
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
    before = bytes_of(folder)
    with tempfile.TemporaryDirectory() as other:
        command("table", folder)
        code, said = command("eval", folder, "--episodes", 1)
        assert code == 0 or not settings_and_checkpoint(folder, whole), said
        if report:
            command("report", folder, "-o", pathlib.Path(other, "report.html"), "--episodes", 1)
    assert bytes_of(folder) == before


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
    same = bytes_of(folder).get("config.toml") == (whole / "config.toml").read_bytes()
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
    before, kept, had = bytes_of(folder), whole_checkpoints(folder, whole), row_keys(lines(folder / "metrics.jsonl"))
    settings_whole = before.get("config.toml") == (whole / "config.toml").read_bytes()
    source = (folder / "config.toml", "--no-cache") if by_file else (*ARGUMENTS, "--steps", STEPS)
    code, said = command("train", *source, "--out", folder, "--resume")
    if code == 2:
        assert bytes_of(folder) == before
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


@contextlib.contextmanager
def copy_of(whole: pathlib.Path, harmed: list) -> Iterator[pathlib.Path]:
    """The run's folder once more, with these harms."""
    with tempfile.TemporaryDirectory() as place:
        folder = pathlib.Path(shutil.copytree(whole, pathlib.Path(place, "run")))
        for where, left in harmed:
            harm(folder, where, left)
        yield folder


@settings(max_examples=8, **QUIETLY)
@given(harms, st.booleans())
def test_a_run_continues_from_what_is_whole(whole: pathlib.Path, harmed: list, by_file: bool):
    with copy_of(whole, harmed) as folder:
        continues(folder, whole, by_file)


@settings(max_examples=3, **QUIETLY)
@given(harms)
def test_commands_that_read_work_on_what_is_whole(whole: pathlib.Path, harmed: list):
    with copy_of(whole, harmed) as folder:
        reads_only(folder, whole, report=False)


@pytest.mark.full
@pytest.mark.timeout(3600)
@settings(max_examples=5, **(QUIETLY | {"derandomize": False}))
@given(harms, st.booleans())
def test_both_on_many_more(whole: pathlib.Path, harmed: list, by_file: bool):
    with copy_of(whole, harmed) as folder:
        reads_only(folder, whole, report=True)
        continues(folder, whole, by_file)
