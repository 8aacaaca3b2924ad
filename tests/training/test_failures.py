"""A program that fails in the middle costs its chunk: the state before it is saved, and one sentence says why."""

from __future__ import annotations

import pathlib
import shlex

import jax
import pytest

from pmt_jax.training import failures, processes, trainer
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
