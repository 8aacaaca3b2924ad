"""Where rows are written, what they mean, and what the terminal shows."""

from __future__ import annotations

import csv
import io
import json
import pathlib
import re
import signal
import sys
import threading
import types

import pytest
from rich.console import Console

from pmt_jax import load_config
from pmt_jax.training import loggers, metrics, progress
from pmt_jax.training.progress import COLUMNS, Progress
from runs import ARGUMENTS, STEPS, assert_same_run, rows, stop_after_rows


@pytest.mark.full
def test_csv_and_tensorboard_and_a_profile(whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch):
    pytest.importorskip("tensorboardX")
    out = tmp_path / "run"
    arguments = ("train", *ARGUMENTS, "--out", out, "--loggers", "csv,tensorboard")
    stop_after_rows(monkeypatch, signal.SIGTERM)
    assert cli(*arguments, "--steps", STEPS)[0] == 128 + 15
    monkeypatch.undo()
    assert cli(*arguments, "--steps", STEPS, "--resume", "--profile", tmp_path / "trace")[0] == 0
    with (out / "metrics.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(rows(out))
    for ours, theirs in zip(table, rows(out), strict=True):
        assert ours == {name: "" if x is None else str(x) for name, x in theirs.items()}
    assert sorted(p.name for p in (out / "tensorboard").iterdir()) == ["seed0", "seed1"]
    assert list((tmp_path / "trace").rglob("*.xplane.pb"))
    assert_same_run(out, whole)


def test_a_run_that_goes_on_otherwise_has_all_its_columns(tmp_path: pathlib.Path):
    """Rows of before lack some that come with an evaluation."""
    config = load_config("lane")
    for first in ([], [{"step": 100, "cost": 1.0}, {"step": 200, "cost": 2.0}]):
        (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in first))
        log = loggers.Csv(tmp_path, config, 200)
        assert (tmp_path / "metrics.csv").read_text().splitlines()[1:] == ["100,1.0", "200,2.0"][: len(first)]
        for step in (300, 400):
            log.write([{"step": step, "cost": 3.0, "eval/cost": 0.5}])
        log.close()
        with (tmp_path / "metrics.csv").open(newline="") as file:
            table = list(csv.DictReader(file))
        assert [row["step"] for row in table] == [*["100", "200"][: len(first)], "300", "400"]
        assert [row["eval/cost"] for row in table] == [*["", ""][: len(first)], "0.5", "0.5"]


def test_weights_and_biases_without_a_network(tmp_path: pathlib.Path, cli, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    out = tmp_path / "run"
    assert cli("train", *ARGUMENTS, "--steps", 400, "--out", out, "--loggers", "wandb")[0] == 0
    identity = (out / "wandb-id").read_text()
    assert len(list((out / "wandb").glob(f"offline-run-*-{identity}"))) == 1


def test_loggers_that_are_not_there(tmp_path: pathlib.Path, cli, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    code, _, err = cli("train", "lane", "--loggers", "csv,wandb", "--out", tmp_path / "x")
    assert code == 2 and err == "pmt: logger 'wandb' needs wandb; install it with pip install 'pmt-jax[log]'\n"
    assert (
        "unknown logger 'tensorbord'; did you mean 'tensorboard'?" in cli("train", "lane", "--loggers", "tensorbord")[2]
    )
    assert not (tmp_path / "x").exists()


def test_a_wandb_without_a_key_is_refused_before_anything_is_compiled(tmp_path: pathlib.Path, cli, monkeypatch):
    wandb = types.ModuleType("wandb")
    wandb.__spec__ = types.SimpleNamespace(name="wandb")  # pyright: ignore[reportAttributeAccessIssue]
    wandb.api = types.SimpleNamespace(api_key=None)  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    code, out, err = cli("train", "lane", "--loggers", "wandb", "--out", tmp_path / "x")
    assert code == 2 and not out and err.startswith("pmt: logger 'wandb' has no key; run wandb login")
    assert not (tmp_path / "x").exists()


def test_every_column_is_defined(whole: pathlib.Path):
    for name in rows(whole)[0]:
        assert metrics.describe(name).definition
    assert metrics.describe("eval/episode_cost/ci95").unit == "cost"
    assert metrics.describe("episode_cost/0") == metrics.describe("episode_cost")
    with pytest.raises(KeyError):
        metrics.describe("figure")


def shown(width: int | None) -> str:
    """What a terminal of that width shows of two rows; a pipe where None."""
    console = Console(file=io.StringIO(), width=width, force_terminal=True) if width else None
    progress = Progress(total=30_000, console=console)
    row = {"episode_reward": 1234.5, "episode_cost": 0.25, "violation_rate": 0.125, "lambda": 0.5, "cost_limit": 1.0}
    for step in (10_000, 30_000):
        progress.show([row | {"step": step}, row | {"step": step}], 98_765)
    progress.close()
    return console.file.getvalue() if console else ""  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("width", [20, 40, 60, 80, 200])
def test_a_narrow_terminal_shows_fewer_columns_whole(width: int):
    text = shown(width)
    assert "\u2026" not in text and "10,000" in text and "steps" in text
    assert (all(name in text for name in COLUMNS)) == (width == 200)
    assert ("episode reward" in text and "1234.5" in text) == (width >= 40)
    assert ("98,765" in text) == (width >= 60)


def test_a_terminal_gets_one_row_every_few_seconds_and_always_the_newest(monkeypatch: pytest.MonkeyPatch):
    """400 chunks in 9 s were 400 rows; the last row is replaced instead until it is old enough."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    console = Console(file=io.StringIO(), width=120, force_terminal=True)
    shown = progress.Progress(total=10_000, console=console, every=5.0)
    for step in range(1, 73):  # eight a second
        now[0] = step / 8
        shown.show([{"step": step, "cost_limit": 1.0}], 10.0)
    shown.close()
    last_frame = console.file.getvalue().rpartition("episode reward")[2]  # pyright: ignore[reportAttributeAccessIssue]
    assert re.findall(r"^ *(\d+) ", last_frame, re.MULTILINE) == ["40", "72"]


def test_what_takes_long_says_that_it_is_alive():
    """While nothing else is printed, and never after it has ended."""
    said: list[str] = []
    spoken = threading.Event()

    def note(line: str) -> None:
        said.append(line)
        spoken.set()

    with progress.alive("compiling", note, first=0.001, longest=0.001):
        assert spoken.wait(60)
    count = len(said)
    assert said[0].startswith("compiling: ") and said[0].endswith(" so far ...")
    with progress.alive("compiling", note):
        pass
    assert len(said) == count


def test_a_pipe_gets_a_line(capsys):
    shown(None)
    assert "steps 30,000, episode reward 1234.5, episode cost 0.25, limit 1," in capsys.readouterr().out
