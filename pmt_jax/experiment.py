"""The impure room: folders, clocks, signals, printing. Everything it calls is pure."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.metadata
import json
import math
import os
import pathlib
import platform
import signal
import time
import types
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import learner, tasks
from .checkpoint import Checkpoints
from .config import Config, load_config, to_toml
from .errors import UsageError
from .evaluation import evaluate, play
from .run import Lanes, Run, setup
from .sinks import Jsonl, Progress, Sink, duration
from .types import LearnerState, Metrics

PACKAGES = ("pmt-jax", "jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy")
CHECKPOINT_SECONDS = 300.0
MATMUL_PRECISION = "highest"  # NVIDIA's default, TF32, changes results
LOSSES = ("actor/loss", "critic/loss", "cost_critic/loss")

Say = Callable[[str], None]
Chunk = Callable[[LearnerState], tuple[LearnerState, Metrics]]


def train(
    config: Config,
    out: pathlib.Path | None,
    resume: bool = False,
    cache: bool = True,
    say: Say = print,
    lanes: Lanes | None = None,
) -> int:
    """Trains `config.seeds` seeds side by side and leaves a run folder behind.

    Args:
      out: the run folder; runs/TASK-METHOD-TIME if None. It must not hold another run unless `resume`.
      resume: continue the run in `out` from its last checkpoint, bit for bit.
      cache: keep compiled programs on disk for the next start.
      lanes: settings and seeds of `config.seeds` lanes, in place of the config's; one whose loss stops being finite
        does not stop the others.

    Returns:
      The exit code: 0 when finished, 130 when interrupted (all saved), 1 when a loss stopped being finite.

    Raises:
      UsageError: a setting or the folder cannot be used; nothing has been written then.
    """
    jax.config.update("jax_default_matmul_precision", MATMUL_PRECISION)
    run = dataclasses.replace(setup(config), lanes=lanes)
    out = out or pathlib.Path("runs") / f"{run.vector.spec.name}-{config.method}-{time.strftime('%Y%m%d-%H%M%S')}"
    _open_folder(out, config, resume)
    _announce(run, out, say)
    with _compile_cache(cache) as hits:
        state, chunk = _compile(run, hits, say)
    checkpoints = Checkpoints(out)
    try:
        if resume and checkpoints.latest() is not None:
            state = checkpoints.load(state)
            step = int(state.update[0]) * config.batch_size
            _forget_rows_after(out / "metrics.jsonl", step)
            say(f"resuming after {step:,} steps")
        _write_once(out, config)
        return _loop(run, state, chunk, out, checkpoints, say)
    finally:
        checkpoints.close()


def _announce(run: Run, out: pathlib.Path, say: Say) -> None:
    config, device = run.config, jax.devices()[0]
    steps = config.num_updates * config.batch_size
    threads = f", {len(os.sched_getaffinity(0))} CPUs" if hasattr(os, "sched_getaffinity") else ""
    say(f"pmt: {config.method} on {config.task}, {config.seeds} seed(s) from {config.seed}, into {out}")
    say(f"device {device.device_kind} ({device.platform}{threads}), physics engine {run.vector.env.engine}")
    say(
        f"batch {config.num_envs} environments x {config.rollout_length} steps = {config.batch_size:,} a seed, "
        f"{config.num_updates:,} updates = {steps:,} steps a seed"
    )


def _open_folder(out: pathlib.Path, config: Config, resume: bool) -> None:
    """Makes sure that `out` can be written and is either empty or the run to resume; writes nothing but the folder."""
    existing = out / "config.toml"
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file, not a folder; choose another --out")
    if resume:
        if not existing.is_file():
            raise UsageError(f"there is no run to resume in {out}: it has no config.toml")
        _same_run(load_config(existing), config, out)
    elif out.is_dir() and any(out.iterdir()):
        what = "another run" if existing.exists() else "other files"
        raise UsageError(f"{out} already holds {what}; choose another --out, or --resume to continue the run")
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".pmt-write-test"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise UsageError(f"cannot write into {out}: {error.strerror}; choose another --out") from None


def _same_run(old: Config, new: Config, out: pathlib.Path) -> None:
    """Only `steps` may change when a run is continued."""
    fields = [f.name for f in dataclasses.fields(Config) if f.name != "steps"]
    changed = [f for f in fields if repr(getattr(old, f)) != repr(getattr(new, f))]
    if changed:
        listing = ", ".join(f"{f}: {getattr(old, f)!r} -> {getattr(new, f)!r}" for f in changed)
        raise UsageError(f"the run in {out} was made with other settings ({listing}); resume it unchanged")


def _write_once(out: pathlib.Path, config: Config) -> None:
    (out / "config.toml").write_text(to_toml(config))
    versions: dict[str, Any] = {name: _version(name) for name in PACKAGES}
    versions |= {"python": platform.python_version(), "device": jax.devices()[0].device_kind}
    versions |= {"matmul_precision": MATMUL_PRECISION}
    (out / "versions.json").write_text(json.dumps(versions, indent=2) + "\n")


def _forget_rows_after(metrics: pathlib.Path, step: int) -> None:
    """Drops what was logged after the checkpoint that the run continues from, and what was cut off in mid-line."""
    if not metrics.exists():
        return
    kept = []
    for line in metrics.read_text().splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            if json.loads(line)["step"] <= step:
                kept.append(line + "\n")
    partial = metrics.with_suffix(".partial")
    partial.write_text("".join(kept))
    partial.replace(metrics)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


# ---------------------------------------------------------------------------------------------------------------------
# Compiling


@contextlib.contextmanager
def _compile_cache(enabled: bool) -> Iterator[list[str]]:
    """The persistent compile cache; yields the list that cache events are appended to."""
    events: list[str] = []

    def listen(event: str, **_: Any) -> None:
        if event.startswith("/jax/compilation_cache/"):
            events.append(event.rsplit("/", 1)[1])

    if enabled and not getattr(jax.config, "jax_compilation_cache_dir", None):
        home = pathlib.Path(os.environ.get("XDG_CACHE_HOME", pathlib.Path.home() / ".cache"))
        jax.config.update("jax_compilation_cache_dir", str(home / "pmt-jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    jax.monitoring.register_event_listener(listen)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_listener(listen)


def _compile(run: Run, cache_events: list[str], say: Say) -> tuple[LearnerState, Chunk]:
    """The first state of all seeds, and the compiled program that advances it by one chunk."""
    say("compiling ...")
    begin = time.monotonic()
    hyper, keys, axes = run.side_by_side
    state = jax.jit(jax.vmap(functools.partial(learner.init, run), axes))(hyper, keys)

    def chunk(hyper: Any, state: LearnerState) -> tuple[LearnerState, Metrics]:
        return learner.train_chunk(run, hyper, state, run.config.log_interval)

    program = jax.jit(jax.vmap(chunk, axes), donate_argnums=1)
    lowered = program.lower(hyper, state)
    cache_events.clear()
    compiled = lowered.compile()
    found = "hit" if "cache_hits" in cache_events else "miss" if cache_events else "off"
    say(f"compiled in {time.monotonic() - begin:.1f} s (compile cache {found})")
    return state, lambda state: compiled(hyper, state)


# ---------------------------------------------------------------------------------------------------------------------
# The loop


def _loop(run: Run, state: LearnerState, chunk: Chunk, out: pathlib.Path, checkpoints: Checkpoints, say: Say) -> int:
    config = run.config
    done = int(state.update[0])
    sinks: list[Sink] = [Jsonl(out / "metrics.jsonl")]
    sinks.append(Progress(config.num_updates * config.batch_size, done * config.batch_size))
    saved = begin = time.monotonic()
    command = "the same command" if run.lanes else f"pmt train {out / 'config.toml'} --out {out} --resume"
    broken: str | None = None
    with _interruptible() as stop:
        while done < config.num_updates and not stop and broken is None:
            state, metrics = chunk(state)
            done += config.log_interval
            rows = _rows(run, done, jax.device_get(metrics))
            rows = [{**row, "seconds": round(time.monotonic() - begin, 3)} for row in rows]
            for sink in sinks:
                sink.write(rows)
            broken = None if run.lanes else _broken(rows)
            if broken is None and time.monotonic() - saved > CHECKPOINT_SECONDS:
                checkpoints.save(done, state)
                saved = time.monotonic()
        for sink in sinks:
            sink.close()
        if broken is not None:
            say(f"stopped: {broken}; the last checkpoint and all figures are in {out}. Try a smaller learning rate.")
            return 1
        checkpoints.save(done, state)
    if done < config.num_updates:
        say(f"interrupted after {done * config.batch_size:,} steps; saved. Continue with: {command}")
        return 130
    say(f"done in {duration(time.monotonic() - begin)}" + ("" if run.lanes else f"; evaluate with: pmt eval {out}"))
    return 0


def _rows(run: Run, updates: int, metrics: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """A chunk's metrics as one row per seed: counts are summed over the chunk, the rest averaged, nan left out."""
    config = run.config
    rows = []
    for i in range(config.seeds):
        row: dict[str, Any] = {
            "step": updates * config.batch_size,
            "seed": config.seed + i,
            "task": run.vector.spec.name,
            "method": config.method,
            "cost_limit": run.cost_limit,
        }
        for name, values in metrics.items():
            row[name] = _reduce(name, np.asarray(values[i]))
        rows.append(row)
    return rows


COUNTS = ("episodes", "terminations", "non_finite")


def _reduce(name: str, values: np.ndarray) -> Any:
    if name in COUNTS:
        return int(values.sum())
    if name in LOSSES:  # a loss that was not finite even once must show
        return float(values.mean())
    seen = values[np.isfinite(values)]
    return float(seen.mean()) if seen.size else math.nan


def _broken(rows: list[dict[str, Any]]) -> str | None:
    """What is wrong, if a loss is no longer finite."""
    for row in rows:
        for name in LOSSES:
            if not math.isfinite(row[name]):
                return f"{name} of seed {row['seed']} is {row[name]} at step {row['step']:,}"
    return None


@contextlib.contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM end the loop after the running chunk; a second Ctrl-C kills the program at once."""
    received: list[int] = []

    def note(number: int, _: types.FrameType | None) -> None:
        received.append(number)
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # not an exception, which could land inside the physics

    try:
        before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not in the main thread, where signals cannot be caught
        before = {}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# ---------------------------------------------------------------------------------------------------------------------
# Evaluation of a finished run


def load_run(folder: pathlib.Path) -> tuple[Run, LearnerState]:
    """A run's settings and its newest learner state, with a leading [seeds].

    Raises:
      UsageError: the folder holds no run, or no checkpoint.
    """
    if not (folder / "config.toml").is_file():
        raise UsageError(f"{folder} is not a run folder: it has no config.toml")
    run = setup(load_config(folder / "config.toml"))
    keys = jax.vmap(jax.random.key)(jnp.arange(run.config.seeds))
    like = jax.eval_shape(jax.vmap(functools.partial(learner.init, run), (None, 0)), run.hyper, keys)
    checkpoints = Checkpoints(folder)
    try:
        return run, checkpoints.load(like)
    finally:
        checkpoints.close()


def evaluate_run(folder: pathlib.Path, episodes: int, deterministic: bool) -> list[dict[str, Any]]:
    """One row per seed of a run: each figure's mean over episodes and the half-width of its 95 % interval."""
    run, state = load_run(folder)
    program = jax.jit(jax.vmap(lambda s: evaluate(run, s, episodes, deterministic=deterministic)))
    results = jax.device_get(program(state))
    return [
        {
            "seed": run.config.seed + i,
            "cost_limit": run.cost_limit,
            **_intervals({name: x[i] for name, x in results.items()}),
        }
        for i in range(run.config.seeds)
    ]


def evaluate_baseline(task: str, policy: str, episodes: int, options: dict[str, Any]) -> dict[str, Any]:
    """Evaluates a policy that is not learned, over the same episodes as `evaluate_run`.

    Raises:
      UsageError: unknown task, option or policy.
    """
    env = tasks.make(task, **options)
    act = jax.vmap(tasks.baseline(env, policy))
    results = jax.device_get(jax.jit(lambda: play(env, lambda state, _: act(state), episodes))())
    return {"cost_limit": env.spec.cost_limit, **_intervals(results)}


def _intervals(results: dict[str, np.ndarray]) -> dict[str, tuple[float, float]]:
    """Of figures [episodes]: the mean and the half-width of its 95 % interval."""

    def interval(x: np.ndarray) -> tuple[float, float]:
        return float(x.mean()), 1.96 * float(x.std(ddof=min(1, len(x) - 1))) / math.sqrt(len(x))

    return {name: interval(x) for name, x in results.items()}
