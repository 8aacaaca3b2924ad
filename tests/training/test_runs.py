"""A run that a person can live with: nothing finished is lost, whatever happens, and what comes out of it is usable."""

from __future__ import annotations

import json
import pathlib
import re
import shlex
import shutil
import signal
import subprocess
import sys

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from runs import ARGUMENTS, STEPS, assert_same_run, environment, rows

from pmt_jax import load_config, load_policy, make_setup
from pmt_jax.errors import UsageError
from pmt_jax.learning.evaluation import interval, is_better
from pmt_jax.learning.maths import running_moments
from pmt_jax.policies import load, numpy_policy
from pmt_jax.policies.export import weights
from pmt_jax.training import checkpoint, loggers, trainer

# ---------------------------------------------------------------------------------------------------------------------
# Resuming


DIES = """
import os, signal, sys
from pmt_jax.cli import main
from pmt_jax.training import trainer
trainer.CHECKPOINT_SECONDS = 0.0
saves = 0

def die(event, arguments):
    global saves
    if event == "os.rename" and str(arguments[0]).endswith("00.orbax-checkpoint-tmp"):
        saves += 1
        if saves == 4:  # everything is written, but not yet under its name
            os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(die)
main(sys.argv[1:])
"""


def test_killed_in_the_middle_of_a_save_and_resumed_is_as_if_nothing_had_happened(
    whole: pathlib.Path, tmp_path: pathlib.Path, cli
):
    out = tmp_path / "killed"
    arguments = [str(a) for a in ("train", *ARGUMENTS, "--steps", STEPS, "--out", out)]
    process = subprocess.run([sys.executable, "-c", DIES, *arguments], env=environment(), capture_output=True)
    assert process.returncode == -signal.SIGKILL
    assert {p.name for p in (out / "checkpoints").iterdir()} == {"400", "600", "800.orbax-checkpoint-tmp"}
    assert rows(out)[-1]["step"] == 800

    code, text, _ = cli(*arguments, "--resume")
    assert code == 0 and "resuming after 600 steps" in text
    assert_same_run(out, whole)
    assert not list((out / "checkpoints").glob("*tmp"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_saves_and_the_command_continues(
    number: int, whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch
):
    write = loggers.Jsonl.write
    monkeypatch.setattr(loggers.Jsonl, "write", lambda self, rows: (write(self, rows), signal.raise_signal(number)))
    out = tmp_path / "a b"
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", out)
    assert code == 128 + number and not (out / ".claim").exists()
    command = re.search(r"interrupted after 200 steps; saved. Continue with: pmt (.*)", text)
    assert command and [p.name for p in (out / "checkpoints").iterdir()] == ["200"]
    monkeypatch.undo()
    assert cli(*shlex.split(command[1]))[0] == 0
    assert_same_run(out, whole)


def test_a_full_disk_stops_the_run_and_nothing_saved_is_lost(whole: pathlib.Path, small_disk, cli, monkeypatch):
    monkeypatch.setattr(trainer, "CHECKPOINT_SECONDS", 0.0)
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
    """Without checkpoints and versions.json the run starts over, and what it had logged is kept."""
    before = (copy / "metrics.jsonl").read_text()
    shutil.rmtree(copy / "checkpoints")
    (copy / "versions.json").unlink()
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
    (told,) = [path for path in packed if ".env.info[" in path]
    older = {path: x for path, x in packed.items() if path != told}
    after = checkpoint.pack(checkpoint.unpack(older | {told.replace("position", "forgotten"): packed[told]}, state))
    assert after.keys() == packed.keys() and not after[told].any()
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
    code, text, _ = cli("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache", "--steps", STEPS + 200)
    assert code == 0 and "changed since the run began: jax 0.1 -> " in text
    assert f"{metrics} ends at step 800, but the checkpoint is of step 1,600: the rows between are lost" in text
    steps = [row["step"] for row in rows(copy)]
    assert steps[-1] == STEPS + 200 and 1000 not in steps


def test_fewer_steps_than_are_done_change_nothing(copy: pathlib.Path, cli):
    before = {path.name: path.read_bytes() for path in copy.glob("*.*")}
    code, text, _ = cli("train", *ARGUMENTS, "--steps", 400, "--out", copy, "--resume")
    assert code == 0 and "done: 1,600 steps" in text
    assert {path.name: path.read_bytes() for path in copy.glob("*.*")} == before


@pytest.mark.parametrize("row", ['{"step": "many"}', '{"seed": 0}', '{"step": 200, "seed": 0, "seconds": null}'])
def test_a_row_that_is_none_of_a_run(row: str, copy: pathlib.Path, cli):
    metrics = copy / "metrics.jsonl"
    metrics.write_text(before := metrics.read_text() + row + "\n")
    code, _, err = cli("train", *ARGUMENTS, "--steps", STEPS + 200, "--out", copy, "--resume")
    assert code == 2 and f"{metrics} holds a row with" in err and "delete that line" in err and err.count("\n") == 1
    assert metrics.read_text() == before and not (copy / ".claim").exists()


def test_resuming_where_another_engine_would_simulate(copy: pathlib.Path, cli):
    versions = json.loads((copy / "versions.json").read_text())
    assert versions["engine"] == "xla"
    (copy / "versions.json").write_text(json.dumps(versions | {"engine": "warp"}))
    code, _, err = cli("train", copy / "config.toml", "--out", copy, "--resume")
    assert code == 2
    assert "was simulated by engine 'warp', but physics = auto means 'xla' on this cpu" in err


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


# ---------------------------------------------------------------------------------------------------------------------
# Best and last, evaluation


def test_evaluations_during_training(whole: pathlib.Path, cli):
    table = rows(whole)
    names = [name for name in table[0] if name.startswith("eval/")]
    assert {"eval/episode_reward", "eval/episode_cost", "eval/violation_rate", "eval/info/position"} <= set(names)
    assert {f"{name}/ci95" for name in names if not name.endswith("/ci95")} <= set(names)
    for row in table:
        due = row["step"] % 400 == 0
        assert all((row[name] is not None) == due for name in names)
    text = cli("eval", whole, "--episodes", 4, "--deterministic")[1]
    for row in table[-2:]:
        assert f"{row['eval/episode_reward']:12.4f} +- {row['eval/episode_reward/ci95']:.4f}" in text


def test_the_best_is_the_best_of_the_evaluations(whole: pathlib.Path, cli):
    expected = []
    for seed in (0, 1):
        known = [row for row in rows(whole) if row["seed"] == seed and row["eval/episode_reward"] is not None]
        safe = [row for row in known if row["eval/episode_cost"] <= row["cost_limit"]]
        by_cost = min(known, key=lambda row: row["eval/episode_cost"])
        expected.append(max(safe, key=lambda row: row["eval/episode_reward"]) if safe else by_cost)
    text = cli("eval", whole, "--episodes", 4, "--deterministic", "--which", "best")[1]
    assert "mean actions of the best policy" in text
    for row in expected:
        assert f"seed {row['seed']} after {row['step']:,} steps" in text
        assert f"{row['eval/episode_reward']:12.4f} +-" in text
    assert "unknown checkpoint 'bset'; did you mean 'best'?" in cli("eval", whole, "--which", "bset")[2]


figures = st.floats(-100, 100, width=32) | st.just(float("nan"))


@given(reward=figures, cost=figures, best_reward=figures, best_cost=figures)
def test_better_is_an_order(reward: float, cost: float, best_reward: float, best_cost: float):
    def better(a: tuple[float, float], b: tuple[float, float]) -> bool:
        return bool(is_better(*np.float32([*a, *b]), limit=1.0))

    new, old = (reward, cost), (best_reward, best_cost)
    assert not better(new, new)
    assert not (better(new, old) and better(old, new))
    if not np.isnan([*new, *old]).any():
        key = [(c <= 1, r if c <= 1 else -c) for r, c in (new, old)]
        assert better(new, old) == (key[0] > key[1])
    if np.isnan(cost):
        assert not better(new, old)


def test_the_interval_is_students():
    x = np.random.default_rng(0).normal(3, 2, 7)
    mean, half = interval(x)
    low, high = scipy.stats.t.interval(0.95, 6, x.mean(), scipy.stats.sem(x))
    np.testing.assert_allclose([mean - half, mean + half], [low, high])
    assert np.isnan(interval(x[:1])[1])


# ---------------------------------------------------------------------------------------------------------------------
# Policies


def test_a_loaded_policy_is_what_was_evaluated(whole: pathlib.Path):
    run, state = load.load_run(whole)
    obs = jax.random.normal(jax.random.key(0), (5, 2, 8)) * 3
    moments, params = jax.tree.map(lambda x: x[1], (state.obs_moments, state.actor.params))
    expected = run.nets.policies(params, running_moments.normalise_obs(moments, obs))[0]
    policy = load_policy(whole, seed=1)
    np.testing.assert_allclose(jax.jit(jax.vmap(policy))(obs), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(policy(obs[2]), expected[2], rtol=1e-5, atol=1e-6)
    assert np.abs(np.asarray(load_policy(whole, seed=0)(obs[2]) - expected[2])).max() > 1e-3
    with pytest.raises(ValueError, match="has no seed 7; it has 0, 1"):
        load_policy(whole, seed=7)


def test_an_exported_policy(whole: pathlib.Path, tmp_path: pathlib.Path, cli):
    code, out, _ = cli("export", whole, "-o", tmp_path, "--seed", 1, "--which", "best")
    assert code == 0 and str(tmp_path) in out
    obs = np.asarray(jax.random.normal(jax.random.key(0), (5, 2, 8)))
    expected = jax.vmap(load_policy(whole, seed=1, which="best"))(obs)
    exported = jax.export.deserialize((tmp_path / "policy.stablehlo").read_bytes())
    np.testing.assert_allclose(exported.call(obs), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(exported.call(obs[:2]), expected[:2], rtol=1e-5, atol=1e-6)
    code = "import sys, numpy, numpy_policy; policy = numpy_policy.load('policy.npz'); assert 'jax' not in sys.modules;"
    code += "print(policy(numpy.ones((2, 8))).tolist())"
    alone = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    expected = load_policy(whole, seed=1, which="best")(jnp.ones((2, 8)))
    np.testing.assert_allclose(json.loads(alone.stdout), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    "changes",
    [
        {"method": "mappo", "layer_norm": True, "activation": "elu"},
        {"obs_norm": "layernorm", "layer_norm": True, "activation": "relu"},
        {"obs_norm": "layernorm", "layer_norm": False},
        {"obs_norm": "none", "hidden": [8, 4]},
    ],
)
def test_weights_in_numpy_for_every_kind_of_network(changes: dict, tmp_path: pathlib.Path):
    run = make_setup(load_config("lane", **{"hidden": [8], **changes}))
    noise = jax.random.normal(jax.random.key(1), (50, 8))
    moments = running_moments.accumulate(running_moments.init((8,)), 3 * noise + 1)
    params = jax.tree.map(lambda x: x + noise[0, 0], jax.jit(run.nets.init_actor)(jax.random.key(0)))
    np.savez(tmp_path / "policy.npz", **weights(run, params, moments))
    obs = 5 * jax.random.normal(jax.random.key(2), (4, 3, 2, 8))
    expected = run.nets.policies(params, run.scale(moments, obs))[0]
    np.testing.assert_allclose(numpy_policy.load(tmp_path / "policy.npz")(obs), expected, rtol=2e-5, atol=2e-5)
