"""Kernels of the physics compile in parallel with XLA's program, before the first update; Warp's lines stay away."""

from __future__ import annotations

import json
import logging
import os
import pathlib
import subprocess
import sys
import threading
import types
from types import SimpleNamespace
from typing import Any

import jax
import pytest

from envs.base import Declarations
from envs.physics import kernels_of
from pmt_jax import tasks
from pmt_jax.training import compile, trainer
from runs import ARGUMENTS, STEPS, environment


def test_kernels_compile_beside_what_is_inside_and_before_it_ends(monkeypatch):
    monkeypatch.setattr(compile, "KERNEL_LINES", 0.0)
    begun, said, threads = threading.Event(), [], set()

    def kernel() -> None:
        begun.set()
        threads.add(threading.get_ident())

    with compile.compiling([kernel] * 5, said.append):
        assert begun.wait(60)
    assert said[:4] == [f"compiling kernels: {count} of 5 ..." for count in (1, 2, 3, 4)]
    assert said[4].startswith("5 kernels ready after ") and len(said) == 5
    assert threading.get_ident() not in threads


def test_a_kernel_that_fails_is_left_to_its_launch():
    said = []
    with compile.compiling([lambda: 1 / 0], said.append):
        pass
    assert said[0].startswith("1 kernels ready")


def test_what_fails_inside_leaves_kernels_uncompiled(monkeypatch):
    monkeypatch.setattr(compile, "KERNEL_THREADS", 1)
    running, free, compiled = threading.Event(), threading.Event(), []

    def first() -> None:
        running.set()
        assert free.wait(60)

    with pytest.raises(ZeroDivisionError), compile.compiling([first, lambda: compiled.append(1)], lambda _: None):
        assert running.wait(60)
        threading.Timer(0.2, free.set).start()
        raise ZeroDivisionError
    assert not compiled


def test_only_warp_has_kernels(cli, tmp_path):
    for env in tasks.make("lane"), tasks.make("ant_2x4", "mujoco"):
        assert not tasks.declarations(env).kernels()
    code, text, _ = cli("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "run")
    assert code == 0 and " kernels ready" not in text


def test_a_task_needs_the_kernels_of_all_its_engines():
    def engine(*kernels: int) -> Any:
        return types.SimpleNamespace(kernels=lambda: kernels)

    assert kernels_of(engine(1, 2), object(), engine(3)) == [1, 2, 3]  # the second has none, as all but warp


@pytest.mark.full
def test_training_starts_without_warps_private_places(cli, tmp_path, monkeypatch):
    def missing() -> list:
        raise AttributeError("no Module")

    monkeypatch.setattr(tasks, "declarations", lambda env: Declarations(kernels=missing))
    quick = ("--method", "mappo", "--eval-interval", 0)
    arguments = [*ARGUMENTS[:-1], *quick, "--hidden", 7, "--no-cache"]  # nothing compiled before
    code, text, _ = cli("train", *arguments, "--steps", 200, "--out", tmp_path / "run")
    assert code == 0 and "the first update compiles the physics' kernels: no Module" in text


def test_verbose_asks_for_what_warp_prints(cli, tmp_path, monkeypatch):
    logger = logging.getLogger("envs")
    monkeypatch.setattr(logger, "level", logging.NOTSET)
    assert cli("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "run", "--verbose")[0] == 0
    assert logger.isEnabledFor(logging.INFO)


RECORDED = """
import json, sys
import jax, jax.numpy as jnp
import envs
from envs.physics import contract
contract.obstacle = lambda name: None  # on a CPU warp steps, so slowly that nobody is offered it
env = envs.make(sys.argv[1], physics="warp")
kernels = env.declares.kernels()
for kernel in kernels:
    kernel()
from warp._src.context import Module
compile_now, late = Module._compile, []
Module._compile = lambda self, *rest, **named: (late.append(self.name), compile_now(self, *rest, **named))[1]
state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2))
action = jnp.zeros((2, env.spec.num_agents, env.spec.action_dim))
jax.block_until_ready(jax.jit(jax.vmap(env.step))(state, action))
print(json.dumps([len(kernels), late]))
"""


@pytest.mark.full
@pytest.mark.parametrize("task", ["ant_2x4", "hand_over_2x6"])
def test_a_recorded_step_compiles_nothing_and_prints_nothing(task: str, tmp_path: pathlib.Path):
    pytest.importorskip("warp")
    where = environment() | {"WARP_CACHE_PATH": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", RECORDED, task]
    done = subprocess.run(command, env=where, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    assert "Module" not in done.stdout
    count, late = json.loads(done.stdout.splitlines()[-1])
    assert count > 20 and set(late) <= {"envs.physics.warp_engine"}  # which has none, and is read while tracing


# ---------------------------------------------------------------------------------------------------------------------
# Runs that cannot fit, and where compiled programs are kept


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (("--num-envs", "1e4"), "a batch of num_envs * rollout_length = 10000 * 25 steps needs at least"),
        (("--hidden", "10000,10000"), "networks with hidden = [10000, 10000] needs at least"),
        (("--seeds", "1e6"), "for 1000000 seed(s), but there are 0 GB here; ask for less"),
    ],
)
def test_what_cannot_fit_is_refused(flags, says, cli, monkeypatch, tmp_path: pathlib.Path):
    monkeypatch.setattr(compile, "device_memory", lambda: 10e6)
    code, _, err = cli("train", "lane", "--steps", "1e6", *flags, "--out", tmp_path / "x")
    assert code == 2 and says in err and err.count("\n") == 1
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    "message", ["RESOURCE_EXHAUSTED: Out of memory while trying to allocate 5.71GiB", "INTERNAL: x"]
)
def test_a_device_without_room_gets_a_sentence(message: str, cli, monkeypatch, tmp_path: pathlib.Path):
    """A GPU that other programs share may have no room left although the run alone would fit."""

    def full(*_: object, **__: object) -> None:
        raise jax.errors.JaxRuntimeError(message)

    monkeypatch.setattr(trainer.Trainer, "train", full)
    arguments = ("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "x")
    if message.startswith("INTERNAL"):
        with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
            cli(*arguments)
        return
    code, _, err = cli(*arguments)
    assert code == 2 and err.count("\n") == 1
    assert err.startswith("pmt: Out of memory while trying to allocate 5.71GiB; other programs may share the device")


@pytest.mark.parametrize(
    ("backend", "flags", "options"),
    [
        ("cpu", "", None),
        ("gpu", "", {"xla_gpu_autotune_level": "0"}),
        ("gpu", "--xla_gpu_autotune_level=4", None),
    ],
)
def test_xla_tries_out_no_kernels_on_a_gpu(backend: str, flags: str, options: Any, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setenv("XLA_FLAGS", flags)
    assert compile.xla_options() == options
    assert jax.jit(lambda x: x + 1).lower(1).compile(options)(1) == 2  # the name is one that XLA knows


def test_a_cache_that_cannot_be_written_is_said_once_and_left_off(monkeypatch, capsys, tmp_path: pathlib.Path):
    config = SimpleNamespace(jax_compilation_cache_dir=None)
    monkeypatch.setattr(compile, "jax", SimpleNamespace(config=config))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compile.os, "access", lambda path, mode: False)
    compile.use_cache()  # which would update the configuration
    said = capsys.readouterr().err
    assert said == f"compiled programs are not kept, for {tmp_path / 'pmt-jax'} cannot be written; {compile.ANEW}\n"


@pytest.mark.parametrize("chosen", ["", "relative", None])
def test_a_cache_home_that_does_not_count(chosen: str | None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(compile, "jax", SimpleNamespace(config=None))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if chosen is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", chosen)
    assert compile.cache_folder() == pathlib.Path.home() / ".cache" / "pmt-jax"
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert compile.cache_folder() == pathlib.Path("/somewhere/pmt-jax")
