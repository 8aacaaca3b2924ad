"""Nothing finished is lost: kill -9, signals, a full disk, damaged and lost files, and the run goes on bit for bit."""

from __future__ import annotations

import json
import os
import pathlib
import re
import shlex
import shutil
import signal
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pmt_jax import load_config, load_policy
from pmt_jax.errors import UsageError
from pmt_jax.policies import load
from pmt_jax.studies import run_log
from pmt_jax.training import checkpoint, chunks, loggers, loop, run_folder
from pmt_jax.training.provenance import Provenance
from runs import ARGUMENTS, STEPS, TINY, assert_same_run, environment, rows, stop_after_rows

DIES = """
import os, signal, sys
from pmt_jax.cli import main
from pmt_jax.training import loop
loop.CHECKPOINT_SECONDS = 0.0
saves = 0

def die(event, arguments):
    global saves
    if event == "os.rename" and str(arguments[0]).endswith("00.orbax-checkpoint-tmp"):
        saves += 1
        if saves == 5:  # everything is written, but not yet under its name
            os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(die)
main(sys.argv[1:])
"""


@pytest.mark.full
def test_killed_in_the_middle_of_a_save_and_resumed_is_as_if_nothing_had_happened(
    whole: pathlib.Path, tmp_path: pathlib.Path, cli
):
    out = tmp_path / "killed"
    arguments = [str(a) for a in ("train", *ARGUMENTS, "--steps", STEPS, "--out", out)]
    process = subprocess.run([sys.executable, "-c", DIES, *arguments], env=environment(), capture_output=True)
    assert process.returncode == -signal.SIGKILL
    assert {p.name for p in (out / "checkpoints").iterdir()} == {"400", "600", "800.orbax-checkpoint-tmp"}
    assert rows(out)[-1]["step"] == 800
    with (out / "metrics.jsonl").open("a") as file:
        file.write('{"step": 12')  # a line that was being written

    code, text, _ = cli(*arguments, "--resume")
    assert code == 0 and "resuming after 600 steps" in text
    assert_same_run(out, whole)
    assert not list((out / "checkpoints").glob("*tmp"))


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.full)])
def test_a_signal_saves_and_the_command_continues(
    number: int, whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch
):
    stop_after_rows(monkeypatch, number)
    out = tmp_path / "a b"
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", out)
    assert code == 128 + number and not (out / ".lock").exists()
    command = re.search(r"interrupted after 200 steps; saved. Continue with: pmt (.*)", text)
    assert command and [p.name for p in (out / "checkpoints").iterdir()] == ["200"]
    monkeypatch.undo()
    assert cli(*shlex.split(command[1]))[0] == 0
    assert_same_run(out, whole)


def test_a_full_disk_stops_the_run_and_nothing_saved_is_lost(whole: pathlib.Path, small_disk, cli, monkeypatch):
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
    place, remount = small_disk
    out = place / "run"
    code, text, err = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", out)
    assert code == 1 and not err
    assert f"stopped: cannot write into {out}: No space left on device" in text
    assert "make room and continue: pmt train" in text and "Traceback" not in text
    assert remount("size=8m")
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", out, "--resume")
    assert code == 0 and int(re.findall(r"resuming after ([\d,]+) steps", text)[0]) >= 200
    assert_same_run(out, whole)


def test_rows_that_cannot_be_written_stop_the_run(tmp_path: pathlib.Path, cli, monkeypatch):
    begin = loggers.Jsonl.__init__

    def full(self: loggers.Jsonl, path: pathlib.Path) -> None:
        begin(self, path)
        os.dup2(os.open("/dev/full", os.O_WRONLY), self._file.fileno())

    monkeypatch.setattr(loggers.Jsonl, "__init__", full)
    monkeypatch.setattr(loggers.Jsonl, "is_there", True)
    out = tmp_path / "run"
    code, text, err = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", out)
    assert code == 1 and not err and f"stopped: cannot write into {out}: No space left on device" in text


@pytest.mark.full
def test_a_run_of_more_steps_than_fit_into_int32_is_resumed(copy: pathlib.Path, cli):
    step, updates = 2_200_000_000, 22_000_000
    setup, _, saved = run_folder.load_saved(copy)
    for state in (saved["last"], saved["best"].state):
        object.__setattr__(state, "update", jnp.full_like(state.update, updates))
    checkpoints = checkpoint.Checkpoints(copy)
    checkpoints.save(step, saved, Provenance(setup.config))
    checkpoints.close()
    code, text, _ = cli("train", *ARGUMENTS, "--steps", step + 400, "--out", copy, "--resume")
    assert code == 0 and "resuming after 2,200,000,000 steps" in text and "done: 2,200,000,400 steps" in text
    assert [row["broken"] for row in rows(copy)[-4:]] == [None] * 4


def damage(step: pathlib.Path) -> None:
    """Flips one bit of the weights."""
    largest = max((p for p in step.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    data = bytearray(largest.read_bytes())
    data[len(data) // 2] ^= 1
    largest.write_bytes(data)


def test_a_damaged_checkpoint_is_noticed_and_the_one_before_taken(whole: pathlib.Path, copy: pathlib.Path, cli):
    damage(copy / "checkpoints" / str(STEPS))
    code, text, _ = cli("eval", copy, "--episodes", 2)
    assert code == 0 and f"the checkpoint after {STEPS:,} steps in {copy / 'checkpoints'} cannot be read (" in text
    code, text, _ = cli("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache")
    assert code == 0 and "cannot be read" in text and "resuming after 1,400 steps" in text
    assert_same_run(copy, whole)
    for step in (copy / "checkpoints").iterdir():
        damage(step)
    code, _, err = cli("eval", copy)
    assert code == 2 and "no checkpoint in" in err and "restore one from a backup or train anew" in err


def test_lost_files(whole: pathlib.Path, copy: pathlib.Path, cli):
    """Without checkpoints and with a damaged versions.json the run starts over, and what it had logged is kept."""
    before = (copy / "metrics.jsonl").read_text()
    shutil.rmtree(copy / "checkpoints")
    (copy / "versions.json").write_text("[1]")
    code, _, err = cli("eval", copy)
    assert code == 2 and "there is no finished checkpoint" in err
    code, text, _ = cli("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache")
    assert code == 0 and "versions.json cannot be read" in text and "resuming after 0 steps" in text
    assert "its rows so far are kept in metrics-before-1.jsonl" in text
    assert (copy / "metrics-before-1.jsonl").read_text() == before
    assert_same_run(copy, whole)


def test_a_checkpoint_from_before_a_task_told_more_is_still_good(whole: pathlib.Path):
    state = load.load_run(whole)[1]
    packed = checkpoint.pack(state)
    (entry,) = [path for path in packed if ".env.info[" in path]
    older = {path: x for path, x in packed.items() if path != entry}
    after = checkpoint.pack(checkpoint.unpack(older | {entry.replace("position", "forgotten"): packed[entry]}, state))
    assert after.keys() == packed.keys() and not after[entry].any()
    assert all(np.array_equal(after[path], x) for path, x in older.items())
    with pytest.raises(UsageError, match="another kind of run: it differs in .*multiplier"):
        checkpoint.unpack({path: x for path, x in packed.items() if "multiplier" not in path}, state)


def test_metrics_that_were_cut_off_before_the_checkpoint(copy: pathlib.Path, cli):
    """And another version of JAX, which is only said."""
    versions = json.loads((copy / "versions.json").read_text())
    (copy / "versions.json").write_text(json.dumps(versions | {"jax": "0.1"}))
    metrics = copy / "metrics.jsonl"
    text = metrics.read_text()
    metrics.write_text(text[: len(text) // 2])
    shutil.rmtree(copy / "checkpoints" / str(STEPS))
    code, text, _ = cli("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache")
    assert code == 0 and "changed since the run began: jax 0.1 -> " in text
    assert f"{metrics} lacks 6 of 14 rows up to step 1,400: 3 of seed 0 (between steps 1,000 and 1,400), 3 of" in text
    steps = [row["step"] for row in rows(copy)]
    assert steps[-1] == STEPS and 1000 not in steps


@pytest.mark.full
def test_fewer_steps_than_are_done_change_nothing(copy: pathlib.Path, cli):
    before = {path.name: path.read_bytes() for path in copy.glob("*.*")}
    code, text, _ = cli("train", *ARGUMENTS, "--steps", 400, "--out", copy, "--resume")
    assert code == 0 and "done: 1,600 steps" in text
    assert {path.name: path.read_bytes() for path in copy.glob("*.*")} == before


@pytest.mark.parametrize(
    "row",
    [
        '{"step": "many"}',
        '{"seed": 0}',
        '{"step": 200, "seed": 0, "seconds": null}',
        f'{{"step": {10**400}, "seed": 0, "seconds": 1}}',
        f'{{"step": 200, "seed": {10**400}, "seconds": 1}}',
        f'{{"step": 200, "seed": 0, "seconds": {10**400}}}',
        '{"step": 200, "seed": 0, "seconds": 1e309}',
    ],
)
def test_a_row_that_is_none_of_a_run(row: str, copy: pathlib.Path, cli):
    metrics = copy / "metrics.jsonl"
    metrics.write_text(before := metrics.read_text() + row + "\n")
    code, _, err = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", copy, "--resume")
    assert code == 2 and f"{metrics} holds a row with" in err and "delete that line" in err and err.count("\n") == 1
    assert metrics.read_text() == before and not (copy / ".lock").exists()


def test_resuming_where_another_engine_would_simulate(copy: pathlib.Path, cli):
    versions = json.loads((copy / "versions.json").read_text())
    assert versions["engine"] == "xla"
    (copy / "versions.json").write_text(json.dumps(versions | {"engine": "warp"}))
    code, _, err = cli("train", copy / "config.toml", "--out", copy, "--resume")
    assert code == 2
    assert "was simulated by engine 'warp', but physics = auto means 'xla' on this cpu" in err


@pytest.mark.full
def test_folders_that_can_only_be_read(whole: pathlib.Path, small_disk, cli):
    place, remount = small_disk
    out = place / "run"
    assert remount("size=8m")
    shutil.copytree(whole, out)
    assert remount("ro")
    assert cli("eval", out, "--episodes", 2)[0] == 0
    assert load_policy(out)(jnp.zeros((2, 8))).shape == (2, 2)
    for arguments in (("lane", "--out", place / "new"), (out / "config.toml", "--out", out, "--resume")):
        code, _, err = cli("train", *arguments)
        assert code == 2 and "Read-only file system; choose another --out" in err and err.count("\n") == 1
    code, _, err = cli("export", out, "-o", place / "policy")
    assert code == 2 and "Read-only file system; choose another folder" in err


@pytest.mark.full
def test_a_run_goes_on_with_other_settings_and_keeps_a_record(whole: pathlib.Path, copy: pathlib.Path, cli):
    command = ("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache", "--steps", STEPS + 200)
    code, text, _ = cli(*command, "--change", "--clip", 0.1)
    assert code == 0 and f"from step {STEPS:,} on: clip 0.2 -> 0.1" in text
    assert json.loads((copy / "changes.jsonl").read_text()) == {"step": STEPS, "changed": {"clip": "0.2 -> 0.1"}}
    before, after = rows(whole), rows(copy)
    assert after[: len(before)] == before and after[-1]["step"] == STEPS + 200
    (actor,) = {int(x) for x in load.load_run(copy)[1].actor.opt_state.count.ravel()}  # Adam goes on counting
    assert actor > {int(x) for x in load.load_run(whole)[1].actor.opt_state.count.ravel()}.pop() > 0
    settings = load_config(copy / "config.toml")
    assert settings.clip == 0.1 and run_log.read(copy).settings["changed"] == f"clip 0.2 -> 0.1 at {STEPS:,}"
    assert run_log.read(copy).identity != run_log.read(whole).identity


def test_fewer_steps_than_are_trained_are_refused_before_anything_compiles(copy: pathlib.Path, cli):
    file = copy / "config.toml"
    file.write_text(file.read_text().replace(f"steps = {STEPS}\n", f"steps = {2 * STEPS}\n"))
    code, text, err = cli("train", file, "--out", copy, "--resume", "--no-cache", "--steps", 100)
    assert code == 2 and f"has {STEPS:,} of {2 * STEPS:,} steps already, more than the 100 asked for; ask for" in err
    assert "compiling" not in text and load_config(file).steps == 2 * STEPS


@pytest.mark.full
def test_a_run_that_has_ended_says_what_would_train(copy: pathlib.Path, cli):
    """It would drop the other settings otherwise."""
    command = ("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache")
    before = (copy / "config.toml").read_text()
    code, _, err = cli(*command, "--change", "--clip", 0.1)
    assert code == 2 and f"has {STEPS:,} steps already" in err and f"--steps of {STEPS + 100} or more" in err
    assert (copy / "config.toml").read_text() == before and not (copy / "changes.jsonl").exists()
    assert cli(*command, "--change")[0] == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--seed", 5), "--change cannot change seed; leave them as they are"),
        (("--rollout-length", 10), "--change cannot change rollout_length; leave them as they are"),
        (("--episode-starts", "together"), "--change cannot change episode_starts; leave them as they are"),
        pytest.param(("--steps", STEPS + 200, "--hidden", 16), "expected float32", marks=pytest.mark.full),
    ],
)
def test_what_cannot_change(words: tuple, said: str, copy: pathlib.Path, cli):
    before = (copy / "config.toml").read_text()
    code, _, err = cli("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache", "--change", *words)
    assert code == 2 and said in err and "Traceback" not in err
    assert (copy / "config.toml").read_text() == before and not (copy / "changes.jsonl").exists()


# ---------------------------------------------------------------------------------------------------------------------
# Chunks end soon, whatever a row is, and no number depends on where they end


LONG = ("lane", *TINY, "--method", "mappo", "--seeds", 2, "--no-cache")
LONG += ("--log-interval", 10**6, "--steps", 1400)  # one row, of 14 updates
relaxed = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


@relaxed
@given(
    interval=st.integers(1, 10**7),
    updates=st.integers(1, 300),
    speeds=st.lists(st.floats(0, 1e4), min_size=1, max_size=9),
)
def test_a_plan_covers_every_update_once_and_ends_soon(interval: int, updates: int, speeds: list[float]):
    config = load_config("lane", num_envs=2, rollout_length=5, minibatches=1, steps=10 * updates, log_interval=interval)
    assert config.num_updates == updates
    done, seconds, ends = 0, None, []
    while done < updates:
        n, end = chunks.plan(config, done, seconds), chunks.row_end(config, done)
        assert 1 <= n <= min(end - done, chunks.most(config))
        assert n == 1 if seconds is None else n == 1 or n * seconds <= chunks.SECONDS
        done, seconds = done + n, speeds[done % len(speeds)]
        ends += [done] if done == end else []
    assert ends == [*range(interval, updates, interval), updates]


def test_steps_are_not_multiplied_by_the_interval():
    for interval in (1, 3, 7, 10**6):
        sizes = {"num_envs": 8, "rollout_length": 25, "minibatches": 1, "log_interval": interval}
        assert load_config("lane", steps=2000, **sizes).num_updates == 10
        assert load_config("lane", steps=2001, **sizes).num_updates == 11


@relaxed
@given(cuts=st.lists(st.integers(1, 5), min_size=1, max_size=6), room=st.integers(0, 3))
def test_a_row_is_the_same_however_it_is_cut(cuts: list[int], room: int):
    loss = np.random.default_rng(0).normal(size=(2, sum(cuts))).astype(np.float32)
    row, done = chunks.OpenRow(), 0
    for n in cuts:
        padded = np.concatenate([loss[:, done : done + n], np.zeros((2, room), np.float32)], axis=1)
        done += n
        row = row.then(n, {"loss": padded, "finite": np.array([True, done < sum(cuts)])})
        assert chunks.OpenRow.of(row.metrics).updates == row.updates == done
    np.testing.assert_array_equal(row.metrics["loss"], loss)
    assert row.metrics["finite"].tolist() == [True, False]


@pytest.mark.parametrize("length", [1, pytest.param(2, marks=pytest.mark.full)])
def test_rows_and_states_do_not_depend_on_the_chunks(
    length: int, whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch
):
    """`whole` had one update first, as nothing was known of its speed, and then what was left of each row."""
    monkeypatch.setattr(chunks, "plan", lambda config, done, _: min(length, chunks.row_end(config, done) - done))
    assert cli("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "run")[0] == 0
    assert_same_run(tmp_path / "run", whole)


@pytest.mark.full
def test_a_run_that_is_stopped_within_a_row_goes_on_with_the_row(tmp_path: pathlib.Path, cli, monkeypatch):
    """Of a row as long as the run, in chunks of 5 updates and, stopped after the second and fourth, of 3."""
    monkeypatch.setattr(chunks, "plan", lambda config, done, _: min(5, 14 - done))
    assert cli("train", *LONG, "--out", tmp_path / "whole")[0] == 0
    assert [row["step"] for row in rows(tmp_path / "whole")] == [1400, 1400]

    def plan(config: object, done: int, _: object) -> int:
        if done in (3, 9):
            signal.raise_signal(signal.SIGTERM)
        return min(3, 14 - done)

    monkeypatch.setattr(chunks, "plan", plan)
    command = ("train", *LONG, "--out", tmp_path / "run")
    code, text, _ = cli(*command)
    assert code == 128 + signal.SIGTERM and "interrupted after 600 steps; saved" in text
    assert rows(tmp_path / "run") == []
    code, text, _ = cli(*command, "--resume")
    assert code == 128 + signal.SIGTERM and "resuming after 600 steps" in text and "lost" not in text
    code, text, _ = cli(*command, "--resume")
    assert code == 0 and "resuming after 1,200 steps" in text
    assert_same_run(tmp_path / "run", tmp_path / "whole")
    assert cli("eval", tmp_path / "run", "--episodes", 2)[0] == 0
