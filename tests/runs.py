"""The run that tests share: two seeds, 16 updates; what its folder holds, and its programs, compiled once."""

from __future__ import annotations

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

from pmt_jax.learning.setup import Setup
from pmt_jax.learning.types import LearnerState
from pmt_jax.output import Say
from pmt_jax.training import checkpoint, loggers
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
    """For processes that train on the CPU with the tests' compile cache."""
    return os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir),
    }


_compiled: dict[Any, tuple[LearnerState, Programs]] = {}
_evaluations: dict[Any, Callable[..., Any]] = {}


def _key(setup: Setup, *more: object) -> Any:
    """What the programs of a setup depend on; None if they are not to be shared."""
    config = setup.config
    if setup.mesh or setup.debug or pathlib.Path(config.task).suffix:  # a file may have changed
        return None
    trials = tuple(np.asarray(x).tobytes() for x in jax.tree.leaves(vars(setup.trials) if setup.trials else None))
    return repr(config.replace(init="")), repr(setup.method), trials, more


def compile_once(setup: Setup, say: Say) -> tuple[LearnerState, Programs]:
    """`compile_run`, but runs of one process share programs that are the same."""
    key = _key(setup)
    if key is None:
        return compile_run(setup, say)
    if key not in _compiled:
        _compiled[key] = compile_run(setup, say)
    else:
        say("compiled in 0.0 s (by a test before this one)")
    state, programs = _compiled[key]
    return jax.tree.map(lambda x: x.copy(), state), programs


def evaluate_once(setup: Setup, *how: object, **more: object) -> Callable[..., Any]:
    """`evaluate_seeds`, but the same function for the same evaluation, so that JAX compiles it once."""
    key = _key(setup, how, tuple(sorted(more.items())))
    if key is None:
        return evaluate_seeds(setup, *how, **more)
    return _evaluations.setdefault(key, evaluate_seeds(setup, *how, **more))
