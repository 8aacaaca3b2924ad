"""Worker processes: the same run, whoever trains which of its seeds."""

from __future__ import annotations

import pathlib
import signal
import subprocess
import sys

import psutil
import pytest

from runs import ARGUMENTS, STEPS, assert_same_run, environment, rows

JOBS = ("train", *ARGUMENTS, "--jobs", 2)


def begun(out: pathlib.Path, *more: object) -> subprocess.Popen[str]:
    """A run in two workers that has written its first rows and has long to go."""
    words = [str(word) for word in (*JOBS, "--steps", 10**7, "--out", out, *more)]
    command = [sys.executable, "-m", "pmt_jax", *words]
    process = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout and any(line.startswith("steps ") for line in process.stdout)
    return process


@pytest.mark.full
def test_workers_train_what_one_process_trains(whole: pathlib.Path, tmp_path: pathlib.Path, cli):
    """Also where the run goes on with other numbers of workers."""
    out = tmp_path / "run"
    code, text, err = cli(*JOBS, "--steps", STEPS, "--out", out)
    assert (code, err) == (0, "") and "2 worker processes share the seeds and the CPUs" in text
    assert_same_run(out, whole)

    out, half = tmp_path / "other", STEPS // 2
    assert cli("train", *ARGUMENTS, "--steps", half, "--out", out)[0] == 0
    code, text, _ = cli(*JOBS, "--steps", STEPS, "--out", out, "--resume")
    assert code == 0 and "changed since the run began: jobs 1 -> 2; the run may not continue bit for bit" in text
    assert_same_run(out, whole)


@pytest.mark.full
def test_seeds_that_cannot_be_shared_evenly_equal_the_runs_of_their_parts(tmp_path: pathlib.Path, cli):
    together = (*ARGUMENTS, "--steps", STEPS // 2)
    assert cli("train", *together, "--seeds", 3, "--jobs", 2, "--out", tmp_path / "run")[0] == 0
    parts = []
    for seed, seeds in ((0, 2), (2, 1)):
        out = tmp_path / f"part-{seed}"
        assert cli("train", *together, "--seed", seed, "--seeds", seeds, "--out", out)[0] == 0
        parts += rows(out)
    ours = [row | {"seconds": 0} for row in rows(tmp_path / "run")]
    theirs = sorted((row | {"seconds": 0} for row in parts), key=lambda row: (row["step"], row["seed"]))
    assert ours == theirs


@pytest.mark.full
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_all_seeds_and_the_run_goes_on(number: int, tmp_path: pathlib.Path, cli):
    """The signal reaches the workers too, as SLURM's do."""
    process = begun(tmp_path / "run")
    for each in (process, *psutil.Process(process.pid).children()):
        each.send_signal(number)
    text, err = process.communicate(timeout=120)
    assert process.returncode == 128 + number and not err
    assert f"--out {tmp_path / 'run'} --resume --jobs 2" in text.splitlines()[-1]
    goal = rows(tmp_path / "run")[-1]["step"] + STEPS // 4
    assert cli(*JOBS, "--steps", goal, "--out", tmp_path / "run", "--resume")[0] == 0
    assert cli(*JOBS, "--steps", goal, "--out", tmp_path / "uninterrupted")[0] == 0
    assert_same_run(tmp_path / "run", tmp_path / "uninterrupted")


@pytest.mark.full
def test_a_worker_that_is_killed_loses_nothing_that_was_trained(tmp_path: pathlib.Path, cli):
    process = begun(tmp_path / "run")
    first, second = psutil.Process(process.pid).children()
    second.kill()
    text, err = process.communicate(timeout=120)
    assert process.returncode == 1 and not err
    said, step = text.splitlines()[-1], rows(tmp_path / "run")[-1]["step"]
    assert said.startswith("stopped: worker 2 of 2 (seed 1) was killed by SIGKILL")
    assert f"saved as of step {step:,}. Continue with: pmt train" in said
    psutil.wait_procs([first], timeout=60)
    assert not first.is_running()
    assert cli(*JOBS, "--steps", step + 100, "--out", tmp_path / "run", "--resume")[0] == 0


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
        (("--jobs", 3), "--jobs 3 cannot share 2 seed(s); take at most as many jobs as --seeds"),
        (("--jobs", 0), "--jobs must be a whole number of at least 1, not '0'"),
        (("--jobs", 2, "--debug"), "--jobs and --debug do not go together; leave one of them out"),
        (("--jobs", 2, "--devices", 2), "--jobs and --devices do not go together; leave one of them out"),
    ],
)
def test_mistakes(arguments: tuple[object, ...], said: str, cli, tmp_path: pathlib.Path):
    code, _, err = cli("train", *ARGUMENTS, "--out", tmp_path / "out", *arguments)
    assert code == 2 and said in err and err.count("\n") == 1 and not (tmp_path / "out").exists()
