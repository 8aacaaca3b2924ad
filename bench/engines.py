"""Control steps per second of the corridor ant: a plain loop over C MuJoCo against our engines.

Measurements interleave and repeat, so that other work on the machine hits all alike: compare medians and ratios.
Where other work takes a core, N threads cannot reach N times one thread; `of_plain_at_once` compares with N plain loops
that run at once, under the same conditions.

Example:
  python bench/engines.py --engines mujoco --batches 16 64 256 --repeats 7
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
from envs import ant_corridor
from envs.physics import usable_cpus


def plain_loop(steps: int) -> float:
    """Control steps/s of one thread of Python over C MuJoCo: random actions, reset where the task terminates."""
    model = ant_corridor.model()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (steps, model.nu))

    def reset() -> None:
        mujoco.mj_resetData(model, data)
        data.qpos += rng.uniform(-0.1, 0.1, model.nq)
        data.qvel[:] = 0.1 * rng.normal(size=model.nv)

    reset()
    begin = time.perf_counter()
    for action in actions:
        data.ctrl[:] = action
        mujoco.mj_step(model, data, ant_corridor.SUBSTEPS)
        mujoco.mj_rnePostConstraint(model, data)
        upright = 1 - 2 * (data.xquat[1, 1] ** 2 + data.xquat[1, 2] ** 2)
        if not (0.2 <= data.qpos[2] <= 1.0 and upright >= -0.7):
            reset()
    return steps / (time.perf_counter() - begin)


def plain_loops_at_once(threads: int, steps: int) -> float:
    """Control steps/s of `threads` plain loops together; MuJoCo releases the interpreter lock while it steps."""
    begin = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(plain_loop, [steps] * threads))
    return threads * steps / (time.perf_counter() - begin)


def env_alone(physics: str, batch: int, steps: int, **options: Any) -> Callable[[], float]:
    """Compiles jit(scan(vmap(step))) with random actions and resets; returns what measures control steps/s.

    The compile time is left on the returned function as `compile_s`.
    """
    env = envs.make("ant_2x4", physics=physics, **options)
    spec = env.spec

    def step(state, action_and_key):
        action, key = action_and_key
        after = jax.vmap(env.step)(state, action)

        def restarted(after):
            fresh = jax.vmap(env.reset)(jax.random.split(key, batch))

            def either(new, old):
                return jnp.where(after.terminated.reshape(-1, *[1] * (new.ndim - 1)), new, old)

            return jax.tree.map(either, fresh, after)

        return jax.lax.cond(after.terminated.any(), restarted, lambda after: after, after), after.reward.sum()

    shape = (steps, batch, spec.num_agents, spec.action_dim)  # drawn beforehand, as the plain loop's are
    inputs = (
        jax.random.uniform(jax.random.key(1), shape, minval=-1, maxval=1),
        jax.random.split(jax.random.key(2), steps),
    )
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), batch))
    begin = time.perf_counter()
    program = jax.jit(lambda state, inputs: jax.lax.scan(step, state, inputs)).lower(state, inputs).compile()
    compile_s = time.perf_counter() - begin
    carry = [jax.block_until_ready(program(state, inputs))[0]]

    def measure() -> float:
        begin = time.perf_counter()
        carry[0], _ = jax.block_until_ready(program(carry[0], inputs))
        return steps * batch / (time.perf_counter() - begin)

    measure.compile_s = compile_s  # pyright: ignore[reportFunctionMemberAccess]
    return measure


def compare(engines: list[str], batches: list[int], repeats: int, threads: int, seconds: float) -> list[dict[str, Any]]:
    """One row a measurement: name, median steps/s, its ratios to plain loops, compile seconds."""
    rough = {"mujoco": 4000.0 * threads, "mjx": 1000.0, "warp": 300_000.0}
    count = int(5000 * seconds)
    measures: dict[str, Callable[[], float]] = {
        "plain loop": lambda: plain_loop(count),
        "plain loops at once": lambda: plain_loops_at_once(threads, count),
    }
    for engine in engines:
        for batch in batches:
            steps = max(4, int(rough[engine] * seconds / batch))
            options = {"threads": threads} if engine == "mujoco" else {}
            measures[f"{engine} B={batch}"] = env_alone(engine, batch, steps, **options)
    found: dict[str, list[float]] = {name: [] for name in measures}
    for _ in range(repeats):
        for name, measure in measures.items():
            found[name].append(measure())
    base = threads * statistics.median(found["plain loop"])
    at_once = found["plain loops at once"]
    return [
        {
            "name": name,
            "steps_per_s": round(statistics.median(values)),
            "low": round(min(values)),
            "high": round(max(values)),
            "of_plain_x_threads": round(statistics.median(values) / base, 3),
            "of_plain_at_once": round(statistics.median(np.divide(values, at_once)), 3),
            "compile_s": round(getattr(measures[name], "compile_s", 0.0), 2),
        }
        for name, values in found.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engines", nargs="+", default=["mujoco"], help="mujoco, mjx, warp")
    parser.add_argument("--batches", nargs="+", type=int, default=[16, 64, 256])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=usable_cpus(), help="of the mujoco engine")
    parser.add_argument("--seconds", type=float, default=1.0, help="roughly, of one measurement")
    args = parser.parse_args()
    print(f"jax {jax.__version__}, mujoco {mujoco.__version__}, {jax.devices()[0].device_kind}, {args.threads} threads")
    for row in compare(args.engines, args.batches, args.repeats, args.threads, args.seconds):
        print(json.dumps(row))


if __name__ == "__main__":
    main()
