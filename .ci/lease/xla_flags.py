"""Compile seconds of training on a GPU with XLA's flags, given in XLA_FLAGS, and a warm update's: xla_flags.py."""

from __future__ import annotations

import os
import statistics
import time

import jax

from pmt_jax import load_config, make_setup
from pmt_jax.training.compile import compile_run

config = load_config("ant_2x4", method="mappo_l", num_envs=2048, rollout_length=8, seeds=1, log_interval=1)
said: list[str] = []
state, programs = compile_run(make_setup(config), said.append)
taken = []
for _ in range(12):
    begin = time.perf_counter()
    state, metrics = programs.chunk(state)
    jax.block_until_ready(metrics)
    taken.append(time.perf_counter() - begin)
print(os.environ.get("XLA_FLAGS"), said[-1], f"update {statistics.median(taken[2:]):.3f} s", flush=True)
