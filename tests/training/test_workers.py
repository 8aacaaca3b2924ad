"""Worker processes: the same run, whoever trains which of its seeds."""

from __future__ import annotations

import pathlib
import signal
import subprocess
import sys
from multiprocessing.connection import Pipe

import numpy as np
import psutil
import pytest

from pmt_jax import load_config
from pmt_jax.training import final, workers
from runs import ARGUMENTS, STEPS, assert_same_run, environment, rows, saved

# Of a method that compiles fast, and whose runs do not depend on how long they are to be.
ALONE = ("train", *ARGUMENTS, "--method", "mappo", "--eval-interval", 0)
FAST = (*ALONE, "--workers", 2)


def begun(out: pathlib.Path) -> subprocess.Popen[str]:
    """A run in two workers that has written its first rows and has long to go."""
    words = [str(word) for word in (*FAST, "--steps", 10**7, "--out", out)]
    command = [sys.executable, "-m", "pmt_jax", *words]
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout and any(line.startswith("steps ") for line in process.stdout)
    return process


def assert_together(out: pathlib.Path, first: pathlib.Path, second: pathlib.Path) -> None:
    """A run is two others: its rows, its newest checkpoint and its last evaluation."""
    ours = [row | {"seconds": 0} for row in rows(out)]
    theirs = [row | {"seconds": 0} for row in (*rows(first), *rows(second))]
    assert ours == sorted(theirs, key=lambda row: (row["step"], row["seed"]))
    one, two = saved(first), saved(second)
    for path, x in saved(out).items():
        assert np.array_equal(x, np.concatenate([one[path], two[path]])), path
    evaluated = [(folder / final.FILE).read_text() for folder in (out, first, second)]
    assert evaluated[0] == evaluated[1] + evaluated[2]


@pytest.mark.full
def test_a_workers_seeds_equal_the_run_of_these_seeds_alone(whole: pathlib.Path, tmp_path: pathlib.Path, cli):
    """Three seeds in two workers: 0 and 1, and 2."""
    out, alone = tmp_path / "run", tmp_path / "alone"
    code, text, err = cli("train", *ARGUMENTS, "--seeds", 3, "--workers", 2, "--steps", STEPS, "--out", out)
    assert (code, err) == (0, "") and "2 worker processes share the seeds and the CPUs" in text
    assert cli("train", *ARGUMENTS, "--seed", 2, "--seeds", 1, "--steps", STEPS, "--out", alone)[0] == 0
    assert_together(out, whole, alone)


@pytest.mark.full
def test_a_run_goes_on_in_workers(tmp_path: pathlib.Path, cli):
    assert cli(*ALONE, "--steps", 200, "--out", tmp_path)[0] == 0
    code, text, err = cli(*FAST, "--steps", 400, "--out", tmp_path, "--resume")
    assert (code, err) == (0, "") and rows(tmp_path)[-1]["step"] == 400
    assert "changed since the run began: workers 1 -> 2; the run may not continue bit for bit" in text


@pytest.mark.full
def test_a_signal_saves_all_seeds_and_the_run_goes_on(tmp_path: pathlib.Path, cli):
    """The signal reaches the workers too, as SLURM's do."""
    process = begun(tmp_path / "run")
    for each in (process, *psutil.Process(process.pid).children()):
        each.send_signal(signal.SIGTERM)
    text, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (128 + signal.SIGTERM, "")  # together: an abort says why on stderr
    assert f"--out {tmp_path / 'run'} --resume --workers 2" in text.splitlines()[-1]
    goal = rows(tmp_path / "run")[-1]["step"] + STEPS // 4
    assert cli(*FAST, "--steps", goal, "--out", tmp_path / "run", "--resume")[0] == 0
    uninterrupted = [tmp_path / "first", tmp_path / "second"]
    for seed, out in enumerate(uninterrupted):
        assert cli(*ALONE, "--seed", seed, "--seeds", 1, "--steps", goal, "--out", out)[0] == 0
    assert_together(tmp_path / "run", *uninterrupted)


@pytest.mark.slow
def test_a_run_in_workers_whose_folder_is_gone_is_saved_beside_it(tmp_path: pathlib.Path, cli):
    process = begun(tmp_path / "run")
    (tmp_path / "run").rename(tmp_path / "elsewhere")
    text, err = process.communicate(timeout=120)
    said, saved = text.splitlines()[-1], tmp_path / "run-rescued"
    assert (process.returncode, err) == (1, "")
    assert said.startswith(f"stopped: {tmp_path / 'run'} was deleted, renamed")
    assert f"in {saved}. Continue with: pmt train" in said and said.endswith("--resume --workers 2")
    assert not (tmp_path / "run").exists()
    step = rows(saved)[-1]["step"]
    assert cli(*FAST, "--steps", step + 200, "--out", saved, "--resume")[0] == 0
    assert cli(*FAST, "--steps", step + 200, "--out", tmp_path / "uninterrupted")[0] == 0
    assert_same_run(saved, tmp_path / "uninterrupted")


@pytest.mark.full
def test_a_worker_that_is_killed_loses_nothing_that_was_trained(tmp_path: pathlib.Path, cli):
    process = begun(tmp_path / "run")
    first, second = psutil.Process(process.pid).children()
    second.kill()
    text, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (1, "")
    said, step = text.splitlines()[-1], rows(tmp_path / "run")[-1]["step"]
    assert said.startswith("stopped: worker 2 of 2 (seed 1) was killed by SIGKILL")
    assert f"saved as of step {step:,}. Continue with: pmt train" in said
    psutil.wait_procs([first], timeout=60)
    assert not first.is_running()
    code, text, _ = cli(*ALONE, "--steps", step + 100, "--out", tmp_path / "run", "--resume")
    assert code == 0 and "changed since the run began: workers 2 -> 1" in text


@pytest.mark.full
def test_a_worker_says_nothing_when_its_run_ends_with_a_result_unread():
    ours, theirs = Pipe()
    command = [sys.executable, "-c", workers.START, str(theirs.fileno())]
    streams = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, pass_fds=[theirs.fileno()], env=environment(), text=True, **streams) as process:
        theirs.close()
        ours.send((load_config("lane", num_envs=2, rollout_length=4, seeds=1), {}))
        ours.recv()
        ours.send(("chunk", {}, 1))
        assert ours.poll(60)
        ours.close()
        assert process.wait(60) == 0 and process.stderr and process.stderr.read() == ""


@pytest.mark.full
def test_workers_end_with_the_run_that_is_killed(tmp_path: pathlib.Path):
    process = begun(tmp_path / "run")
    workers = psutil.Process(process.pid).children()
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(workers, timeout=60)
    assert len(workers) == 2 and not alive


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--workers", 3), "--workers 3 cannot share 2 seed(s); take at most one a seed"),
        (("--workers", 0), "--workers must be a whole number of at least 1, not '0'"),
        (("--workers", 2, "--debug"), "--workers and --debug do not go together; leave one of them out"),
        (("--workers", 2, "--devices", 2), "--workers and --devices do not go together; leave one of them out"),
    ],
)
def test_mistakes(arguments: tuple[object, ...], said: str, cli, tmp_path: pathlib.Path):
    code, _, err = cli("train", *ARGUMENTS, "--out", tmp_path / "out", *arguments)
    assert code == 2 and said in err and err.count("\n") == 1 and not (tmp_path / "out").exists()
