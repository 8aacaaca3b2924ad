"""Control steps per second of ant or hands: plain loops over C MuJoCo, our environment alone, the whole training.

Measurements interleave and repeat, so that other work on the machine hits all alike; each waits a while for the other
work to pause and notes how much of the machine it took. Compare medians and ratios. `of_plain_x_threads` compares with
a plain loop on one thread, times the threads; `of_plain_at_once` with as many plain loops at once, which also share
memory and clock. Where other work shares the machine, steps per CPU-second of this process say more than steps per
second. The plain loop takes the model as it is; our C engine skips MuJoCo's search for islands in it, which changes no
bit and is worth 6 % on the ant. Hands: the egg is an ellipsoid on `mujoco`, a capsule on `mjx`.

python -m bench.throughput ant_2x4 --out bench/results/throughput.json
python -m bench.throughput hand_over_2x6 --out bench/results/hand_over.json
python -m bench.throughput ant_2x4 --quick
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import pathlib
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import psutil

import envs
from envs.ant import corridor
from envs.hands import hand_over
from envs.physics import usable_cpus
from pmt_jax import load_config
from pmt_jax.learning import learner
from pmt_jax.learning.setup import make_setup

from . import records
from .engines import Measure, env_alone, repeated
from .records import Rows

Head = dict[str, Any]  # what a row is about


@dataclasses.dataclass(frozen=True)
class Plain:
    """What a plain loop needs of a task.

    Attributes:
      model: as the `mujoco` engine has it; substeps: physics steps in a control step.
      reset: puts MjData where an episode begins; over: does what follows the physics, says whether the episode ended.
    """

    model: mujoco.MjModel
    substeps: int
    reset: Callable[[mujoco.MjData, np.random.Generator], None]
    over: Callable[[mujoco.MjModel, mujoco.MjData], bool]


def _reset_ant(data: mujoco.MjData, rng: np.random.Generator) -> None:
    data.qpos += rng.uniform(-0.1, 0.1, len(data.qpos))
    data.qvel[:] = 0.1 * rng.normal(size=len(data.qvel))


def _ant_over(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    mujoco.mj_rnePostConstraint(model, data)
    upright = 1 - 2 * (data.xquat[1, 1] ** 2 + data.xquat[1, 2] ** 2)
    return not (0.2 <= data.qpos[2] <= 1.0 and upright >= -0.7)


def _reset_hands(data: mujoco.MjData, rng: np.random.Generator) -> None:
    joints = data.model.jnt_range[: hand_over.JOINTS]
    pose = joints[:, 0] + (joints[:, 1] - joints[:, 0]) * rng.uniform(-1, 1, hand_over.JOINTS)
    data.qpos[: hand_over.HINGES] = hand_over.RESET_SPREAD * np.tile(pose, hand_over.HANDS)


def _hands_over(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    return not data.qpos[hand_over.HINGES + 2] > hand_over.FALLEN


class Engine(NamedTuple):
    """An engine by name, its options, and roughly the steps/s of the environment alone on one CPU."""

    name: str
    options: Head
    rough: float


@dataclasses.dataclass(frozen=True)
class Subject:
    """What is measured of a task.

    Attributes:
      plain: makes what the plain loop needs.
      engines: those that the environment alone runs on; `--quick` takes the first.
      batches: environments side by side; `--quick` takes the first two.
      training: roughly the steps/s of training on one CPU; None where it is not measured.
    """

    plain: Callable[[], Plain]
    engines: tuple[Engine, ...]
    batches: tuple[int, ...]
    training: float | None = None


SUBJECTS = {
    "ant_2x4": Subject(
        lambda: Plain(corridor.model(), corridor.SUBSTEPS, _reset_ant, _ant_over),
        (
            Engine("mujoco", {}, 5000.0),
            Engine("mjx", {"solver": "fast"}, 1000.0),
            Engine("mjx", {"solver": "converged"}, 500.0),
        ),
        (16, 64, 256),
        training=4000.0,
    ),
    "hand_over_2x6": Subject(
        lambda: Plain(hand_over.model(), hand_over.SUBSTEPS, _reset_hands, _hands_over),
        (Engine("mujoco", {}, 10_000.0), Engine("mjx", {}, 1500.0)),
        (64, 256),
    ),
}


def plain_loop(plain: Plain, steps: int) -> float:
    """Control steps/s of one thread of Python over C MuJoCo: random actions, reset where the task terminates."""
    model, data, rng = plain.model, mujoco.MjData(plain.model), np.random.default_rng(0)
    low, high = model.actuator_ctrlrange.T
    actions = rng.uniform(low, high, (steps, model.nu))

    def reset() -> None:
        mujoco.mj_resetData(model, data)
        plain.reset(data, rng)

    reset()
    begin = time.perf_counter()
    for action in actions:
        data.ctrl[:] = action
        mujoco.mj_step(model, data, plain.substeps)
        if plain.over(model, data):
            reset()
    return steps / (time.perf_counter() - begin)


def at_once(loop: Callable[[int], float], threads: int, steps: int) -> float:
    """Control steps/s of `threads` plain loops together; MuJoCo releases the interpreter lock while it steps."""
    begin = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(loop, [steps] * threads))
    return threads * steps / (time.perf_counter() - begin)


def training(task: str, batch: int, steps: int) -> Measure:
    """The MAPPO-Lagrangian training loop on the task's own settings, as `pmt train` compiles it."""
    run = make_setup(load_config(task, method="mappo_l", num_envs=batch, physics="mujoco"))
    updates = max(1, steps // run.config.rollout_length)

    def chunk(hyper, state):
        return learner.train_chunk(run, hyper, state, updates)[0]

    keys = jax.vmap(jax.random.key)(jnp.arange(1))
    state = jax.jit(jax.vmap(functools.partial(learner.init, run), (None, 0)))(run.hyper, keys)
    program = jax.jit(jax.vmap(chunk, (None, 0)), donate_argnums=1)
    return repeated(functools.partial(program, run.hyper), state, updates * run.config.batch_size)


# ---------------------------------------------------------------------------------------------------------------------
# Measuring side by side


def rates(task: str, quick: bool, repeats: int, seconds: float, patience: float) -> Rows:
    """One row for each thing measured: median steps/s, ratios to the plain loops, what other work took meanwhile."""
    subject, threads = SUBJECTS[task], usable_cpus()
    engines, batches = (subject.engines[:1], subject.batches[:2]) if quick else (subject.engines, subject.batches)
    loop = functools.partial(plain_loop, subject.plain())
    count = int(engines[0].rough * seconds)
    measures: list[tuple[Head, Measure]] = [
        ({"what": "plain loop"}, lambda: loop(count)),
        ({"what": "plain loops at once"}, lambda: at_once(loop, threads, count)),
    ]
    for name, options, rough in engines:
        for batch in batches:
            steps = max(2, int(rough * (threads if name == "mujoco" else 1) * seconds / batch))
            measure, _ = env_alone(batch, steps, task, physics=name, **options)
            measures.append(({"what": "environment", "physics": name, **options, "batch": batch}, measure))
    if subject.training is not None:
        for batch in batches:
            measure = training(task, batch, max(2, int(subject.training * threads * seconds / batch)))
            measures.append(({"what": "training", "physics": "mujoco", "method": "mappo_l", "batch": batch}, measure))
    return [{"task": task, **row} for row in interleaved(measures, repeats, patience)]


def interleaved(measures: list[tuple[Head, Measure]], repeats: int, patience: float) -> Rows:
    """A row for each of `measures`; the first two are the plain loop and plain loops at once, which all relate to."""
    threads = usable_cpus()
    found = [_Found() for _ in measures]
    for _ in range(repeats):
        for (_, measure), each in zip(measures, found, strict=True):
            _await_quiet(patience)
            watch = _Watch()
            each.rates.append(measure())
            each.others.append(watch.others())
            each.of_cpu.append(each.rates[-1] / watch.own())
    plain, at_once = (statistics.median(each.rates) for each in found[:2])
    return [
        {
            **head,
            "steps_per_second": round(middle := statistics.median(each.rates)),
            "lowest": round(min(each.rates)),
            "highest": round(max(each.rates)),
            "steps_per_cpu_second": round(statistics.median(each.of_cpu)),
            "of_plain_x_threads": round(middle / (threads * plain), 3),
            "of_plain_at_once": round(middle / at_once, 3),
            "other_work_cpus": round(statistics.median(each.others), 2),
        }
        for (head, _), each in zip(measures, found, strict=True)
    ]


@dataclasses.dataclass
class _Found:
    """Of one thing measured: steps/s, steps per CPU-second, CPUs that other work took; one of each per round."""

    rates: list[float] = dataclasses.field(default_factory=list)
    of_cpu: list[float] = dataclasses.field(default_factory=list)
    others: list[float] = dataclasses.field(default_factory=list)


class _Watch:
    """How many CPUs this process and others kept busy since it was made."""

    def __init__(self) -> None:
        self._begin = self._now()

    @staticmethod
    def _now() -> tuple[float, float, float]:
        times = psutil.cpu_times()
        busy = sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0)
        return time.perf_counter(), busy, time.process_time()

    def _since(self) -> tuple[float, ...]:
        return tuple(now - then for now, then in zip(self._now(), self._begin, strict=True))

    def others(self) -> float:
        wall, busy, own = self._since()
        return max(0.0, busy - own) / wall

    def own(self) -> float:
        wall, _, own = self._since()
        return own / wall


def _await_quiet(patience: float) -> None:
    """Waits until other work takes less than a tenth of a CPU, at most `patience` seconds."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        watch = _Watch()
        time.sleep(0.3)
        if watch.others() < 0.1:
            return


# ---------------------------------------------------------------------------------------------------------------------
# Compiling, starting and memory


def step_compiled(task: str, engine: Engine, batch: int) -> Head:
    """CPU-seconds to trace and to compile one step of `batch` environments."""
    env = envs.make(task, physics=engine.name, **engine.options)
    shape = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), batch))
    action = jax.ShapeDtypeStruct((batch, *env.spec.action_mask.shape), jnp.float32)
    begin = time.process_time()
    lowered = jax.jit(jax.vmap(env.step)).lower(shape, action)
    traced = time.process_time()
    lowered.compile()
    took = {"trace_seconds": round(traced - begin, 1), "compile_seconds": round(time.process_time() - traced, 1)}
    return {"task": task, "what": "step compiled", "physics": engine.name, **engine.options, "batch": batch, **took}


def starts(task: str, patience: float) -> Rows:
    """`pmt train` with an empty compile cache, with what that left in it, and of 256 environments x 64 steps."""
    big = ("--num-envs", "256", "--rollout-length", "64", "--steps", str(2 * 256 * 64))
    runs = (("first start", "one", ()), ("second start", "one", ()), ("256 x 64", "other", big))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for what, cache, flags in runs:
            _await_quiet(patience)
            rows.append({"task": task, "what": what, **_start(pathlib.Path(folder), task, cache, *flags)})
    return rows


def _start(folder: pathlib.Path, task: str, cache: str, *flags: str) -> Head:
    """Trains in a process of its own, 4,096 steps unless `flags` say otherwise, with its compile cache so named."""
    out = pathlib.Path(tempfile.mkdtemp(dir=folder))
    command = [sys.executable, "-m", "pmt_jax", "train", task, "--method", "mappo_l", "--log-interval", "1"]
    command += ["--steps", "4096", "--out", str(out), *flags]
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / cache), "PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    watch, begin = _Watch(), time.perf_counter()
    with open(folder / f"{out.name}.log", "w+") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)
        metrics, first = out / "metrics.jsonl", None
        while (done := os.wait4(process.pid, os.WNOHANG))[0] == 0:
            if first is None and metrics.exists() and metrics.stat().st_size:
                first = time.perf_counter() - begin
            time.sleep(0.01)
        log.seek(0)
        said = log.read()
    if done[1] != 0 or (compiled := re.search(r"compiled in ([0-9.]+) s \(compile cache (\w+)\)", said)) is None:
        raise RuntimeError(f"{' '.join(command)} failed:\n{said}")
    usage = done[2]
    cpu = usage.ru_utime + usage.ru_stime
    wall = time.perf_counter() - begin
    return {
        "cache": compiled[2],
        "compile_seconds": float(compiled[1]),
        "first_update_seconds": round(first or wall, 2),
        "cpu_seconds": round(cpu, 2),
        "memory_gb": round(usage.ru_maxrss / (1e6 if sys.platform == "linux" else 1e9), 3),
        "other_work_cpus": round(max(0.0, watch.others() - cpu / wall), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=SUBJECTS)
    parser.add_argument("--quick", action="store_true", help="one engine, two batches, no starts")
    parser.add_argument("--out", type=pathlib.Path, help="a JSON file for the rows")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.5, help="roughly, of one measurement")
    parser.add_argument("--patience", type=float, default=20.0, help="s to wait for other work before a measurement")
    args = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    subject, rows = SUBJECTS[args.task], []
    if not args.quick:  # starts first, while this process holds no programs
        rows += starts(args.task, 6 * args.patience) if subject.training else []
        rows += [step_compiled(args.task, engine, 64) for engine in subject.engines]
    rows += rates(args.task, args.quick, args.repeats, args.seconds, args.patience)
    for row in rows:
        print(json.dumps(row))
    if args.out is not None:
        settings = {name: getattr(args, name) for name in ("repeats", "seconds", "patience")}
        records.write(args.out, rows, settings=settings)


if __name__ == "__main__":
    main()
