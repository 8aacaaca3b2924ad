"""GPU: where the time of one integration step of the ant goes, kernel by kernel, without XLA."""

# warp and mujoco are not installed everywhere, and have no stubs:
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
from __future__ import annotations

import collections
import re
import statistics
import time
from typing import Any

import numpy as np

from envs.ant.walls import model
from envs.physics.warp_engine import WarpEngine

from .cases import Case
from .records import Record

WARM, REPEATS, TURNS = 20, 40, 5
SLOWEST = 12  # kernels in a row


def substep(case: Case) -> Record:
    """Seconds of a step in a captured graph, also with a solver of one iteration, and its kernels one by one.

    The graph runs its kernels back to back. Timed one by one they take longer, so these times only rank them.
    """
    import warp
    from mujoco.mjx.third_party import mujoco_warp

    physics, data = _worlds(case.num_envs)
    whole = _graph_seconds(physics, data)
    iterations = data.solver_niter.numpy()
    once, once_data = _worlds(case.num_envs)
    once.opt.iterations = 1
    short = _graph_seconds(once, once_data)
    warp.timing_begin(cuda_filter=warp.TIMING_KERNEL | warp.TIMING_MEMCPY | warp.TIMING_MEMSET)
    mujoco_warp.step(physics, data)
    return {
        "substep_seconds": whole,
        "one_iteration_seconds": short,
        "iterations_mean": float(iterations.mean()),
        "iterations_most": int(iterations.max()),
        **kernels([(result.name, result.elapsed) for result in warp.timing_end()]),
    }


def kernels(launches: list[tuple[str, float]]) -> Record:
    """How many launches there were, and for the slowest kernels: name, launches, milliseconds of all of them."""
    found: dict[str, list[float]] = collections.defaultdict(list)
    for name, milliseconds in launches:
        kernel = re.sub("_[0-9a-f]{8}$", "", name.removeprefix("forward kernel ").partition("__locals__")[0])
        found[kernel].append(milliseconds)
    ranked = sorted(found.items(), key=lambda item: -sum(item[1]))[:SLOWEST]
    return {"launches": len(launches), "slowest": [[name, len(x), round(sum(x), 4)] for name, x in ranked]}


def _worlds(count: int) -> tuple[Any, Any]:
    """The engine's model and data of so many ants, in the air and on the ground, with random controls."""
    ant = model()
    physics, data = WarpEngine(ant, 1, {}).worlds(count)
    draw = np.random.default_rng(0)
    qpos = np.tile(ant.qpos0, (count, 1))
    qpos[:, 2] = draw.uniform(0.3, 0.8, count)
    data.qpos.assign((qpos + draw.uniform(-0.1, 0.1, qpos.shape)).astype(np.float32))
    data.ctrl.assign(draw.uniform(-1, 1, (count, ant.nu)).astype(np.float32))
    return physics, data


def _graph_seconds(physics: Any, data: Any) -> float:
    """Median seconds of a step that is one graph; the worlds move on."""
    import warp
    from mujoco.mjx.third_party import mujoco_warp

    mujoco_warp.step(physics, data)  # compiles
    with warp.ScopedCapture() as captured:
        mujoco_warp.step(physics, data)
    turns = []
    for repeats in (WARM, *[REPEATS] * TURNS):
        warp.synchronize()
        begin = time.perf_counter()
        for _ in range(repeats):
            warp.capture_launch(captured.graph)
        warp.synchronize()
        turns.append((time.perf_counter() - begin) / repeats)
    return statistics.median(turns[1:])
