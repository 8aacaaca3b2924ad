"""Cases become programs, programs take turns, turns become rows.

A row says what its case is about, the median rate of its turns and the `rates` of all of them in order, so that ratios
can be taken turn by turn (`bench/tables/speed.py`). Each turn waits a while for other work on the machine to pause and
notes how much of it went on.
"""

from __future__ import annotations

import concurrent.futures
import itertools
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import psutil

import envs
from envs.base import State
from envs.physics import obstacle, usable_cpus
from envs.vector import restart
from pmt_jax import load_config, make_setup
from pmt_jax.learning.sharding import make_mesh
from pmt_jax.training.compile import compile_run
from pmt_jax.training.workers import start_workers

from . import grid, once, plain, update
from .cases import Build, Case, Program
from .compare import label
from .records import Record

UPDATES = {"cpu": 1, "gpu": 8}  # of a call of the training loop


class Effort(NamedTuple):
    """How long to measure: turns of each program, seconds of a turn, seconds to wait for other work before them."""

    turns: int
    seconds: float
    patience: float


# The host of a shared GPU is never quiet, and other work on its cores hardly reaches the GPU: no turn waits there.
FULL, ON_GPU, QUICK = Effort(5, 1.0, 60.0), Effort(5, 1.0, 0.0), Effort(2, 0.3, 0.0)
Failures = dict[Case, str]


def rows(cases: Sequence[Case], effort: Effort, say: Callable[[str], None]) -> Iterator[Record]:
    """Measures cases; if one fails, its row says why. A case whose engine cannot run here has no row."""
    found, failed = {}, Failures()
    cases = [case for case in cases if _can_run(case, say)]
    for case in [case for case in cases if case.kind in ONCE]:
        await_quiet(effort.patience if case.kind == "start" else 0)
        found[case] = _attempt(failed, case, lambda case=case: ONCE[case.kind](case))
        yield _row(case, found, failed, say)
    timed = [case for case in cases if case.kind not in ONCE]
    programs = _compiled(timed, failed, jax.default_backend() == "gpu", say)
    turns = _take_turns(programs, effort)
    found |= {case: program.facts | _medians(case, turns[case]) for case, program in programs.items()}
    for case in timed:
        yield _row(case, found, failed, say)


def _can_run(case: Case, say: Callable[[str], None]) -> bool:
    """Whether this machine has the devices, the CPUs and the engine; a missing engine is said."""
    reason = obstacle(case.physics) if case.physics else None
    if reason:
        say(f"left out: {label(case.about())}: physics '{case.physics}' {reason}")
    return reason is None and case.devices <= jax.device_count() and case.workers <= max(2, usable_cpus())


def _row(case: Case, found: dict[Case, Record], failed: Failures, say: Callable[[str], None]) -> Record:
    row = case.about() | ({"failed": failed[case]} if case in failed else found[case])
    say(str({name: value for name, value in row.items() if name != "rates"}))
    return row


def _attempt(failed: Failures, case: Case, work: Callable[[], Any]) -> Any:
    """What `work` returns; a task that cannot be made, or a device without the memory, is a result too."""
    try:
        return work()
    except Exception as error:
        failed[case] = f"{type(error).__name__}: {str(error).splitlines()[0][:200]}"


def _compiled(
    cases: Sequence[Case], failed: Failures, together: bool, say: Callable[[str], None]
) -> dict[Case, Program]:
    """The programs of cases, warmed up; `together` compiles them side by side, while a costly host is held.

    Engines are made one after the other: Warp starts with the first, and two threads that start it crash it.
    """
    builds = {case: _attempt(failed, case, lambda case=case: MAKE[case.kind](case)) for case in cases}

    def compiled(case: Case) -> Program | None:
        program = _attempt(failed, case, builds[case])
        say(f"compiled {', '.join(map(str, case.about().values()))}")
        return program

    sound = [case for case in cases if case not in failed]
    with concurrent.futures.ThreadPoolExecutor(max(1, len(sound)) if together else 1) as pool:
        programs = dict(zip(sound, pool.map(compiled, sound), strict=True))
    for case, program in programs.items():
        if program:
            _attempt(failed, case, program.call)
    return {case: program for case, program in programs.items() if program and case not in failed}


def environment(case: Case) -> Build:
    """jit(scan(vmap(step))) with random actions, and with resets if an episode terminates."""
    engine = {"physics": case.physics} if case.physics else {}
    env = envs.make(case.task, **engine, **dict(case.settings))
    batch = case.seeds * case.num_envs
    step_all, reset_all = jax.vmap(env.step), jax.vmap(env.reset)

    def step(state: State, action_and_key: tuple[jax.Array, jax.Array]) -> tuple[State, jax.Array]:
        action, key = action_and_key
        after = step_all(state, action)
        return restart(env, after.terminated, after, jax.random.split(key, batch)), after.reward.sum()

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Actions and keys of a call."""
        shape = (case.rollout_length, batch, env.spec.num_agents, env.spec.action_dim)
        return jax.random.uniform(key, shape, minval=-1, maxval=1), jax.random.split(key, case.rollout_length)

    def build() -> Program:
        # Drawn before, and for as many steps as a plain loop draws: few that come again make other motions.
        calls = jax.random.split(jax.random.key(1), -(-plain.STEPS // case.rollout_length))
        inputs = itertools.cycle([draw(key) for key in calls])
        box = [jax.jit(reset_all)(jax.random.split(jax.random.key(0), batch))]
        begin, cpu = time.perf_counter(), time.process_time()
        rollout = jax.jit(lambda state, inputs: jax.lax.scan(step, state, inputs)[0], donate_argnums=0)
        lowered = rollout.lower(box[0], next(inputs))
        traced = time.process_time()
        program = lowered.compile()
        facts = {
            "compile_seconds": round(time.perf_counter() - begin, 2),
            "trace_cpu_seconds": round(traced - cpu, 1),
            "compile_cpu_seconds": round(time.process_time() - traced, 1),
        }

        def call() -> None:
            box[0] = jax.block_until_ready(program(box[0], next(inputs)))

        return Program(call, case.rollout_length * case.seeds * case.num_envs, facts)

    return build


def training(case: Case) -> Build:
    """The training loop as `pmt train` compiles it; a call is one update, on a GPU eight."""
    updates = UPDATES["cpu" if jax.devices()[0].platform == "cpu" else "gpu"]
    steps = updates * case.num_envs * case.rollout_length
    sizes = {"seeds": case.seeds, "num_envs": case.num_envs, "rollout_length": case.rollout_length}
    engine = {"physics": case.physics} if case.physics else {}
    settings = sizes | engine | {"log_interval": updates, "steps": steps}
    config = load_config(case.task, method=case.method, **settings, **dict(case.settings))
    setup = make_setup(config, mesh=make_mesh(config, case.devices), workers=case.workers)

    def build() -> Program:
        begin = time.perf_counter()
        state, programs = (start_workers if case.workers > 1 else compile_run)(setup, lambda _: None)
        facts = {"physics": setup.vector.env.engine, "compile_seconds": round(time.perf_counter() - begin, 2)}
        box = [state]

        def call() -> None:
            box[0], _ = jax.block_until_ready(programs.chunk(box[0], updates))

        return Program(call, case.seeds * steps, facts)

    return build


ONCE = {
    "start": once.start,
    "checkpoint": once.checkpoint,
    "baseline": once.baseline,
    "certificate": once.certificate,
    "update": update.update,
}
MAKE = {"plain loop": plain.plain_loop, "environment": environment, "training": training, "power flow": grid.flow}


# ---------------------------------------------------------------------------------------------------------------------
# Turns


class Turn(NamedTuple):
    """Steps per second; CPUs that this process and others kept busy."""

    rate: float
    cpu: float
    others: float


def _take_turns(programs: dict[Case, Program], effort: Effort) -> dict[Case, list[Turn]]:
    """The turns of each program."""
    turns: dict[Case, list[Turn]] = {case: [] for case in programs}
    patience = effort.patience
    for _ in range(effort.turns):
        for case, program in programs.items():
            begin = time.monotonic()
            await_quiet(patience)
            patience -= time.monotonic() - begin
            turns[case].append(_turn(program, effort.seconds))
    return turns


def _turn(program: Program, seconds: float) -> Turn:
    watch, calls = Watch(), 0
    while not calls or watch.wall < seconds:
        program.call()
        calls += 1
    wall, others, own = watch.wall, watch.others, watch.own
    return Turn(calls * program.steps / wall, own / wall, others)


def _medians(case: Case, turns: Sequence[Turn]) -> Record:
    unit = "flows_per_second" if case.kind == "power flow" else "steps_per_second"
    memory = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")  # so far; a CPU has none
    return {
        unit: round(statistics.median(turn.rate for turn in turns), 1),
        "rates": [round(turn.rate, 1) for turn in turns],
        "steps_per_cpu_second": round(statistics.median(turn.rate / turn.cpu for turn in turns)),
        "other_work_cpus": round(statistics.median(turn.others for turn in turns), 2),
        **({"memory_gb": round(memory / 1e9, 2)} if memory else {}),
    }


class Watch:
    """Seconds since it was made, CPU-seconds of this process and its children, and how many CPUs others kept busy."""

    def __init__(self) -> None:
        self._begin, self._busy, self._cpu = time.perf_counter(), self._machine(), self._spent()

    @staticmethod
    def _machine() -> float:
        times = psutil.cpu_times()
        return sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0)

    @property
    def wall(self) -> float:
        return time.perf_counter() - self._begin

    @property
    def own(self) -> float:
        return self._spent() - self._cpu

    @staticmethod
    def _spent() -> float:
        children = psutil.Process().children()
        return time.process_time() + sum(child.cpu_times().user + child.cpu_times().system for child in children)

    @property
    def others(self) -> float:
        return max(0.0, self._machine() - self._busy - self.own) / self.wall


def await_quiet(patience: float) -> None:
    """Waits until other work takes less than a tenth of a CPU, at most `patience` seconds."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        watch = Watch()
        time.sleep(0.3)
        if watch.others < 0.1:
            return
