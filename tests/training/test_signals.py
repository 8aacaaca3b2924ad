"""Ctrl-C, SIGTERM, SIGHUP and closed pipes: answered at once while nothing is trained, and nothing trained is lost."""

from __future__ import annotations

import io
import os
import pathlib
import shlex
import signal
import subprocess
import sys

import pytest

from pmt_jax.training import signals
from runs import ARGUMENTS, STEPS, assert_same_run, environment

BUSY = """
import hashlib, signal, sys
from pmt_jax.cli import main
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
sys.exit(main(sys.argv[2:]))
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
from pmt_jax.cli import main
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
sys.exit(main(sys.argv[1:]))
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
