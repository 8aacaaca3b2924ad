"""A run folder belongs to one process at a time."""

from __future__ import annotations

import fcntl
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys

import pytest

from pmt_jax import load_config, make_setup
from pmt_jax.config.load import to_toml
from pmt_jax.errors import UsageError
from pmt_jax.training import lock, run_folder

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
