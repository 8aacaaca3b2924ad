"""What a person gets who types: the right thing, or one sentence and exit code 2."""

from __future__ import annotations

import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from pmt_jax.cli.commands import SHELLS
from pmt_jax.training import lock
from runs import ARGUMENTS, STEPS, environment, rows


def test_a_run_folder(whole: pathlib.Path):
    files = {"config.toml", "metrics.jsonl", "evaluation.jsonl", "versions.json", "checkpoints"}
    assert {p.name for p in whole.iterdir()} == files
    table = rows(whole)
    assert [r["step"] for r in table[::2]] == list(range(200, STEPS + 1, 200))
    assert [r["seed"] for r in table[:4]] == [0, 1, 0, 1]
    names = "step seed task method episode_reward episode_cost cost_limit violation_rate lambda"
    assert set(names.split()) <= set(table[-1])
    assert table[-1]["task"] == "lane" and table[-1]["method"] == "f4sg" and table[-1]["cost_limit"] == 1.0
    versions = json.loads((whole / "versions.json").read_text())
    assert versions["jax"] and versions["mujoco"] and versions["matmul_precision"] == "highest"


def test_eval_of_a_run(whole: pathlib.Path, cli):
    code, out, _ = cli("eval", whole, "--episodes", 8, "--deterministic")
    assert code == 0
    assert out.count("episode_reward") == 2 and "8 episodes a seed, mean actions" in out
    assert cli("eval", whole, "--episodes", 8, "--deterministic")[1] == out  # fixed keys


def test_training_says_at_once_what_it_does(tmp_path: pathlib.Path, cli, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    code, out, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "x")
    assert code == 0 and out.startswith("loading JAX")
    for word in ("f4sg on lane", "device cpu", "engine xla", "= 100 a seed", "16 updates", "compiled in", "pmt eval"):
        assert word in out


def test_a_finished_folder_is_never_overwritten(whole: pathlib.Path, cli):
    before = {p: p.read_bytes() for p in whole.glob("*.*")}
    code, _, err = cli("train", "lane", "--out", whole)
    assert code == 2 and "already holds another run" in err
    assert {p: p.read_bytes() for p in whole.glob("*.*")} == before


def test_resuming_with_other_settings_shows_what_differs(whole: pathlib.Path, cli):
    code, _, err = cli("train", whole / "config.toml", "--out", whole, "--resume", "--clip", 0.1, "--seed", 5)
    assert code == 2 and "clip: 0.2 -> 0.1" in err and "seed: 0 -> 5" in err


CTRL_C = """
import signal, sys
from pmt_jax.cli import run
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background
run(sys.argv[1:])
"""


def test_a_process_ends_with_its_code_and_what_is_registered_and_no_thread_is_cut_off():
    """Also where a thread that nobody joins would run on while the interpreter ends."""
    program = """
import atexit, concurrent.futures, sys, threading, time
from pmt_jax import cli
pool = concurrent.futures.ThreadPoolExecutor()  # its thread waits for work until the process says that it ends
pool.submit(int).result()
atexit.register(print, "registered")
threading.Thread(target=lambda: (time.sleep(0.2), print("joined"))).start()
threading.Thread(target=lambda: time.sleep(1000), daemon=True).start()
cli.run(["version?"])
"""
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment(), timeout=100
    )
    assert result.returncode == 2 and result.stdout.split() == ["joined", "registered"]


@pytest.mark.full
def test_ctrl_c_saves_and_says_how_to_go_on(tmp_path: pathlib.Path):
    out = tmp_path / "long"
    words = [str(a) for a in ("train", *ARGUMENTS, "--steps", "1e8", "--method", "mappo", "--out", out)]
    command = [sys.executable, "-c", CTRL_C, *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment())
    while not (out / "metrics.jsonl").exists() or not (out / "metrics.jsonl").read_text():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    text, _ = process.communicate()
    assert process.returncode == 130
    assert f"pmt train {out / 'config.toml'} --out {out} --resume" in text
    assert len(list((out / "checkpoints").iterdir())) == 1


@pytest.mark.full
def test_a_loss_that_is_not_finite_stops_the_run(tmp_path: pathlib.Path, cli):
    out = tmp_path / "broken"
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--critic-lr", 1e38, "--out", out)
    assert code == 1
    assert (
        "stopped: critic/loss of seed 0 at step 200 is nan; single precision cannot train with critic_lr = 1e+38"
        in text
    )
    assert rows(out)[-1]["step"] < STEPS


@pytest.mark.full
def test_output_that_nobody_reads_any_more(whole: pathlib.Path):
    command = f"{sys.executable} -m pmt_jax eval {whole} --episodes 2 | true"
    buffered = {name: value for name, value in environment().items() if name != "PYTHONUNBUFFERED"}
    for variables in (buffered, buffered | {"PYTHONUNBUFFERED": "1"}):
        result = subprocess.run(["bash", "-c", command], env=variables, capture_output=True, text=True)
        assert "Traceback" not in result.stderr and "BrokenPipe" not in result.stderr


def test_run_folders_that_are_none(tmp_path: pathlib.Path, cli):
    assert "it has no config.toml" in cli("eval", tmp_path)[2]
    assert "there is no run to resume" in cli("train", "lane", "--out", tmp_path / "x", "--resume")[2]
    (tmp_path / "config.toml").write_text('task = "lane"\n')
    code, _, err = cli("eval", tmp_path)
    assert code == 2 and "there is no finished checkpoint" in err
    with lock.acquire(tmp_path):
        code, _, err = cli("eval", tmp_path)
    assert code == 2 and f"process {os.getpid()} since" in err and "first checkpoint" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["tran", "lane"], "unknown command 'tran'; did you mean 'train'?"),
        (["train", "lan"], "unknown task 'lan'; did you mean 'lane'? (pmt envs lists all)"),
        (["train", "ant2x4"], "unknown task 'ant2x4'; did you mean 'ant_2x4'? (pmt envs lists all)"),
        (["train", "nothing.toml"], "there is no configuration file nothing.toml"),
        (["train"], "the following arguments are required: TASK|CONFIG"),
        (["train", "lane", "--lamda-lr", "3"], "unknown argument '--lamda-lr'; did you mean '--lambda-lr'?"),
        (["train", "lane", "--method", "hapo"], "unknown method 'hapo'; did you mean 'happo'?"),
        (["train", "lane", "--steps", "-3"], "steps must be at least 1, not -3"),
        (["train", "lane", "--steps", "10"], "less than one batch"),
        (["train", "lane", "--clip", "wide"], "clip = 'wide' does not fit: expected a number"),
        (["train", "lane", "--physics", "mjx"], "is plain JAX and has no physics engine"),
        (["train", "lane", "--env", "num_agent=3"], "has no option 'num_agent'; did you mean 'num_agents'?"),
        (["train", "lane", "--resume"], "--resume needs --out"),
        (["eval", "runs/none", "--episodes", "0"], "--episodes must be a whole number of at least 1"),
        (["eval", "runs/none"], "runs/none is not a run folder"),
        (["eval", "lane", "--policy", "zero"], "task 'lane' has no baseline policies"),
        (["eval", "voltage_33", "--policy", "dropp"], "unknown policy 'dropp'; did you mean 'droop'?"),
        (["train", "lane", "--preset", "paper_letter"], "unknown preset 'paper_letter'; did you mean 'letter'?"),
        (["train", "lane", "--eval-interval", "-1"], "eval_interval must be a number of updates, or 0 for none"),
        (["export", "runs/none"], "the following arguments are required: -o/--out"),
        (["export", "runs/none", "-o", "x", "--seed", "first"], "--seed must be a whole number of at least 0"),
        (["export", "runs/none", "-o", "x"], "runs/none is not a run folder"),
        (["train", "ant_2x4", "--physics", "warp"], "physics 'warp' needs an NVIDIA GPU"),
    ],
)
def test_mistakes_get_one_sentence_and_exit_code_2(arguments: list[str], says: str, cli, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = cli(*arguments)
    assert code == 2
    assert says in err and err.startswith("pmt: ") and err.count("\n") == 1
    assert not out
    assert not list(tmp_path.iterdir())


def test_folders_that_cannot_be_used(tmp_path: pathlib.Path, cli):
    file = tmp_path / "file"
    file.write_text("mine")
    assert "is a file, not a folder" in cli("train", "lane", "--out", file)[2]
    assert file.read_text() == "mine"
    assert "cannot write into /proc/run" in cli("train", "lane", "--out", "/proc/run")[2]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    assert "already holds other files" in cli("train", "lane", "--out", tmp_path / "mine")[2]


def test_another_package_named_envs_is_noticed(tmp_path: pathlib.Path):
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs" / "__init__.py").write_text("")
    result = subprocess.run(
        [sys.executable, "-m", "pmt_jax", "train", "lane"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 2
    assert "another package named 'envs' hides ours" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("shell", SHELLS)
def test_completion_knows_tasks_methods_and_flags(shell: str, cli):
    code, out, _ = cli("completion", shell)
    assert "%%" not in out  # what argparse writes for a per cent sign
    assert code == 0 and all(word in out for word in ("hand_over_4x3", "f4sg", "lambda-lr", "sweep"))


def test_completion_of_another_shell_is_refused(cli):
    assert cli("completion", "tcsh")[::2] == (2, "pmt: unknown shell 'tcsh'; did you mean 'zsh'?\n")
