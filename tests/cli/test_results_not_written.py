"""Commands whose result is their output: one that cannot be written is an error, one that nobody reads is not."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys

import pytest

from runs import environment

COMMANDS = [
    ("envs",),
    ("envs", "lane"),
    ("hub",),
    ("completion", "bash"),
    ("--help",),
    ("--version",),
    ("train", "--help"),
    ("eval", "RUN", "--episodes", "2"),
    ("table", "RUN"),
]


def words(command: tuple[str, ...], run: pathlib.Path) -> list[str]:
    return [str(run) if word == "RUN" else word for word in command]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_full_disk_is_an_error(command: tuple[str, ...], whole: pathlib.Path, cli, monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        code, _, err = cli(*words(command, whole))
    assert code == 2
    assert err == "pmt: cannot write to standard output: No space left on device; the result is not complete\n"


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_reader_that_has_ended_is_none(command: tuple[str, ...], whole: pathlib.Path, cli, monkeypatch):
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        code, _, err = cli(*words(command, whole))
    assert (code, err) == (0, "")


def test_nothing_is_kept_for_the_next_command(cli, monkeypatch):
    with open("/dev/full", "w") as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        assert cli("envs")[0] == 2
    code, text, err = cli("envs")
    assert code == 0 and "lane" in text and not err


def test_the_exit_code_is_that_of_the_process():
    command = f"{sys.executable} -m pmt_jax --help > /dev/full"
    done = subprocess.run(["bash", "-c", command], env=environment(), capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "No space left on device" in done.stderr
