"""A program that fails in the middle costs its chunk: the state before it is saved, and one sentence says why."""

from __future__ import annotations

import math
import pathlib
import shlex

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from envs.vector import ROUNDING, VectorEnv, out_of_range
from pmt_jax import tasks
from pmt_jax.learning.evaluation import play
from pmt_jax.training import failures, health, processes, trainer
from runs import ARGUMENTS, STEPS, TINY, assert_same_run, rows

CALLBACK = """
import dataclasses, pathlib
import jax, jax.numpy as jnp, numpy as np
from envs.toys import Lane

calls = 0

def sensor(x):
    global calls
    calls += 1
    if calls > 1000 and (pathlib.Path(__file__).parent / "offline").exists():
        raise RuntimeError("the sensor is offline")
    return np.float32(0)

class Sensor(Lane):
    def step(self, state, action):
        after = super().step(state, action)
        like = jax.ShapeDtypeStruct((), jnp.float32)
        extra = jax.pure_callback(sensor, like, after.reward, vmap_method="sequential")
        return dataclasses.replace(after, reward=after.reward + extra)
"""


@pytest.mark.full
def test_a_host_callback_that_raises_costs_one_chunk(tmp_path: pathlib.Path, cli, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sensor.py").write_text(CALLBACK)
    (tmp_path / "offline").touch()
    words = ("sensor.py", *TINY, "--log-interval", 2, "--method", "mappo", "--steps", 2000, "--no-cache", "--out")
    code, text, err = cli("train", *words, "run")
    assert code == 1 and not err and not caplog.text
    last = text.splitlines()[-1]
    assert last.startswith("stopped: a host callback raised RuntimeError: the sensor is offline (sensor.py, line 12); ")
    said, _, command = last.partition(". Continue with: pmt ")
    step = int(said.rpartition(" ")[2].replace(",", ""))
    assert f"saved as of step {step:,}" in said and 0 < step < 2000
    assert [path.name for path in (tmp_path / "run" / "checkpoints").iterdir()] == [str(step)]
    (tmp_path / "offline").unlink()
    assert cli(*shlex.split(command), "--no-cache")[0] == 0
    assert cli("train", *words, "uninterrupted")[0] == 0
    assert_same_run(tmp_path / "run", tmp_path / "uninterrupted")


@pytest.mark.parametrize(
    ("raised", "said"),
    [
        (
            jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 5 bytes.\nmore"),
            f"Out of memory allocating 5 bytes.; {failures.LESS}",
        ),
        (jax.errors.JaxRuntimeError("INTERNAL: CUDA_ERROR_LAUNCH_FAILED"), "the device failed: INTERNAL: CUDA_ERROR_"),
        (MemoryError(), f"out of memory; {failures.LESS}"),
    ],
)
@pytest.mark.parametrize("program", ["chunk", pytest.param("evaluate", marks=pytest.mark.full)])
def test_memory_and_devices(
    program: str, raised: Exception, said: str, whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch
):
    compile_run, calls = trainer.compile_run, []

    def compile_failing(*arguments: object):
        state, programs = compile_run(*arguments)
        working = getattr(programs, program)

        def fail_later(*given: object):
            calls.append(1)
            if len(calls) == 3:
                raise raised
            return working(*given)

        return state, programs._replace(**{program: fail_later})

    monkeypatch.setattr(trainer, "compile_run", compile_failing)
    out = tmp_path / "run"
    code, text, err = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", out)
    assert code == 1 and not err and f"stopped: {said}" in text and "Continue with: pmt train" in text
    monkeypatch.undo()
    assert cli("train", *ARGUMENTS, "--steps", STEPS, "--out", out, "--resume")[0] == 0
    assert_same_run(out, whole)


def test_a_device_that_returns_nothing_any_more(tmp_path: pathlib.Path, cli, monkeypatch):
    """Then the newest checkpoint is all that is left, and the sentence says so."""
    save, train_chunk = trainer.Trainer.save, trainer.Trainer.train_chunk

    def fail_at_600(self: trainer.Trainer):
        if self.step == 600:
            monkeypatch.setattr(trainer.Trainer, "save", lambda self: self.train_chunk())
            raise jax.errors.JaxRuntimeError("INTERNAL: the device is lost")
        if self.step == 400:
            save(self)
        return train_chunk(self)

    monkeypatch.setattr(trainer.Trainer, "train_chunk", fail_at_600)
    code, text, err = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "run")
    assert code == 1 and not err
    assert "stopped: the device failed: INTERNAL: the device is lost; what came after step 400 could not be" in text


@pytest.mark.full
def test_a_worker_that_fails_says_why(tmp_path: pathlib.Path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sensor.py").write_text(CALLBACK)
    (tmp_path / "offline").touch()
    words = ("sensor.py", *TINY, "--method", "mappo", "--steps", 2000, "--no-cache", "--seeds", 2, "--workers", 2)
    code, text, err = cli("train", *words, "--out", "run")
    assert code == 1 and not err
    assert "stopped: a host callback raised RuntimeError: the sensor is offline (sensor.py, line 12); saved as " in text
    assert rows(tmp_path / "run")


def test_an_evaluation_that_fails_is_one_sentence(whole: pathlib.Path, cli, monkeypatch):
    from pmt_jax.policies import evaluate

    def fail(*_: object, **__: object):
        raise jax.errors.JaxRuntimeError("INTERNAL: the device is lost")

    monkeypatch.setattr(evaluate.jax, "jit", fail)
    code, _, err = cli("eval", whole, "--episodes", 2)
    assert (code, err) == (2, "pmt: the device failed: INTERNAL: the device is lost\n")


@pytest.mark.parametrize(
    "said",
    [
        "UNKNOWN: Gloo all-reduce failed: [gloo/transport/tcp/pair.cc:538] Read error [127.0.0.1]:45252: reset by peer",
        "INTERNAL: NCCL operation ncclGroupEnd() failed: remote process exited",
        "UNAVAILABLE: Task /job:jax_worker/replica:0/task:1 heartbeat timeout",
    ],
)
@pytest.mark.parametrize("kind", [ValueError, jax.errors.JaxRuntimeError])
def test_a_process_that_is_gone_is_a_sentence_and_no_traceback(said: str, kind: type, monkeypatch: pytest.MonkeyPatch):
    """As seen with SLURM when a node was killed; a single process, or another mistake, keeps its own error."""

    def fail():
        raise kind(f"{said}\nand much more")

    monkeypatch.setattr(processes.jax, "process_count", lambda: 2)
    with pytest.raises(processes.Parted, match="another process of the run has ended or cannot be reached") as found:
        with failures.named():
            fail()
    assert "and much more" not in str(found.value)
    with pytest.raises(ValueError, match="shapes"):
        with processes.reaching_others():
            raise ValueError("shapes differ")
    monkeypatch.setattr(processes.jax, "process_count", lambda: 1)
    with pytest.raises(kind):
        with processes.reaching_others():
            fail()


# ---------------------------------------------------------------------------------------------------------------------
# Steps that break the contract of tasks: counted, reported, and costs outside [0, 1] stop the run
# `lane` has a fault at step 15 of every episode, where the check before training does not look.

FAULTY = """
import dataclasses
import jax.numpy as jnp
from envs.toys import Lane

class Faulty(Lane):
    def step(self, state, action):
        after = super().step(state, action)
        now = after.carry.time == 15
        return dataclasses.replace(after, {changed})
"""
FAULTS = {
    "lcostneg": "cost=jnp.where(now, -5.0, after.cost)",
    "lcostbig": "cost=jnp.where(now, 50.0, after.cost)",
    "lnan": "reward=jnp.where(now, jnp.nan, after.reward)",
    "linf": "reward=jnp.where(now, jnp.inf, after.reward)",
    "lcostnan": "cost=jnp.where(now, jnp.nan, after.cost)",
    "lobsnan": "obs=jnp.where(now, jnp.nan, after.obs)",
    "linfonan": "info={'position': jnp.where(now, jnp.nan, after.info['position'])}",
}
OUT_OF_RANGE = {"lcostneg": -5.0, "lcostbig": 50.0}  # and the cost that is
NOT_FINITE = ("lnan", "linf", "lcostnan", "lobsnan")


def faulty_task(folder: pathlib.Path, fault: str) -> pathlib.Path:
    """A user's file with the task of that name."""
    file = folder / f"{fault}.py"
    file.write_text(FAULTY.format(changed=FAULTS[fault]))
    return file


RUN = (*TINY, "--method", "mappo", "--steps", 400, "--seeds", 2, "--no-cache", "--episode-starts", "together")


def each_fault(*default: str):
    """A test of every fault, of some by default."""
    faults = [x if x in default else pytest.param(x, marks=pytest.mark.full) for x in FAULTS]
    return pytest.mark.parametrize("fault", faults)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.floats(-2, 3, width=32), min_size=1, max_size=6))
def test_rounding_is_no_fault(costs: list[float]):
    found = np.asarray(out_of_range(jnp.asarray(costs, jnp.float32)))
    assert found.tolist() == [not -ROUNDING <= np.float32(x) <= np.float32(1 + ROUNDING) for x in costs]
    assert not out_of_range(jnp.float32([0, 1, 1 + 1e-7, -1e-7])).any()


@each_fault("lcostbig", "lnan", "linfonan")
def test_what_one_step_of_each_kind_does(fault: str, tmp_path: pathlib.Path):
    """Only what is not finite outside of `info` ends the episode and costs; a cost out of range stays as it is."""
    vector = VectorEnv(tasks.make(str(faulty_task(tmp_path, fault))), 3)
    step = jax.jit(vector.step)
    state = vector.reset(jax.random.key(0))
    for t in range(1, 16):
        state, outcome = step(state, jnp.zeros((3, 2, 2)))
        faulty_now, not_finite = t == 15, t == 15 and fault in NOT_FINITE
        assert (np.asarray(outcome.non_finite) == not_finite).all()
        assert (np.asarray(outcome.terminated) == not_finite).all()
        assert (np.asarray(outcome.cost_out_of_range) == (faulty_now and fault in OUT_OF_RANGE)).all()
    cost = 1.0 if fault in NOT_FINITE else OUT_OF_RANGE.get(fault, 0.0)
    assert (np.asarray(outcome.cost) == cost).all()
    assert np.isfinite(outcome.reward).all() and np.isfinite(outcome.next_obs).all()


@each_fault("lnan")
def test_an_evaluation_counts_them(fault: str, tmp_path: pathlib.Path):
    found = play(tasks.make(str(faulty_task(tmp_path, fault))), lambda env, t: jnp.zeros((2, 2, 2)), 2)
    assert found["non_finite"].tolist() == [float(fault in NOT_FINITE)] * 2
    assert found["cost_out_of_range"].tolist() == [float(fault in OUT_OF_RANGE)] * 2
    assert found["episode_length"].tolist() == [15 if fault in NOT_FINITE else 25] * 2
    assert np.isnan(found["info/position"]).all() == (fault == "linfonan")


@pytest.mark.parametrize(
    "fault",
    [pytest.param(x, marks=pytest.mark.full if x == "lcostbig" else pytest.mark.slow) for x in OUT_OF_RANGE],
)
def test_costs_out_of_range_stop_the_run(fault: str, tmp_path: pathlib.Path, cli):
    file, out, worst = faulty_task(tmp_path, fault), tmp_path / "run", OUT_OF_RANGE[fault]
    code, text, err = cli("train", file, *RUN, "--log-interval", 1, "--out", out)
    assert code == 1 and not err
    assert (
        "stopped: 4 of the 100 environment steps of seed 1 up to step 100 had a cost outside [0, 1], the worst "
        f"{worst:g}; scale or clip the costs of task 'lane'" in text
    )
    assert "note: 8 of 200 steps had a cost outside [0, 1]" in text
    assert [(row["cost_out_of_range"], row["worst_cost"]) for row in rows(out)] == [(4, worst)] * 2
    assert all("cost outside [0, 1]" in row["broken"] for row in rows(out))


@pytest.mark.full
def test_a_long_row_does_not_hide_a_run_that_is_lost(tmp_path: pathlib.Path, cli):
    """No update of the rest of the row could matter."""
    file, out = faulty_task(tmp_path, "lcostbig"), tmp_path / "run"
    code, text, _ = cli("train", file, *RUN, "--steps", 10**9, "--log-interval", 10**6, "--out", out)
    assert code == 1 and "of seed 0 up to step 100 had a cost outside [0, 1], the worst 50" in text


@pytest.mark.parametrize(
    "fault", [pytest.param(x, marks=pytest.mark.full if x == "lnan" else pytest.mark.slow) for x in NOT_FINITE]
)
def test_steps_that_are_not_finite_are_reported_everywhere(fault: str, tmp_path: pathlib.Path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file, out = faulty_task(tmp_path, fault), tmp_path / "run"
    code, text, _ = cli("train", file, *RUN, "--eval-interval", 4, "--eval-episodes", 3, "--out", out)
    count = sum(row["non_finite"] for row in rows(out))
    what = "were not finite: reward 0, cost 1, end of the episode"
    assert code == 0 and count > 0
    said = f"{count} of 800 steps {what}; 6 of 90 steps in evaluations {what}. Check the task's observations"
    assert f"note: {said}" in text
    assert [row["eval/non_finite"] for row in rows(out)[-2:]] == [1.0, 1.0]
    code, text, _ = cli("table", out)
    assert code == 0 and f"mappo on lane: {said}" in text
    code, text, _ = cli("eval", out, "--episodes", 2)
    assert code == 0 and text.count(f"note: 2 of 30 steps {what}") == 2 and "non_finite" not in text
    code, text, _ = cli("report", out, "--episodes", 2, "-o", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert code == 0 and f"{count} of 800 steps {what}" in page and f"2 of 30 steps {what}" in page
    code, text, _ = cli("train", file, *RUN, "--eval-interval", 4, "--eval-episodes", 3, "--out", out, "--resume")
    assert code == 0 and f"note: {said}" in text  # the rows of both sessions count


@pytest.mark.full
def test_what_is_only_logged_changes_nothing_else(tmp_path: pathlib.Path, cli):
    out = tmp_path / "run"
    code, text, _ = cli("train", faulty_task(tmp_path, "linfonan"), *RUN, "--out", out)
    assert code == 0 and "note:" not in text
    for row in rows(out):
        assert (row["non_finite"], row["terminations"], row["episode_length"]) == (0, 0, 25)
        assert row["info/position"] is None


@pytest.mark.full
def test_a_task_that_keeps_the_contract_is_not_accused(whole: pathlib.Path, cli):
    assert all(row["non_finite"] == row["cost_out_of_range"] == 0 and row["worst_cost"] is None for row in rows(whole))
    assert "steps were not finite" not in cli("table", whole)[1] and "note:" not in cli("eval", whole)[1]


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.integers(0, 9), min_size=1, max_size=4), st.lists(st.integers(0, 9), min_size=1, max_size=4))
def test_counts_are_sums_and_unknown_values_count_nothing(broke: list[int], evaluated: list[int]):
    metrics = {
        "non_finite": [*broke, math.nan],
        "eval/cost_out_of_range": [*evaluated, None],
        "eval/episode_length": [5],
    }
    found = health.count_faults(metrics, 2)
    assert found["non_finite"] == sum(broke) and found["eval/cost_out_of_range"] == 2 * sum(evaluated)
    sentence = health.faults(found, 100)
    assert (f"{sum(broke)} of 100 steps were not finite" in sentence) == (sum(broke) > 0)
    assert (f"{2 * sum(evaluated)} of 10 steps in evaluations had a cost" in sentence) == (sum(evaluated) > 0)


def test_an_evaluation_with_costs_out_of_range_stops_the_seed():
    class Setup:
        trials = None

    row = {"seed": 3, "step": 100, "task": "lane", "eval/cost_out_of_range": 2.5}
    said = health.diagnose_evaluation(Setup(), row)  # pyright: ignore[reportArgumentType]
    assert said and said.startswith(
        "2.5 steps an episode in the evaluation of seed 3 at step 100 had a cost outside [0"
    )
    for unknown in (0.0, math.nan):
        assert health.diagnose_evaluation(Setup(), row | {"eval/cost_out_of_range": unknown}) is None  # pyright: ignore[reportArgumentType]
