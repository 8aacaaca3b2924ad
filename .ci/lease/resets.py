"""On a GPU: should a rollout of several seeds reset all environments in every step, or only if one has ended?

Times, by turns, rollouts under random actions with the two sides of a condition (what `envs.vector.restart` does on a
GPU) and with a loop that runs while anything has ended, of all environments of a seed at once and of an eighth.
`python resets.py --out FOLDER` writes resets.json.
"""

from __future__ import annotations

import json
import pathlib
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import envs
from envs import vector

SEEDS, ENVS, STEPS, TURNS = (2, 8, 2, 2) if "--smoke" in sys.argv else (5, 512, 32, 7)
TASKS = ("velocity_ant_2x4", "voltage_33")


def looped(share: int) -> Callable[..., Any]:
    def restart(env: Any, done: jax.Array, state: Any, key: jax.Array, _: bool) -> Any:
        return vector.restart_some(env, done, state, key, max(1, len(done) // share))

    return restart


def rollout(task: str) -> tuple[Any, Any]:
    made = vector.VectorEnv(envs.make(task), ENVS)
    shape = (STEPS, ENVS, made.spec.num_agents, made.spec.action_dim)

    def roll(state: Any, key: jax.Array) -> Any:
        actions = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
        return jax.lax.scan(lambda state, action: (made.step(state, action)[0], None), state, actions)[0]

    keys = jax.random.split(jax.random.key(0), SEEDS)
    state = jax.jit(jax.vmap(made.reset))(keys)
    return jax.jit(jax.vmap(roll)).lower(state, keys).compile(), (state, keys)


def main() -> None:
    out, found, usual = pathlib.Path(sys.argv[sys.argv.index("--out") + 1]), {}, vector.restart
    out.mkdir(parents=True, exist_ok=True)
    for task in TASKS:
        programs = {}
        for name, restart in {"condition": usual, "loop": looped(1), "loop of eighths": looped(8)}.items():
            vector.restart = restart
            program, (state, keys) = rollout(task)
            programs[name] = [program, state, keys, []]
        for _ in range(TURNS):
            for program in programs.values():
                begin = time.perf_counter()
                program[1] = jax.block_until_ready(program[0](program[1], program[2]))
                program[3].append(SEEDS * ENVS * STEPS / (time.perf_counter() - begin))
        found[task] = {name: round(float(np.median(program[3]))) for name, program in programs.items()}
        print(task, found[task], flush=True)
        (out / "resets.json").write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
