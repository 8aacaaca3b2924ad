"""Ctrl-C, SIGTERM, SIGHUP and closed pipes: answered at once while nothing is trained, and nothing trained is lost."""

from __future__ import annotations

import fcntl
import io
import json
import os
import pathlib
import shlex
import signal
import socket
import subprocess
import sys

import pytest

from pmt_jax import load_config, make_setup
from pmt_jax.config.load import to_toml
from pmt_jax.errors import UsageError
from pmt_jax.training import lock, run_folder, signals
from runs import ARGUMENTS, STEPS, assert_same_run, environment

BUSY = """
import hashlib, signal, sys
from pmt_jax.cli import run
from pmt_jax.training import trainer

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background
compile_run, compiles = trainer.compile_run, sys.argv[1] == "compiling"

def in_native_code(*_):
    print("busy", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # minutes, in which no Python of this thread runs

def compile_slowly(setup, say):
    if compiles:
        in_native_code()
    state, programs = compile_run(setup, say)
    return state, programs._replace(chunk=in_native_code)

trainer.compile_run = compile_slowly
run(sys.argv[2:])
"""


def busy(phase: str, out: pathlib.Path) -> subprocess.Popen[str]:
    """A run that is busy in native code, while it compiles or trains."""
    words = [str(a) for a in ("train", *ARGUMENTS, "--steps", STEPS, "--out", out)]
    command = [sys.executable, "-c", BUSY, phase, *words]
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout and any(line == "busy\n" for line in process.stdout)
    return process


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, *(pytest.param(x, marks=pytest.mark.full) for x in (signal.SIGTERM, signal.SIGHUP))],
)
def test_a_signal_while_it_compiles_ends_the_run_at_once(number: int, tmp_path: pathlib.Path):
    process = busy("compiling", tmp_path)
    process.send_signal(number)
    text, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number and not err
    assert text == "interrupted: nothing new was trained yet\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.full
def test_ctrl_c_twice_in_a_long_chunk_ends_the_run_at_once(tmp_path: pathlib.Path):
    process = busy("training", tmp_path)
    assert process.stdout
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == (
        "interrupted: saving after the running chunk; Ctrl-C again ends at once, without saving\n"
    )
    process.send_signal(signal.SIGINT)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 130 and text == "interrupted: what was not saved is lost\n"
    assert not (tmp_path / ".lock").exists()


def test_a_run_that_ends_at_once_gives_the_terminal_its_cursor_back(monkeypatch: pytest.MonkeyPatch):
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(os, "_exit", lambda code: terminal.write(f" exit {code}"))
    interrupts = signals.Interrupts(lambda text: terminal.write(text), lambda: None)
    interrupts.answer(signal.SIGINT, at_once=True)
    assert terminal.getvalue() == "interrupted: nothing new was trained yet\x1b[?25h exit 130"


@pytest.mark.full
def test_a_closed_pipe_silences_the_output_and_training_continues(whole: pathlib.Path, tmp_path: pathlib.Path):
    words = ["train", *map(str, ARGUMENTS), "--steps", str(STEPS), "--out", str(tmp_path / "run")]
    command = f"{sys.executable} -m pmt_jax {shlex.join(words)} | head -2; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], env=environment(), capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr and done.stdout.count("\n") == 2
    assert_same_run(tmp_path / "run", whole)


LONG_UPDATE = """
import hashlib, signal, sys, threading
from pmt_jax.cli import run
from pmt_jax.training import signals, trainer

signals.PATIENCE = 0.0
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background
compile_run, calls = trainer.compile_run, []

def compile_slowly(setup, say):
    state, programs = compile_run(setup, say)

    def chunk(state, updates):
        calls.append(updates)
        if len(calls) < 4:
            return programs.chunk(state, updates)
        print("busy", flush=True)
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # minutes, in which no Python of this thread runs

    return state, programs._replace(chunk=chunk)

trainer.compile_run = compile_slowly
run(sys.argv[1:])
"""


@pytest.mark.parametrize(
    "number",
    [pytest.param(signal.SIGTERM, marks=pytest.mark.full), pytest.param(signal.SIGINT, marks=pytest.mark.slow)],
)
def test_an_update_that_takes_too_long_is_given_up_and_what_was_trained_is_saved(
    number: int, whole: pathlib.Path, tmp_path: pathlib.Path, cli
):
    out = tmp_path / "run"
    words = [str(a) for a in ("train", *ARGUMENTS, "--steps", STEPS, "--out", out)]
    command = [sys.executable, "-c", LONG_UPDATE, *words]
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout and any(line == "busy\n" for line in process.stdout)
    process.send_signal(number)
    text, err = process.communicate(timeout=120)
    assert process.returncode == 128 + number and not err and not (out / ".lock").exists()
    assert "interrupted in a long chunk: saved as of step 400. Continue with: pmt train" in text
    assert cli(*words, "--resume")[0] == 0
    assert_same_run(out, whole)


# ---------------------------------------------------------------------------------------------------------------------
# A run folder belongs to one process at a time


RIVAL = """
import pathlib, sys
from pmt_jax.errors import UsageError
from pmt_jax.training import lock
sys.stdin.readline()
try:
    with lock.acquire(pathlib.Path(sys.argv[1])):
        print("locked", flush=True)
        sys.stdin.read()
except UsageError as error:
    print(error, flush=True)
"""


def rivals(folder: pathlib.Path, count: int) -> list[subprocess.Popen[str]]:
    """Processes that lock `folder` once a line is written to them."""
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", RIVAL, str(folder)]
    return [subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) for _ in range(count)]


def answers(processes: list[subprocess.Popen[str]]) -> list[str]:
    for process in processes:
        assert process.stdin
        process.stdin.write("\n")
        process.stdin.flush()
    return [process.stdout.readline().strip() for process in processes if process.stdout]


def test_of_many_that_start_together_one_gets_the_folder(tmp_path: pathlib.Path):
    processes = rivals(tmp_path, 6)
    said = answers(processes)
    assert said.count("locked") == 1
    owner = processes[said.index("locked")]
    others = [line for line in said if line != "locked"]
    assert all(f"{tmp_path} is in use by process" in line and "choose another --out" in line for line in others)
    with pytest.raises(UsageError, match=f"in use by process {owner.pid} since"), lock.acquire(tmp_path):
        pass
    owner.send_signal(signal.SIGKILL)
    owner.wait()
    with lock.acquire(tmp_path):  # the owner is gone, so its lock is
        assert json.loads((tmp_path / lock.NAME).read_text())["pid"] == os.getpid()
    assert not list(tmp_path.iterdir())
    for process in processes:
        process.communicate()


def test_a_lock_of_another_host_stands_until_it_is_deleted(tmp_path: pathlib.Path):
    file = tmp_path / lock.NAME
    file.write_text(json.dumps({"pid": 1, "host": "node7", "since": "2026-01-01 00:00:00"}))
    with (
        pytest.raises(UsageError, match=f"process 1 on node7 since .*; if that process is gone, delete {file}"),
        lock.acquire(tmp_path),
    ):
        pass
    file.unlink()
    with lock.acquire(tmp_path):
        assert json.loads(file.read_text())["host"] == socket.gethostname()


def test_a_job_that_slurm_starts_again_takes_its_folder_over(tmp_path: pathlib.Path, monkeypatch):
    file = tmp_path / lock.NAME
    monkeypatch.setenv("SLURM_JOB_ID", "77")
    file.write_text(json.dumps({"pid": 1, "host": "node7", "slurm": ["77", "0"]}))
    with pytest.raises(UsageError, match="process 1 on node7"), lock.acquire(tmp_path):
        pass
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    with lock.acquire(tmp_path):
        assert json.loads(file.read_text())["slurm"] == ["77", "1"]


def test_where_files_cannot_be_locked_the_process_in_the_file_counts(tmp_path: pathlib.Path, monkeypatch):
    def cannot_lock(*_: object) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", cannot_lock)
    file = tmp_path / lock.NAME
    owner = {"pid": os.getppid(), "host": socket.gethostname(), "since": "2026-01-01 00:00:00"}
    file.write_text(json.dumps(owner))
    with pytest.raises(UsageError, match=f"in use by process {os.getppid()}"), lock.acquire(tmp_path):
        pass
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for stale in (json.dumps(owner | {"pid": gone.pid}), "", "[1]", "{"):
        file.write_text(stale)
        with lock.acquire(tmp_path):
            pass
        assert not file.exists()


def test_training_and_resuming_in_a_folder_in_use_is_refused(tmp_path: pathlib.Path, cli):
    with lock.acquire(tmp_path):
        code, out, err = cli("train", "lane", "--out", tmp_path)
        assert code == 2 and f"{tmp_path} is in use by process {os.getpid()} since" in err and not out
        (tmp_path / "config.toml").write_text('task = "lane"\n')
        assert "is in use by process" in cli("train", "lane", "--out", tmp_path, "--resume")[2]
    assert [path.name for path in tmp_path.iterdir()] == ["config.toml"]


def test_a_sweep_has_its_folder_to_itself(tmp_path: pathlib.Path, cli):
    words = ("sweep", "lane", "--set", "clip=0.1,0.2", "--out")
    with lock.acquire(tmp_path):
        assert f"{tmp_path} is in use by process {os.getpid()}" in cli(*words, tmp_path)[2]
    begun = tmp_path / ".group-1" / "run"
    with lock.acquire(begun):
        (tmp_path / ".group-1" / "points").mkdir()
        (tmp_path / ".group-1" / "points" / "clip=0.1.toml").write_text(
            to_toml(load_config("lane", "mappo_l", clip=0.1))
        )
        code, _, err = cli("sweep", "lane", "--set", "clip=0.1", "--out", tmp_path, "--method", "mappo_l")
        assert code == 2 and f"{begun} is in use" in err
    assert not (tmp_path / lock.NAME).exists()


def test_an_empty_folder_that_was_made_goes_with_its_lock(tmp_path: pathlib.Path):
    with lock.acquire(tmp_path / "a" / "b"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["a"] and not list((tmp_path / "a").iterdir())
    with lock.acquire(tmp_path / "a"), lock.acquire(tmp_path / "c", created=True):
        (tmp_path / "c" / "config.toml").touch()
    assert (tmp_path / "a").is_dir() and (tmp_path / "c" / "config.toml").exists()


def test_default_folders_differ_and_stay_in_runs(tmp_path: pathlib.Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_folder.time, "strftime", lambda form: "20260101-000000")
    setup = make_setup(load_config("lane", method="happo"))
    names = [run_folder.create(setup).name for _ in range(3)]
    assert names == [f"lane-happo-20260101-000000{end}" for end in ("", "-2", "-3")]
    object.__setattr__(setup.vector.env.spec, "name", "../../lane")
    assert run_folder.create(setup) == pathlib.Path("runs") / "lane-happo-20260101-000000-4"
