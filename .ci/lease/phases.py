"""Wall and CPU seconds of a rollout and of an update on a CPU: phases.py DEVICES [THREADS of the engine [FOLDER]].

One seed of MAPPO-Lagrangian on ant_2x4, 256 environments x 32 steps; medians of seven. A rollout's trace goes into the
folder: `jax.profiler.ProfileData.from_file` reads it.
"""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Callable
from typing import Any

DEVICES = int(sys.argv[1])
if DEVICES > 1:
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={DEVICES}"

import jax  # noqa: E402

from pmt_jax import load_config  # noqa: E402
from pmt_jax.learning import learner, sharding  # noqa: E402
from pmt_jax.learning.setup import make_setup  # noqa: E402
from pmt_jax.learning.types import Hyper, LearnerState, Tag  # noqa: E402
from pmt_jax.training import compile as programs_of  # noqa: E402

THREADS = {"threads": int(sys.argv[2])} if len(sys.argv) > 2 else {}


def median(call: Callable[[], Any], times: int = 7) -> tuple[float, float]:
    jax.block_until_ready(call())
    taken = []
    for _ in range(times):
        wall, cpu = time.perf_counter(), time.process_time()
        jax.block_until_ready(call())
        taken.append((time.perf_counter() - wall, time.process_time() - cpu))
    return sorted(taken)[times // 2]


config = load_config("ant_2x4", env=THREADS, method="mappo_l", num_envs=256, rollout_length=32, seeds=1, log_interval=1)
mesh = sharding.make_mesh(config, DEVICES)
setup = dataclasses.replace(make_setup(config), mesh=mesh)
state, programs = programs_of.compile_run(setup, lambda _: None)
hyper, _, axes = setup.vmap_arguments


def act(hyper: Hyper, state: LearnerState) -> LearnerState:
    key = jax.random.fold_in(state.key, state.update)
    return learner._act(setup, hyper, state, {tag: jax.random.fold_in(key, tag) for tag in Tag})[0]


with sharding.use_mesh(mesh):
    placed = sharding.placement(mesh, state)
    rollout = jax.jit(programs_of._over_seeds(setup, act, axes), out_shardings=placed).lower(hyper, state).compile()
acting, whole = median(lambda: rollout(hyper, state)), median(lambda: programs.chunk(state))
print(
    f"devices {DEVICES}, {THREADS}, NPROC {os.environ.get('NPROC')}: "
    f"rollout {acting[0]:.3f} s ({acting[1]:.2f} CPU-s), update {whole[0]:.3f} s ({whole[1]:.2f} CPU-s)",
    flush=True,
)
if len(sys.argv) > 3:
    with jax.profiler.trace(sys.argv[3]):
        jax.block_until_ready(rollout(hyper, state))
os._exit(0)  # XLA's devices can wait for each other at the end
