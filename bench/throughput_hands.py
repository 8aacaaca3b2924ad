"""Control steps per second of the two hands, as `bench.throughput` has them for the ant; and what MJX takes to compile.

The plain loop steps the same model as the `mujoco` engine (ellipsoid egg, converged solver); `mjx` has the capsule.
Where other work shares the machine, steps per CPU-second of this process say more than steps per second.

python -m bench.throughput_hands --out bench/results/hand_over.json
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import argparse
import json
import os
import pathlib
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
from bench.throughput import Measure, at_once, conditions, env_alone, interleaved
from envs import hand_over
from envs.physics import usable_cpus

TASK = "hand_over_2x6"
BATCHES = (64, 256)
ROUGH = {"mujoco": 10_000.0, "mjx": 1_500.0}  # steps/s of one CPU
TARGETS = {
    "mujoco, per CPU-second, of the plain loop": 0.85,
    "mjx steps per CPU-second": 1400.0,
    "mjx compile, CPU-s": 25.0,
}


def plain_loop(steps: int) -> float:
    """Control steps/s of one thread of Python over C MuJoCo: random actions, reset where the object falls."""
    model = hand_over.model()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    low, high = model.actuator_ctrlrange.T
    targets = rng.uniform(low, high, (steps, model.nu))
    joints = model.jnt_range[: hand_over.JOINTS]

    def reset() -> None:
        mujoco.mj_resetData(model, data)
        pose = joints[:, 0] + (joints[:, 1] - joints[:, 0]) * rng.uniform(-1, 1, hand_over.JOINTS)
        data.qpos[: hand_over.HINGES] = hand_over.RESET_SPREAD * np.tile(pose, hand_over.HANDS)

    reset()
    begin = time.perf_counter()
    for target in targets:
        data.ctrl[:] = target
        mujoco.mj_step(model, data, hand_over.SUBSTEPS)
        if not data.qpos[hand_over.HINGES + 2] > hand_over.FALLEN:
            reset()
    return steps / (time.perf_counter() - begin)


def compile_seconds() -> dict[str, float]:
    """CPU-seconds to trace and to compile a step of 64 environments on `mjx`, without the compile cache."""
    jax.config.update("jax_enable_compilation_cache", False)
    env = envs.make(TASK, physics="mjx")
    shape = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), BATCHES[0]))
    action = jax.ShapeDtypeStruct((BATCHES[0], *env.spec.action_mask.shape), jnp.float32)
    begin = time.process_time()
    lowered = jax.jit(jax.vmap(env.step)).lower(shape, action)
    traced = time.process_time()
    lowered.compile()
    done = time.process_time()
    jax.config.update("jax_enable_compilation_cache", True)
    return {"trace": round(traced - begin, 1), "compile": round(done - traced, 1)}


def per_cpu_second(measure: Measure, found: list[float]) -> Measure:
    """The same measurement, which also notes steps per CPU-second in `found`."""

    def measured() -> float:
        wall, cpu = time.perf_counter(), time.process_time()
        rate = measure()
        found.append(rate * (time.perf_counter() - wall) / (time.process_time() - cpu))
        return rate

    return measured


def rates(args: argparse.Namespace) -> list[dict[str, Any]]:
    threads, count = usable_cpus(), int(ROUGH["mujoco"] * args.seconds)
    measures: dict[str, Measure] = {
        "plain loop": lambda: plain_loop(count),
        "plain loops at once": lambda: at_once(plain_loop, threads, count),
    }
    for engine, rough in ROUGH.items():
        for batch in BATCHES:
            steps = max(2, int(rough * args.seconds / batch))
            measures[f"{engine} B={batch}"] = env_alone(batch, steps, TASK, physics=engine)
    of_cpu: dict[str, list[float]] = {name: [] for name in measures}
    watched = {name: per_cpu_second(measure, of_cpu[name]) for name, measure in measures.items()}
    rows = interleaved(watched, args.repeats, args.patience)
    return [{**row, "per_cpu_second": round(statistics.median(of_cpu[row["name"]]))} for row in rows]


def verdict(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Each target beside what was found."""
    found = [("mjx compile, CPU-s", report["mjx_cpu_s"]["compile"], False)]
    plain = next(row["per_cpu_second"] for row in report["rates"] if row["name"] == "plain loop")
    for row in report["rates"]:
        if row["name"].startswith("mujoco"):
            share = round(row["per_cpu_second"] / plain, 3)
            found.append(("mujoco, per CPU-second, of the plain loop", share, True))
        elif row["name"].startswith("mjx"):
            found.append(("mjx steps per CPU-second", row["per_cpu_second"], True))
    return [
        {
            "what": what,
            "target": TARGETS[what],
            "found": value,
            "met": value >= TARGETS[what] if more else value <= TARGETS[what],
        }
        for what, value, more in found
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, help="a JSON file for the report")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.5, help="roughly, of one measurement")
    parser.add_argument("--patience", type=float, default=20.0, help="s to wait for other work before a measurement")
    args = parser.parse_args()
    report = conditions(args)
    report["mjx_cpu_s"] = compile_seconds()
    report["rates"] = rates(args)
    report["load_average"]["end"] = os.getloadavg()
    report["targets"] = verdict(report)
    for row in [*report["rates"], *report["targets"]]:
        print(json.dumps(row))
    if args.out is not None:
        args.out.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
