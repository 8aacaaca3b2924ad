"""Control steps per second of the environments alone, per engine and batch, on whatever device JAX has.

    python -m bench.engines --out bench/results/engines_h200.json
    python -m bench.engines --quick

One row per task, engine, solver and batch: a program of random actions, with resets where an episode terminates, timed
`--repeats` times; `steps_per_second` is the median over these of environment steps per second of all environments
together, `compile_seconds` what tracing and compiling took without a cache. Where `seeds` is above 1, `batch` is the
number of all environments, in a vmap of seeds over a vmap of environments.
"""

from __future__ import annotations

import argparse
import pathlib
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import envs

from . import records

Measure = Callable[[], float]
Case = tuple[str, dict[str, str], int, int, int]  # task, options, seeds, batch, steps

GPU: tuple[Case, ...] = (
    *(("ant_2x4", {"physics": "warp"}, 1, batch, 100) for batch in (1024, 4096, 16_384, 65_536)),
    ("ant_2x4", {"physics": "warp", "solver": "fast"}, 1, 16_384, 100),
    ("ant_2x4", {"physics": "warp"}, 5, 5 * 1024, 100),
    ("ant_2x4", {"physics": "warp"}, 5, 5 * 2048, 100),
    ("ant_2x4", {"physics": "mjx", "solver": "fast"}, 1, 16_384, 30),
    ("ant_2x4", {"physics": "mjx"}, 1, 4096, 20),
    *(("hand_over_2x6", {"physics": "warp"}, 1, batch, 100) for batch in (4096, 16_384)),
    ("hand_over_2x6", {"physics": "warp", "solver": "fast"}, 1, 16_384, 100),
    ("hand_over_2x6", {"physics": "mjx"}, 1, 4096, 20),
    *((task, {}, 1, batch, 240) for task in ("voltage_33", "voltage_141") for batch in (4096, 65_536)),
)
CPU: tuple[Case, ...] = (
    *(("ant_2x4", {"physics": "mujoco"}, 1, batch, 12_800 // batch) for batch in (16, 64, 256)),
    *(("ant_2x4", {"physics": "mjx", "solver": solver}, 1, 64, 20) for solver in ("converged", "fast")),
    *(("hand_over_2x6", {"physics": "mujoco"}, 1, batch, 12_800 // batch) for batch in (64, 256)),
    ("hand_over_2x6", {"physics": "mjx"}, 1, 64, 20),
    *((task, {}, 1, batch, 60) for task in ("voltage_33", "voltage_141") for batch in (64, 1024)),
)


def env_alone(batch: int, steps: int, task: str = "ant_2x4", seeds: int = 1, **options: Any) -> tuple[Measure, float]:
    """Steps/s of jit(scan(vmap(step))) with random actions, and the seconds that compiling it took.

    Args:
      batch: environments in all; seeds: how many parts an outer vmap cuts them into.
    """
    env = envs.make(task, **options)
    spec = env.spec
    step_all, reset_all = jax.vmap(env.step), jax.vmap(env.reset)
    if seeds > 1:
        step_all, reset_all = jax.vmap(step_all), jax.vmap(reset_all)

    def split(x: jax.Array) -> jax.Array:
        return x.reshape(seeds, -1, *x.shape[1:]) if seeds > 1 else x

    def step(state: Any, action_and_key: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
        action, key = action_and_key
        after = step_all(state, split(action))

        def restarted(after: Any) -> Any:
            fresh = reset_all(split(jax.random.split(key, batch)))

            def either(new: jax.Array, old: jax.Array) -> jax.Array:
                ended = after.terminated
                return jnp.where(ended.reshape(*ended.shape, *[1] * (new.ndim - ended.ndim)), new, old)

            return jax.tree.map(either, fresh, after)

        return jax.lax.cond(after.terminated.any(), restarted, lambda after: after, after), after.reward.sum()

    shape = (steps, batch, spec.num_agents, spec.action_dim)  # drawn beforehand, as the plain loop's are
    inputs = (
        jax.random.uniform(jax.random.key(1), shape, minval=-1, maxval=1),
        jax.random.split(jax.random.key(2), steps),
    )
    state = jax.jit(reset_all)(split(jax.random.split(jax.random.key(0), batch)))
    begin = time.perf_counter()
    program = jax.jit(lambda state, inputs: jax.lax.scan(step, state, inputs)[0]).lower(state, inputs).compile()
    compile_seconds = time.perf_counter() - begin
    return repeated(lambda state: program(state, inputs), state, steps * batch), compile_seconds


def repeated(program: Callable[[Any], Any], state: Any, steps: int) -> Measure:
    """Steps/s of a compiled program that goes on from where it stopped."""
    carry = [jax.block_until_ready(program(state))]

    def measure() -> float:
        begin = time.perf_counter()
        carry[0] = jax.block_until_ready(program(carry[0]))
        return steps / (time.perf_counter() - begin)

    return measure


def row(case: Case, repeats: int) -> dict[str, Any]:
    """One case measured; where it fails the row says why."""
    task, options, seeds, batch, steps = case
    found: dict[str, Any] = {"task": task, **options, "seeds": seeds, "batch": batch}
    try:
        measure, compile_seconds = env_alone(batch, steps, task, seeds, **options)
        rates = [measure() for _ in range(repeats)]
    except Exception as error:  # an engine that is missing, or a device without the memory, is a result too
        return found | {"failed": f"{type(error).__name__}: {str(error).splitlines()[0][:200]}"}
    return found | {
        "steps_per_second": round(statistics.median(rates)),
        "lowest": round(min(rates)),
        "highest": round(max(rates)),
        "compile_seconds": round(compile_seconds, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the smallest batch of each task and engine, once")
    parser.add_argument("--tasks", default="", metavar="NAMES", help="only these tasks, with commas")
    parser.add_argument("--physics", default="", metavar="ENGINE", help="only rows of this engine")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=pathlib.Path)
    arguments = parser.parse_args()
    cases = GPU if jax.devices()[0].platform == "gpu" else CPU
    chosen = [case for case in cases if not arguments.tasks or case[0] in arguments.tasks.split(",")]
    if arguments.physics:
        chosen = [case for case in chosen if case[1].get("physics") == arguments.physics]
    if arguments.quick:
        smallest = {(task, *options.values()): None for task, options, *_ in chosen}
        chosen = [next(c for c in chosen if (c[0], *c[1].values()) == key) for key in smallest]
    rows = []
    for case in chosen:
        rows.append(row(case, 1 if arguments.quick else arguments.repeats))
        print(rows[-1], file=sys.stderr, flush=True)
        if arguments.out:  # after every row: what is measured is not lost with the machine
            records.write(arguments.out, rows)


if __name__ == "__main__":
    main()
