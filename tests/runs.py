"""The run that tests share: two seeds, 16 updates; what its folder holds, and its programs, compiled once."""

from __future__ import annotations

import json
import os
import pathlib
from typing import Any

import jax
import numpy as np

from pmt_jax.learning.setup import Setup
from pmt_jax.learning.types import LearnerState
from pmt_jax.output import Say
from pmt_jax.policies import load
from pmt_jax.training import checkpoint
from pmt_jax.training.compile import Programs, compile_run

STEPS = 1600
TINY = ("--num-envs", 4, "--rollout-length", 25, "--log-interval", 2, "--hidden", 8, "--minibatches", 1)
ARGUMENTS = ("lane", *TINY, "--method", "f4sg", "--seeds", 2, "--eval-interval", 4, "--eval-episodes", 4, "--no-cache")


def rows(out: pathlib.Path) -> list[dict]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def saved(out: pathlib.Path) -> dict[str, np.ndarray]:
    """The whole content of a run's newest checkpoint: last and best."""
    states = [checkpoint.pack(load.load_run(out, which)[1]) for which in ("last", "best")]
    return {f"{i}{path}": x for i, state in enumerate(states) for path, x in state.items()}


def assert_same_run(out: pathlib.Path, other: pathlib.Path) -> None:
    ours, theirs = ([{**row, "seconds": 0} for row in rows(folder)] for folder in (out, other))
    assert ours == theirs
    first, second = saved(out), saved(other)
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[path], second[path]) for path in first)


def environment() -> dict[str, str]:
    """For processes that train on the CPU with the tests' compile cache."""
    return os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir),
    }


_compiled: dict[Any, tuple[LearnerState, Programs]] = {}


def compile_once(setup: Setup, say: Say) -> tuple[LearnerState, Programs]:
    """`compile_run`, but runs of one process share programs that are the same."""
    config = setup.config
    if setup.mesh or setup.debug or pathlib.Path(config.task).suffix:  # a file may have changed
        return compile_run(setup, say)
    trials = tuple(np.asarray(x).tobytes() for x in jax.tree.leaves(vars(setup.trials) if setup.trials else None))
    key = (repr(config.replace(steps=10**9, init="", init_fear="")), repr(setup.method), trials)
    if key not in _compiled:
        _compiled[key] = compile_run(setup, say)
    else:
        say("compiled in 0.0 s (by a test before this one)")
    state, programs = _compiled[key]
    return jax.tree.map(lambda x: x.copy(), state), programs
