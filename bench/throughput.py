"""Control steps per second of the corridor ant: plain loops over C MuJoCo, our environment alone, the whole training.

Measurements interleave and repeat, so that other work on the machine hits all alike; each waits a while for the other
work to pause and notes how much of the machine it took. Compare medians and ratios. `of_plain_x_threads` compares with
a plain loop on one thread, times the threads; `of_plain_at_once` with as many plain loops at once, which also share
memory and clock. The plain loop takes the model as it is; our C engine skips MuJoCo's search for islands in it, which
changes no bit and is worth 6 %.

python -m bench.throughput --out bench/results/throughput.json
python -m bench.throughput --quick
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import argparse
import datetime
import functools
import json
import os
import pathlib
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import psutil

import envs
from envs import ant_corridor
from envs.physics import usable_cpus
from pmt_jax import learner, load_config
from pmt_jax.run import setup

ROUGH = {"mujoco": 5000.0, "mjx converged": 500.0, "mjx fast": 1000.0, "training": 4000.0}  # steps/s of one CPU
TARGETS = {"mujoco": 0.85, "training": 0.7, "compile_s": 15.0, "second_start_s": 5.0, "rss_gb": 2.0}
Measure = Callable[[], float]


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


def at_once(loop: Callable[[int], float], threads: int, steps: int) -> float:
    """Control steps/s of `threads` plain loops together; MuJoCo releases the interpreter lock while it steps."""
    begin = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(loop, [steps] * threads))
    return threads * steps / (time.perf_counter() - begin)


def env_alone(batch: int, steps: int, task: str = "ant_2x4", **options: Any) -> Measure:
    """jit(scan(vmap(step))) with random actions, and resets where an episode terminates."""
    env = envs.make(task, **options)
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
    program = jax.jit(lambda state: jax.lax.scan(step, state, inputs)[0])
    return _repeated(program, state, steps * batch)


def training(batch: int, steps: int) -> Measure:
    """The MAPPO-Lagrangian training loop on the task's own settings, as `pmt train` compiles it."""
    run = setup(load_config("ant_2x4", method="mappo_l", num_envs=batch))
    updates = max(1, steps // run.config.rollout_length)

    def chunk(hyper, state):
        return learner.train_chunk(run, hyper, state, updates)[0]

    keys = jax.vmap(jax.random.key)(jnp.arange(1))
    state = jax.jit(jax.vmap(functools.partial(learner.init, run), (None, 0)))(run.hyper, keys)
    program = jax.jit(jax.vmap(chunk, (None, 0)), donate_argnums=1)
    return _repeated(functools.partial(program, run.hyper), state, updates * run.config.batch_size)


def _repeated(program: Callable[[Any], Any], state: Any, steps: int) -> Measure:
    """Steps/s of a compiled program that goes on from where it stopped."""
    carry = [jax.block_until_ready(program(state))]

    def measure() -> float:
        begin = time.perf_counter()
        carry[0] = jax.block_until_ready(program(carry[0]))
        return steps / (time.perf_counter() - begin)

    return measure


# ---------------------------------------------------------------------------------------------------------------------
# Measuring side by side


def compare(batches: list[int], engines: list[str], repeats: int, seconds: float, patience: float) -> list[Any]:
    """One row for each thing measured: median steps/s, ratios to the plain loops, what other work took meanwhile."""
    threads, count = usable_cpus(), int(ROUGH["mujoco"] * seconds)
    measures: dict[str, Measure] = {
        "plain loop": lambda: plain_loop(count),
        "plain loops at once": lambda: at_once(plain_loop, threads, count),
    }
    for engine in [*engines, "training"]:
        for batch in batches:
            steps = max(2, int(ROUGH[engine] * (1 if engine.startswith("mjx") else threads) * seconds / batch))
            physics, _, solver = engine.partition(" ")
            make = training if engine == "training" else functools.partial(env_alone, physics=physics)
            options = {"solver": solver} if solver else {}
            measures[f"{engine} B={batch}"] = make(batch, steps, **options)
            print(f"compiled {engine} B={batch}", file=sys.stderr)
    return interleaved(measures, repeats, patience)


def interleaved(measures: dict[str, Measure], repeats: int, patience: float) -> list[Any]:
    """A row for each of `measures`, among them "plain loop" and "plain loops at once", which the others relate to."""
    threads = usable_cpus()
    found: dict[str, list[float]] = {name: [] for name in measures}
    others: dict[str, list[float]] = {name: [] for name in measures}
    for _ in range(repeats):
        for name, measure in measures.items():
            _await_quiet(patience)
            watch = _Watch()
            found[name].append(measure())
            others[name].append(watch.others())
    plain, at_once = statistics.median(found["plain loop"]), statistics.median(found["plain loops at once"])
    return [
        {
            "name": name,
            "steps_per_s": round(statistics.median(values)),
            "low": round(min(values)),
            "high": round(max(values)),
            "of_plain_x_threads": round(statistics.median(values) / (threads * plain), 3),
            "of_plain_at_once": round(statistics.median(values) / at_once, 3),
            "other_work_cpus": round(statistics.median(others[name]), 2),
        }
        for name, values in found.items()
    ]


class _Watch:
    """How many CPUs other processes kept busy since it was made."""

    def __init__(self) -> None:
        self._begin = self._now()

    @staticmethod
    def _now() -> tuple[float, float, float]:
        times = psutil.cpu_times()
        busy = sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0)
        return time.perf_counter(), busy, time.process_time()

    def others(self) -> float:
        wall, busy, own = (now - then for now, then in zip(self._now(), self._begin, strict=True))
        return max(0.0, busy - own) / wall


def _await_quiet(patience: float) -> None:
    """Waits until other work takes less than a tenth of a CPU, at most `patience` seconds."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        watch = _Watch()
        time.sleep(0.3)
        if watch.others() < 0.1:
            return


# ---------------------------------------------------------------------------------------------------------------------
# Starting and memory


def starts(patience: float) -> dict[str, Any]:
    """Seconds of `pmt train ant_2x4 --method mappo_l` with an empty compile cache, then with what that left in it."""
    with tempfile.TemporaryDirectory() as folder:
        rows = []
        for name in ("cold", "cached"):
            _await_quiet(patience)
            rows.append(_start(pathlib.Path(folder), name))
    return dict(zip(("first", "second"), rows, strict=True))


def _start(folder: pathlib.Path, name: str, *flags: str) -> dict[str, Any]:
    """One update of training in a process of its own."""
    out = folder / name
    command = [sys.executable, "-m", "pmt_jax.cli", "train", "ant_2x4", "--method", "mappo_l", "--log-interval", "1"]
    command += ["--steps", "4096", "--out", str(out), *flags]
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    watch, begin = _Watch(), time.perf_counter()
    with open(folder / f"{name}.log", "w+") as log:
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
        "to_first_update_s": round(first or wall, 2),
        "compiled_in_s": float(compiled[1]),
        "cache": compiled[2],
        "cpu_s": round(cpu, 2),
        "other_work_cpus": round(max(0.0, watch.others() - cpu / wall), 2),
        "peak_rss_gb": round(usage.ru_maxrss / (1e6 if sys.platform == "linux" else 1e9), 3),
    }


def memory() -> dict[str, Any]:
    """Peak memory of training 256 environments x 64 steps for two updates, compiling included."""
    with tempfile.TemporaryDirectory() as folder:
        return _start(
            pathlib.Path(folder), "big", "--num-envs", "256", "--rollout-length", "64", "--steps", str(2 * 256 * 64)
        )


# ---------------------------------------------------------------------------------------------------------------------
# The report


def machine() -> dict[str, Any]:
    cpu = platform.processor()
    if (info := pathlib.Path("/proc/cpuinfo")).exists():
        cpu = next((x.split(":")[1].strip() for x in info.read_text().splitlines() if x.startswith("model name")), cpu)
    memory = psutil.virtual_memory().total / 1e9
    return {"cpu": cpu, "threads": usable_cpus(), "memory_gb": round(memory), "system": platform.platform()}


def conditions(args: argparse.Namespace) -> dict[str, Any]:
    """Where, when and with what a benchmark runs: the beginning of its report."""
    return {
        "machine": machine(),
        "versions": {"python": platform.python_version(), "jax": jax.__version__, "mujoco": mujoco.__version__},
        "commit": _git("rev-parse", "--short", "HEAD") + ("+changes" if _git("status", "--porcelain", "-uno") else ""),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "load_average": {"begin": os.getloadavg()},
        "settings": {key: value for key, value in vars(args).items() if key != "out"},
    }


def _git(*words: str) -> str:
    here = pathlib.Path(__file__).parent
    return subprocess.run(["git", *words], cwd=here, capture_output=True, text=True, check=False).stdout.strip()


def verdict(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Each target beside what was found."""
    found = [
        (f"{row['name']}: of plain loop x threads", TARGETS[row["name"].split()[0]], row["of_plain_x_threads"], True)
        for row in report["rates"]
        if row["name"].split()[0] in TARGETS
    ]
    if "starts" in report:
        first, second = report["starts"]["first"], report["starts"]["second"]
        found.append(("training program compiled, s", TARGETS["compile_s"], first["compiled_in_s"], False))
        seconds = second["to_first_update_s"]
        found.append(("second start to the first update, s", TARGETS["second_start_s"], seconds, False))
    if "memory" in report:
        found.append(("memory, 256 envs x 64 steps, GB", TARGETS["rss_gb"], report["memory"]["peak_rss_gb"], False))
    return [
        {"what": what, "target": target, "found": value, "met": value >= target if more else value <= target}
        for what, target, value, more in found
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the C engine and training at 16 and 64, no starts")
    parser.add_argument("--out", type=pathlib.Path, help="a JSON file for the report")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.5, help="roughly, of one measurement")
    parser.add_argument("--patience", type=float, default=20.0, help="s to wait for other work before a measurement")
    args = parser.parse_args()
    batches = [16, 64] if args.quick else [16, 64, 256]
    engines = ["mujoco"] if args.quick else ["mujoco", "mjx converged", "mjx fast"]
    report = conditions(args)
    if not args.quick:  # first, while this process holds no programs
        report["starts"], report["memory"] = starts(6 * args.patience), memory()
    report["rates"] = compare(batches, engines, args.repeats, args.seconds, args.patience)
    report["load_average"]["end"] = os.getloadavg()
    report["targets"] = verdict(report)
    for row in [*report["rates"], *report["targets"]]:
        print(json.dumps(row))
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
