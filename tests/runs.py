"""The run that tests share: two seeds, 16 updates; what its folder holds, and its programs, compiled once."""

from __future__ import annotations

import functools
import json
import os
import pathlib
import signal
import warnings
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest

from pmt_jax import numerics
from pmt_jax.config.settings import HYPER_FIELDS, Config
from pmt_jax.learning import learner
from pmt_jax.learning.setup import Setup
from pmt_jax.learning.types import LearnerState
from pmt_jax.output import Say
from pmt_jax.training import checkpoint, compile, loggers
from pmt_jax.training.compile import Programs, compile_run, evaluate_seeds

STEPS = 1600
TINY = ("--num-envs", 4, "--rollout-length", 25, "--log-interval", 2, "--hidden", 8, "--minibatches", 1)
ARGUMENTS = ("lane", *TINY, "--method", "f4sg", "--seeds", 2, "--eval-interval", 4, "--eval-episodes", 4, "--no-cache")


def rows(out: pathlib.Path) -> list[dict]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def saved(out: pathlib.Path) -> dict[str, np.ndarray]:
    """The whole content of a run's newest checkpoint: `['last']` and `['best']`."""
    return checkpoint.newest(out, warnings.warn).packed


def assert_same_run(out: pathlib.Path, other: pathlib.Path) -> None:
    ours, theirs = ([{**row, "seconds": 0} for row in rows(folder)] for folder in (out, other))
    assert ours == theirs
    first, second = saved(out), saved(other)
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[path], second[path]) for path in first)


def stop_after_rows(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Runs of this process get the signal as soon as they have written rows."""
    write = loggers.Jsonl.write
    monkeypatch.setattr(loggers.Jsonl, "write", lambda self, rows: (write(self, rows), signal.raise_signal(number)))


def environment() -> dict[str, str]:
    """For processes that train on the CPU."""
    return os.environ | {"JAX_PLATFORMS": "cpu"}


_compiled: dict[Any, tuple[LearnerState, Programs]] = {}
_of_other_numbers: dict[Any, tuple[Callable[..., LearnerState], Programs]] = {}
_evaluations: dict[Any, Callable[..., Any]] = {}


def _sources(name: str) -> tuple[tuple[pathlib.Path, bytes], ...]:
    """The modules next to the one that a task or method `FILE.py` or `FILE.py:NAME` names: any of them may change."""
    file, python, _ = name.partition(".py")
    modules = sorted(pathlib.Path(file).parent.glob("*.py")) if python else ()
    return tuple((x.resolve(), x.read_bytes()) for x in modules)


def _length(setup: Setup) -> int:
    """What of the number of steps the program of a chunk depends on: the step of a multiplier, and rates that fall."""
    config = setup.config
    adds_up = setup.method.constraint in ("lagrangian", "pid") and not setup.method.letter and config.lambda_lr != 0
    return config.steps if setup.trials or adds_up or config.lr_end != 1 else 0


def _structure(setup: Setup, *more: object, **changes: Any) -> Any:
    """What is static in the programs of a setup, with these `changes` of its settings."""
    settings = repr(setup.config.replace(init="", steps=setup.config.batch_size, **changes)), repr(numerics.record())
    return settings, _sources(setup.config.method) or repr(setup.method), _sources(setup.config.task), more


def _key(setup: Setup, *more: object) -> Any:
    """What the programs of a setup depend on, but for their number of steps; None if they are not to be shared."""
    if setup.mesh or setup.debug:
        return None
    trials = tuple(np.asarray(x).tobytes() for x in jax.tree.leaves(vars(setup.trials) if setup.trials else None))
    return _structure(setup, trials, *more)


def compile_once(setup: Setup, say: Say) -> tuple[LearnerState, Programs]:
    """`compile_run`, but runs of one process share programs that are the same."""
    key = _key(setup, _length(setup))
    if key is None:
        return compile_run(setup, say)
    if key not in _compiled:
        _compiled[key] = _with_its_numbers(setup, say)
    else:
        say("compiled in 0.0 s (by a test before this one)")
    state, programs = _compiled[key]
    return jax.tree.map(lambda x: x.copy(), state), programs


def _with_its_numbers(setup: Setup, say: Say) -> tuple[LearnerState, Programs]:
    """`compile_run`, but a run takes the program of another one that only has other numbers.

    Numbers that are traced, and seeds, are arguments of that program; evaluations have them as constants.
    """
    hyper, keys, axes = setup.vmap_arguments
    shapes = tuple(np.shape(x) for x in jax.tree.leaves((hyper, keys)))
    usual = {name: getattr(Config, name) for name in (*HYPER_FIELDS, "seed")}
    key = _structure(setup, shapes, _length(setup), setup.trials is None, **usual)
    if key not in _of_other_numbers:
        state, programs = compile_run(setup, say)
        init = jax.jit(compile._over_seeds(setup, functools.partial(learner.init, setup), axes))
        _of_other_numbers[key] = init, programs
        return state, programs
    say("compiled in 0.0 s (by a test before this one, with other numbers)")
    init, programs = _of_other_numbers[key]
    state = init(hyper, keys)
    program = programs.chunk.args[0]  # pyright: ignore[reportFunctionMemberAccess]
    chunk = functools.partial(compile._run_chunk, program, hyper)
    programs = programs._replace(chunk=chunk, final=compile._final(setup))
    if setup.config.eval_interval:
        evaluation = evaluate_once(setup, setup.config.eval_episodes, deterministic=True)
        programs = programs._replace(evaluate=jax.jit(evaluation).lower(state).compile())
    return state, programs


def evaluate_once(setup: Setup, *how: object, **more: object) -> Callable[..., Any]:
    """`evaluate_seeds`, but the same function for the same evaluation, so that JAX compiles it once."""
    key = _key(setup, how, tuple(sorted(more.items())))
    if key is None:
        return evaluate_seeds(setup, *how, **more)
    return _evaluations.setdefault(key, evaluate_seeds(setup, *how, **more))
