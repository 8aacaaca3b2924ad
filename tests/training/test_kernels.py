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
from typing import Any

import pytest

from envs.base import Declarations
from envs.physics import kernels_of
from pmt_jax import tasks
from pmt_jax.training import compile
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
