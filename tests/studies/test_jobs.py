"""Several programs at a time: their output, their failures, and that they end with whoever started them."""

from __future__ import annotations

import os
import pathlib
import signal
import subprocess
import sys
import textwrap
import time
import types

import pytest

from paths import ROOT
from pmt_jax.errors import UsageError
from pmt_jax.policies import load
from pmt_jax.studies import jobs, run_log, shares
from pmt_jax.training import checkpoint
from pmt_jax.training.lock import acquire
from pmt_jax.training.loggers import Jsonl
from runs import environment


def program(text: str) -> list[str]:
    return [sys.executable, "-c", textwrap.dedent(text)]


def until(condition, seconds: float = 60.0) -> None:
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() - begin < seconds, "it never happened"
        time.sleep(0.05)


def test_so_many_at_a_time_and_no_more(tmp_path: pathlib.Path):
    meeting = program(f"""
        import pathlib, os, time
        here = pathlib.Path({str(tmp_path)!r})
        (here / f"begun-{{os.getpid()}}").touch()
        while len(list(here.glob("begun-*"))) < 2:  # the first waits for the second, however busy the machine is
            time.sleep(0.01)
        print(len(list(here.glob("begun-*"))) - len(list(here.glob("ended-*"))))
        time.sleep(0.3)
        (here / f"ended-{{os.getpid()}}").touch()
    """)
    said: list[str] = []
    assert jobs.run([meeting] * 5, 2, said.append) == 0
    assert sorted(line.split()[0] for line in said) == [f"[{i}]" for i in range(1, 6)]
    assert max(int(line.split()[1]) for line in said) == 2


def test_programs_are_spread_over_the_gpus(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    meeting = program(f"""
        import pathlib, os, time
        here, mine = pathlib.Path({str(tmp_path)!r}), os.environ.get("CUDA_VISIBLE_DEVICES")
        (here / f"begun-{{os.getpid()}}").touch()
        while len(list(here.glob("begun-*"))) < 4:
            time.sleep(0.01)
        print(mine)
    """)
    said: list[str] = []
    assert jobs.run([meeting] * 4, 4, said.append, ("3", "5")) == 0
    assert sorted(line.split()[1] for line in said) == ["3", "3", "5", "5"]
    assert jobs.gpus() == ()  # a CPU is shared as it is
    gpu = types.SimpleNamespace(platform="gpu")
    monkeypatch.setattr(jobs.jax, "local_devices", lambda: [gpu, gpu])
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert jobs.gpus() == ("0", "1")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,GPU-7")
    assert jobs.gpus() == ("2", "GPU-7")
    monkeypatch.setattr(jobs.jax, "local_devices", lambda: [gpu])
    assert jobs.gpus() == ()


def test_after_a_failure_no_other_is_started_and_those_that_run_go_on():
    said: list[str] = []
    slow = program("import time; time.sleep(2); print('done')")
    assert jobs.run([program("raise SystemExit(3)"), slow, program("print('never')")], 2, said.append) == 3
    assert said == ["[2] done"]


WAITING = """
import pathlib, signal, sys, threading, time
from pmt_jax.cli import job
file = pathlib.Path(sys.argv[1])
def end(number, _):
    file.write_text(str(number))
    sys.exit(128 + number)
signal.signal(signal.SIGINT, end)
signal.signal(signal.SIGTERM, end)
threading.Thread(target=job.end_with_parent, daemon=True).start()
file.write_text("ready")
while True:
    time.sleep(0.05)
"""


@pytest.mark.parametrize(
    ("sent", "heard"),
    [
        pytest.param(signal.SIGINT, signal.SIGINT, marks=pytest.mark.full),
        pytest.param(signal.SIGTERM, signal.SIGTERM, marks=pytest.mark.slow),  # heard as SIGINT is
        pytest.param(signal.SIGKILL, signal.SIGTERM, marks=pytest.mark.full),
    ],
)
def test_programs_end_with_the_one_that_started_them(tmp_path: pathlib.Path, sent: int, heard: int):
    files = [tmp_path / "one", tmp_path / "two"]
    commands = [[sys.executable, "-c", WAITING, str(file)] for file in files]
    script = "import sys; from pmt_jax.studies import jobs; "
    script += f"sys.exit(jobs.run({commands!r} + [['never']], 2, print))"
    parent = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT)
    until(lambda: all(file.exists() and file.read_text() == "ready" for file in files))
    os.kill(parent.pid, sent)
    assert parent.wait(60) == (-sent if sent == signal.SIGKILL else 128 + sent)
    until(lambda: [file.read_text() for file in files] == [str(int(heard))] * 2)


@pytest.mark.full
def test_a_sweep_of_two_programs_at_a_time(tmp_path: pathlib.Path, cli):
    tiny = ("--num-envs", 4, "--rollout-length", 25, "--log-interval", 2, "--minibatches", 1, "--epochs", 1)
    tiny += ("--method", "mappo", "--steps", 400, "--no-cache", "--out")
    sizes = ("lane", "--set", "hidden=[8],[12]", *tiny)
    code, out, _ = cli("sweep", *sizes, tmp_path / "both", "--jobs", 2)
    assert code == 0 and sorted(p.name for p in (tmp_path / "both").iterdir()) == ["hidden=12", "hidden=8"]
    assert all(f"[{i}] pmt: mappo on lane" in out and f"[{i}] steps 200" in out for i in (1, 2))
    assert "best first" in out.split("[2] done")[-1]
    assert cli("train", "lane", "--hidden", 8, *tiny, tmp_path / "alone")[0] == 0
    both, alone = (checkpoint.pack(load.load_run(tmp_path / x)[1]) for x in ("both/hidden=8", "alone"))
    assert all((both[name] == alone[name]).all() for name in alone)
    code, out, _ = cli("sweep", *sizes, tmp_path / "both", "--jobs", 2)
    assert code == 0 and "2 of 2 points are finished already" in out and "compiling" not in out
    code, _, err = cli("sweep", *sizes, tmp_path / "both", "--jobs", 0)
    assert code == 2 and "--jobs" in err


# ---------------------------------------------------------------------------------------------------------------------
# Several processes finish a sweep in one folder: shares, shares that died, and what is read meanwhile


TINY = ("--num-envs", 4, "--rollout-length", 25, "--log-interval", 2, "--minibatches", 1)
TINY += ("--epochs", 1, "--method", "mappo", "--steps", 400, "--no-cache")
SWEEP = ("sweep", "lane", *TINY, "--set", "hidden=[4],[6],[8]", "--out")  # three programs of a point each


def finished(out: pathlib.Path) -> list[str]:
    return sorted(p.parent.name for p in out.glob("*/config.toml"))


@pytest.mark.slow
def test_shares_train_their_own_programs_and_the_last_prints_the_table(tmp_path: pathlib.Path, cli):
    out = tmp_path / "out"
    code, text, err = cli(*SWEEP, out, "--part", "2/2")
    assert code == 0, err
    assert "share 2/2: 1 of 3 programs" in text and "1 of 3 points are finished" in text and "best first" not in text
    assert len(finished(out)) == 1
    code, text, _ = cli("table", out)  # what is there can be read
    assert code == 0 and "mappo" in text
    code, text, _ = cli(*SWEEP, out, "--part", "1/2")
    assert code == 0 and "3 of 3 points are finished" in text and "best first" in text
    assert len(finished(out)) == 3 and not list(out.glob(".group*"))
    assert "3 of 3 points are finished already" in cli(*SWEEP, out)[1]


def test_every_program_belongs_to_one_share():
    programs = [shares.sweep.Program(pathlib.Path(f".group-{i}"), {}, pathlib.Path()) for i in range(1, 14)]
    for count in range(1, 16):
        each = [shares.Share(number, count) for number in range(1, count + 1)]
        assert all(sum(share.has(program) for share in each) == 1 for program in programs)


@pytest.mark.full
def test_a_share_that_died_is_taken_up_by_the_next_call(tmp_path: pathlib.Path, cli, monkeypatch):
    """And a program that another process trains is left to it."""
    out = tmp_path / "out"
    write = Jsonl.write
    with monkeypatch.context() as patch:
        patch.setattr(Jsonl, "write", lambda self, log: (write(self, log), os.kill(os.getpid(), signal.SIGTERM)))
        code, text, _ = cli(*SWEEP, out, "--part", "1/3")
    assert code == 143 and "interrupted" in text and not finished(out)
    assert len(run_log.read_all([out], lambda _: None)) == 1  # `pmt table` shows how far it is
    with acquire(out / ".group-1"):
        script = "import sys; from pmt_jax.cli import run; run(sys.argv[1:])"
        words = [str(word) for word in (*SWEEP, out, "--part", "2/3")]
        held = subprocess.run([sys.executable, "-c", script, *words], env=environment(), capture_output=True, text=True)
    assert held.returncode == 0 and "left to the process that trains it" in held.stdout, held.stderr
    assert len(finished(out)) == 1
    code, text, _ = cli(*SWEEP, out, "--part", "3/3")  # its own, then what the first has left
    assert code == 0 and "best first" in text and len(finished(out)) == 3


@pytest.mark.slow
def test_shares_at_the_same_time(tmp_path: pathlib.Path):
    out = tmp_path / "out"
    words = [[sys.executable, "-m", "pmt_jax", *map(str, (*SWEEP, out, "--part", f"{i}/3"))] for i in (1, 2, 3)]
    pipe = subprocess.PIPE
    running = [subprocess.Popen(each, env=environment(), stdout=pipe, stderr=pipe, text=True) for each in words]
    said = [process.communicate(timeout=500) for process in running]
    assert [process.returncode for process in running] == [0, 0, 0], said
    assert len(finished(out)) == 3 and sum("best first" in text for text, _ in said) >= 1


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "a/b", "1/0", "-1/2", "1/2/3", ""])
def test_a_share_that_is_none(text: str, cli, tmp_path: pathlib.Path):
    with pytest.raises(UsageError, match="I/N with I from 1 to N"):
        shares.read(text)


@pytest.mark.parametrize(
    ("numbers", "share"),
    [
        ({"ID": "0", "COUNT": "4", "MIN": "0", "MAX": "3"}, (1, 4)),
        ({"ID": "3", "COUNT": "4", "MIN": "0", "MAX": "3"}, (4, 4)),
        ({"ID": "2", "COUNT": "3", "MIN": "1", "MAX": "3"}, (2, 3)),
        ({"ID": "7", "COUNT": "3", "MIN": "1", "MAX": "7", "STEP": "3"}, (3, 3)),
        ({"ID": "5", "COUNT": "1", "MIN": "5", "MAX": "5"}, (1, 1)),
        ({}, None),
    ],
)
def test_the_share_of_a_task_of_a_job_array(numbers: dict[str, str], share: tuple[int, int] | None):
    found = shares.of_array({f"SLURM_ARRAY_TASK_{name}": x for name, x in numbers.items()})
    assert found == (None if share is None else shares.Share(*share))


def test_a_job_array_with_gaps_is_refused():
    with pytest.raises(UsageError, match="have gaps"):
        shares.of_array({"SLURM_ARRAY_TASK_" + k: v for k, v in dict(ID="7", COUNT="3", MIN="1", MAX="7").items()})
