"""The impure room: clocks, signals, printing. What it calls is pure, but for the run folder, checkpoints and sinks."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import pathlib
import signal
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ..config.settings import Config
from ..learning import sharding
from ..learning.evaluation import interval, is_better
from ..learning.setup import Setup, Trials, make_setup
from ..learning.types import Best, LearnerState, Metrics
from . import processes, run_folder, signals
from .checkpoint import Checkpoints
from .compile import Programs, compile_run, use_cache
from .loggers import Profile, Sink, check_sinks, duration, open_sinks
from .run_folder import Say

CHECKPOINT_SECONDS = 300.0
LOSSES = ("actor/loss", "critic/loss", "cost_critic/loss")


def train(
    config: Config,
    out: pathlib.Path | None,
    resume: bool = False,
    *,
    cache: bool = True,
    sinks: Sequence[str] = (),
    profile: pathlib.Path | None = None,
    say: Say = print,
    trials: Trials | None = None,
    count: int | None = None,
) -> int:
    """Trains `config.seeds` seeds side by side and leaves a run folder behind.

    Args:
      out: the run folder; runs/TASK-METHOD-TIME if None. It must not hold another run unless `resume`.
      resume: continue the run in `out` from its last checkpoint, bit for bit.
      cache: keep compiled programs on disk for the next start.
      sinks: where the figures go besides metrics.jsonl: csv, tensorboard, wandb.
      profile: a folder for a JAX profiler trace of a few chunks.
      trials: settings and seeds of `config.seeds` trials, in place of the config's; one whose loss stops being finite
        does not stop the others.
      count: of devices to split the run over, of all processes together: one where None, or all of several processes'.
        Of these, the first writes and speaks, and all return the same.

    Returns:
      The exit code: 0 when finished, 128 + the signal's number when interrupted (all saved), 1 when a loss stopped
      being finite or the folder could not be written any more.

    Raises:
      UsageError: a setting or the folder cannot be used; nothing has been written then.
    """
    jax.config.update("jax_default_matmul_precision", run_folder.MATMUL_PRECISION)
    check_sinks(sinks)
    setup = dataclasses.replace(make_setup(config), trials=trials, mesh=sharding.make_mesh(config, count))
    if not processes.is_first():
        say, sinks, profile = _silence, (), None
    out = out or pathlib.Path("runs") / f"{setup.vector.spec.name}-{config.method}-{time.strftime('%Y%m%d-%H%M%S')}"
    processes.by_first(lambda: run_folder.open_folder(out, setup, resume, say))
    _announce(setup, out, say)
    if cache:
        use_cache()
    state, programs = compile_run(setup, say)
    start = _Position(state, run_folder.initial_best(state))
    command = _command(setup, out)
    try:
        end = _train_into(out, setup, programs, start, resume, sinks, profile, say)
    except BrokenPipeError:  # standard output's, not the folder's
        raise
    except OSError as error:
        say(_cannot_write(out, error, command))
        return 1
    return _farewell(end, setup, out, command, say)


def _train_into(
    out: pathlib.Path,
    setup: Setup,
    programs: Programs,
    start: _Position,
    resume: bool,
    sinks: Sequence[str],
    profile: pathlib.Path | None,
    say: Say,
) -> _Position:
    """Opens what is written to, trains, and closes it again."""
    with contextlib.ExitStack() as stack:
        checkpoints = stack.enter_context(contextlib.closing(Checkpoints(out)))
        if resume:
            start = _restore(setup, start, checkpoints, out, say)
        opened: list[Sink] = []
        processes.by_first(lambda: _begin(setup, out, start.step, sinks, opened))
        for sink in opened:
            stack.enter_context(contextlib.closing(sink))
        tracing = stack.enter_context(contextlib.closing(Profile(profile)))
        return _loop(setup, programs, start, checkpoints, opened, tracing)


def _command(setup: Setup, out: pathlib.Path) -> str:
    """How to go on."""
    if setup.trials:
        return "the same command"
    if jax.process_count() > 1:
        return "the same command with --resume"
    split = f" --devices {setup.mesh.size}" if setup.mesh else ""
    return f"pmt train {out / 'config.toml'} --out {out} --resume{split}"


def _silence(line: str) -> None:
    del line


def _begin(setup: Setup, out: pathlib.Path, step: int, sinks: Sequence[str], opened: list[Sink]) -> None:
    """Writes the settings, and opens the sinks into `opened`."""
    run_folder.write_settings(out, setup)
    opened += open_sinks(sinks, out, setup.config, step)


@dataclasses.dataclass(frozen=True)
class _Position:
    """Where training stands.

    Attributes:
      state, best: of all seeds.
      step: environment steps done by each seed.
      seconds: spent on them.
      broken: why it cannot go on, if so.
      signal: the one that interrupted it, if any.
    """

    state: LearnerState
    best: Best
    step: int = 0
    seconds: float = 0.0
    broken: str | None = None
    signal: int | None = None

    @property
    def saved(self) -> dict[str, Any]:
        """What a checkpoint holds."""
        return {"last": self.state, "best": self.best}


def _announce(setup: Setup, out: pathlib.Path, say: Say) -> None:
    config, device = setup.config, jax.devices()[0]
    steps = config.num_updates * config.batch_size
    threads = f", {len(os.sched_getaffinity(0))} CPUs" if hasattr(os, "sched_getaffinity") else ""
    say(f"pmt: {config.method} on {config.task}, {config.seeds} seed(s) from {config.seed}, into {out}")
    say(f"device {device.device_kind} ({device.platform}{threads}), physics engine {setup.vector.env.engine}")
    if setup.mesh:
        seeds, environments = setup.mesh.devices.shape
        say(
            f"{setup.mesh.size} devices in {jax.process_count()} process(es): seeds in {seeds} part(s), "
            f"each seed's environments in {environments}"
        )
    say(
        f"batch {config.num_envs} environments x {config.rollout_length} steps = {config.batch_size:,} a seed, "
        f"{config.num_updates:,} updates = {steps:,} steps a seed"
    )


def _restore(setup: Setup, start: _Position, checkpoints: Checkpoints, out: pathlib.Path, say: Say) -> _Position:
    """The newest checkpoint's position, all later traces of the run deleted; `start` where there is none yet."""
    step, saved = checkpoints.load(start.saved, say) if checkpoints.steps() else (0, start.saved)
    checkpoints.forget_after(step)
    seconds = processes.by_first(lambda: run_folder.forget_rows_after(out, step, say))
    say(f"resuming after {step:,} steps")
    best = dataclasses.replace(saved["best"], state=sharding.place(setup.mesh, saved["best"].state))
    return _Position(sharding.place(setup.mesh, saved["last"]), best, step, seconds)


def _loop(
    setup: Setup, programs: Programs, start: _Position, checkpoints: Checkpoints, sinks: list[Sink], tracing: Profile
) -> _Position:
    """Trains until done, interrupted or broken, and saves the end unless it is broken."""
    config, now = setup.config, start
    begin = saved = time.monotonic()
    stop = 0
    with signals.noted(_next_kills) as received:
        while now.step < config.num_updates * config.batch_size:
            if stop := processes.agree(received[0] if received else 0):
                break
            tracing.before_chunk()
            state, metrics = programs.chunk(now.state)
            step = now.step + config.log_interval * config.batch_size
            rows = _rows(setup, step, jax.device_get(metrics))
            broken = _overflown(setup, rows) or (None if setup.trials else _broken(rows))
            rows = _with_evaluation(setup, programs, state, rows, skip=broken is not None)
            seconds = start.seconds + time.monotonic() - begin
            _write(sinks, [{**row, "seconds": round(seconds, 3)} for row in rows])
            best = now.best if broken else _keep_best(setup, programs, now.best, state, rows)
            now = _Position(state, best, step, seconds, broken)
            if broken:
                return now
            if processes.agree(time.monotonic() - saved > CHECKPOINT_SECONDS):
                checkpoints.save(step, now.saved)
                saved = time.monotonic()
        checkpoints.save(now.step, now.saved)
    return dataclasses.replace(now, signal=stop or None)


def _write(sinks: list[Sink], rows: list[dict[str, Any]]) -> None:
    def write() -> None:
        for sink in sinks:
            sink.write(rows)

    processes.by_first(write)


def _cannot_write(out: pathlib.Path, error: OSError, command: str) -> str:
    """A full disk, a quota, a share that went away."""
    begun = (out / "config.toml").is_file()
    then = f"continue: {command}" if begun else "train again into another --out"
    return f"stopped: cannot write into {out}: {error.strerror or error}. What was saved is whole; make room and {then}"


def _farewell(end: _Position, setup: Setup, out: pathlib.Path, command: str, say: Say) -> int:
    """Says how training ended and what to do next; returns the exit code."""
    if end.broken is not None:
        say(f"stopped: {end.broken}; all figures are in {out}, so choose another --out")
        return 1
    if end.step < setup.config.num_updates * setup.config.batch_size:
        say(f"interrupted after {end.step:,} steps; saved. Continue with: {command}")
        return 128 + (end.signal or signal.SIGINT)
    next_step = "" if setup.trials else f"; evaluate with: pmt eval {out}"
    say(f"done: {end.step:,} steps in {duration(end.seconds)}{next_step}")
    return 0


# ---------------------------------------------------------------------------------------------------------------------
# Rows of figures


def _rows(setup: Setup, step: int, metrics: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """A chunk's metrics as one row per seed: counts are summed over the chunk, the rest averaged, nan left out."""
    config = setup.config
    rows = []
    for i, limit in enumerate(setup.cost_limits):
        row: dict[str, Any] = {
            "step": step,
            "seed": config.seed + i,
            "task": setup.vector.spec.name,
            "method": config.method,
            "cost_limit": float(limit),
        }
        for name, values in metrics.items():
            row[name] = _reduce(name, np.asarray(values[i]))
        rows.append(row)
    return rows


NO_ROOM = "the warp engine had no room for all contacts or constraints"
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
                found = f"{name} of seed {row['seed']} is {row[name]} at step {row['step']:,}"
                return f"{found}; try a smaller learning rate"
    return None


def _overflown(setup: Setup, rows: list[dict[str, Any]]) -> str | None:
    """What is wrong, if the physics lost contacts."""
    share = max(row[setup.overflow] for row in rows) if setup.overflow else 0.0
    if not share:
        return None
    return (
        f"{NO_ROOM} in {share:.2g} of the steps up to step {rows[0]['step']:,}, which are wrong; take another "
        "--physics, or give make_engine more `contacts`"
    )


def _with_evaluation(
    setup: Setup, programs: Programs, state: LearnerState, rows: list[dict[str, Any]], skip: bool
) -> list[dict[str, Any]]:
    """The rows with `eval/NAME` and its interval's half-width `eval/NAME/ci95`: nan where no evaluation is due."""
    if programs.evaluate is None:
        return rows
    updates = rows[0]["step"] // setup.config.batch_size
    if skip or updates % setup.config.eval_interval >= setup.config.log_interval:
        results = [dict.fromkeys(programs.evaluate.out_info, (math.nan, math.nan)) for _ in rows]
    else:
        results = seed_intervals(jax.device_get(programs.evaluate(state)))
    return [
        row
        | {f"eval/{name}": mean for name, (mean, _) in result.items()}
        | {f"eval/{name}/ci95": half for name, (_, half) in result.items()}
        for row, result in zip(rows, results, strict=True)
    ]


def seed_intervals(results: Metrics) -> list[dict[str, tuple[float, float]]]:
    """Of figures [seeds, episodes]: each seed's means and half-widths of their 95 % intervals."""
    seeds = len(next(iter(results.values())))
    return [{name: interval(np.asarray(x[i])) for name, x in results.items()} for i in range(seeds)]


def _keep_best(setup: Setup, programs: Programs, best: Best, state: LearnerState, rows: list[dict[str, Any]]) -> Best:
    """The best of `best` and `state`, seed by seed: judged by the evaluation if there is one, else by training."""
    prefix = "eval/" if setup.config.eval_interval else ""
    reward, cost = (
        np.asarray([row[prefix + f] for row in rows], np.float32) for f in ("episode_reward", "episode_cost")
    )
    old_reward, old_cost = np.asarray(best.reward), np.asarray(best.cost)
    improved = is_better(reward, cost, old_reward, old_cost, setup.cost_limits)
    if not improved.any():
        return best
    return Best(
        programs.take(improved, best.state, state),
        np.where(improved, reward, old_reward),
        np.where(improved, cost, old_cost),
    )


def _next_kills(_: int) -> None:
    """The loop ends after the running chunk; a second Ctrl-C kills the program at once."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
