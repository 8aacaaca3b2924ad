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

from . import devices, folder, interrupts, processes, tasks
from .checkpoint import Checkpoints
from .compiling import Programs, compile_run, evaluate_seeds, use_cache
from .config import Config
from .errors import UsageError
from .evaluation import improves, interval, play
from .folder import Say, load_run
from .run import Lanes, Run, setup
from .sinks import Profile, Sink, check_sinks, duration, open_sinks
from .types import ActingState, Best, LearnerState, Metrics

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
    lanes: Lanes | None = None,
    count: int | None = None,
) -> int:
    """Trains `config.seeds` seeds side by side and leaves a run folder behind.

    Args:
      out: the run folder; runs/TASK-METHOD-TIME if None. It must not hold another run unless `resume`.
      resume: continue the run in `out` from its last checkpoint, bit for bit.
      cache: keep compiled programs on disk for the next start.
      sinks: where the figures go besides metrics.jsonl: csv, tensorboard, wandb.
      profile: a folder for a JAX profiler trace of a few chunks.
      lanes: settings and seeds of `config.seeds` lanes, in place of the config's; one whose loss stops being finite
        does not stop the others.
      count: of devices to split the run over, of all processes together: one where None, or all of several processes'.
        Of these, the first writes and speaks, and all return the same.

    Returns:
      The exit code: 0 when finished, 128 + the signal's number when interrupted (all saved), 1 when a loss stopped
      being finite or the folder could not be written any more.

    Raises:
      UsageError: a setting or the folder cannot be used; nothing has been written then.
    """
    jax.config.update("jax_default_matmul_precision", folder.MATMUL_PRECISION)
    check_sinks(sinks)
    run = dataclasses.replace(setup(config), lanes=lanes, mesh=devices.make_mesh(config, count))
    if not processes.is_first():
        say, sinks, profile = _silence, (), None
    out = out or pathlib.Path("runs") / f"{run.vector.spec.name}-{config.method}-{time.strftime('%Y%m%d-%H%M%S')}"
    processes.by_first(lambda: folder.open_folder(out, run, resume, say))
    _announce(run, out, say)
    if cache:
        use_cache()
    state, programs = compile_run(run, say)
    start = _Position(state, folder.first_best(state))
    command = _command(run, out)
    try:
        end = _train_into(out, run, programs, start, resume, sinks, profile, say)
    except BrokenPipeError:  # standard output's, not the folder's
        raise
    except OSError as error:
        say(_cannot_write(out, error, command))
        return 1
    return _farewell(end, run, out, command, say)


def _train_into(
    out: pathlib.Path,
    run: Run,
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
            start = _restore(run, start, checkpoints, out, say)
        opened: list[Sink] = []
        processes.by_first(lambda: _begin(run, out, start.step, sinks, opened))
        for sink in opened:
            stack.enter_context(contextlib.closing(sink))
        tracing = stack.enter_context(contextlib.closing(Profile(profile)))
        return _loop(run, programs, start, checkpoints, opened, tracing)


def _command(run: Run, out: pathlib.Path) -> str:
    """How to go on."""
    if run.lanes:
        return "the same command"
    if jax.process_count() > 1:
        return "the same command with --resume"
    split = f" --devices {run.mesh.size}" if run.mesh else ""
    return f"pmt train {out / 'config.toml'} --out {out} --resume{split}"


def _silence(line: str) -> None:
    del line


def _begin(run: Run, out: pathlib.Path, step: int, sinks: Sequence[str], opened: list[Sink]) -> None:
    """Writes the settings, and opens the sinks into `opened`."""
    folder.write_settings(out, run)
    opened += open_sinks(sinks, out, run.config, step)


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


def _announce(run: Run, out: pathlib.Path, say: Say) -> None:
    config, device = run.config, jax.devices()[0]
    steps = config.num_updates * config.batch_size
    threads = f", {len(os.sched_getaffinity(0))} CPUs" if hasattr(os, "sched_getaffinity") else ""
    say(f"pmt: {config.method} on {config.task}, {config.seeds} seed(s) from {config.seed}, into {out}")
    say(f"device {device.device_kind} ({device.platform}{threads}), physics engine {run.vector.env.engine}")
    if run.mesh:
        seeds, environments = run.mesh.devices.shape
        say(
            f"{run.mesh.size} devices in {jax.process_count()} process(es): seeds in {seeds} part(s), "
            f"each seed's environments in {environments}"
        )
    say(
        f"batch {config.num_envs} environments x {config.rollout_length} steps = {config.batch_size:,} a seed, "
        f"{config.num_updates:,} updates = {steps:,} steps a seed"
    )


def _restore(run: Run, start: _Position, checkpoints: Checkpoints, out: pathlib.Path, say: Say) -> _Position:
    """The newest checkpoint's position, all later traces of the run deleted; `start` where there is none yet."""
    step, saved = checkpoints.load(start.saved, say) if checkpoints.steps() else (0, start.saved)
    checkpoints.forget_after(step)
    seconds = processes.by_first(lambda: folder.forget_rows_after(out, step, say))
    say(f"resuming after {step:,} steps")
    best = dataclasses.replace(saved["best"], state=devices.place(run.mesh, saved["best"].state))
    return _Position(devices.place(run.mesh, saved["last"]), best, step, seconds)


def _loop(
    run: Run, programs: Programs, start: _Position, checkpoints: Checkpoints, sinks: list[Sink], tracing: Profile
) -> _Position:
    """Trains until done, interrupted or broken, and saves the end unless it is broken."""
    config, now = run.config, start
    begin = saved = time.monotonic()
    stop = 0
    with interrupts.noted(_next_kills) as received:
        while now.step < config.num_updates * config.batch_size:
            if stop := processes.agree(received[0] if received else 0):
                break
            tracing.before_chunk()
            state, metrics = programs.chunk(now.state)
            step = now.step + config.log_interval * config.batch_size
            rows = _rows(run, step, jax.device_get(metrics))
            broken = _overflown(rows) or (None if run.lanes else _broken(rows))
            rows = _with_evaluation(run, programs, state, rows, skip=broken is not None)
            seconds = start.seconds + time.monotonic() - begin
            _write(sinks, [{**row, "seconds": round(seconds, 3)} for row in rows])
            best = now.best if broken else _keep_best(run, programs, now.best, state, rows)
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


def _farewell(end: _Position, run: Run, out: pathlib.Path, command: str, say: Say) -> int:
    """Says how training ended and what to do next; returns the exit code."""
    if end.broken is not None:
        say(f"stopped: {end.broken}; all figures are in {out}, so choose another --out")
        return 1
    if end.step < run.config.num_updates * run.config.batch_size:
        say(f"interrupted after {end.step:,} steps; saved. Continue with: {command}")
        return 128 + (end.signal or signal.SIGINT)
    next_step = "" if run.lanes else f"; evaluate with: pmt eval {out}"
    say(f"done: {end.step:,} steps in {duration(end.seconds)}{next_step}")
    return 0


# ---------------------------------------------------------------------------------------------------------------------
# Rows of figures


def _rows(run: Run, step: int, metrics: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """A chunk's metrics as one row per seed: counts are summed over the chunk, the rest averaged, nan left out."""
    config = run.config
    rows = []
    for i, limit in enumerate(run.cost_limits):
        row: dict[str, Any] = {
            "step": step,
            "seed": config.seed + i,
            "task": run.vector.spec.name,
            "method": config.method,
            "cost_limit": float(limit),
        }
        for name, values in metrics.items():
            row[name] = _reduce(name, np.asarray(values[i]))
        rows.append(row)
    return rows


NO_ROOM = "the warp engine had no room for all contacts or constraints"
OVERFLOW = "info/physics_overflow"  # of the ant and the hands, see `envs.physics.Engine`
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


def _overflown(rows: list[dict[str, Any]]) -> str | None:
    """What is wrong, if the physics lost contacts."""
    share = max(row.get(OVERFLOW, 0.0) for row in rows)
    if not share:
        return None
    return (
        f"{NO_ROOM} in {share:.2g} of the steps up to step {rows[0]['step']:,}, which are wrong; take another "
        "--physics, or give make_engine more `contacts`"
    )


def _with_evaluation(
    run: Run, programs: Programs, state: LearnerState, rows: list[dict[str, Any]], skip: bool
) -> list[dict[str, Any]]:
    """The rows with `eval/NAME` and its interval's half-width `eval/NAME/ci95`: nan where no evaluation is due."""
    if programs.evaluate is None:
        return rows
    updates = rows[0]["step"] // run.config.batch_size
    if skip or updates % run.config.eval_interval >= run.config.log_interval:
        results = [dict.fromkeys(programs.evaluate.out_info, (math.nan, math.nan)) for _ in rows]
    else:
        results = _intervals(jax.device_get(programs.evaluate(state)))
    return [
        row
        | {f"eval/{name}": mean for name, (mean, _) in result.items()}
        | {f"eval/{name}/ci95": half for name, (_, half) in result.items()}
        for row, result in zip(rows, results, strict=True)
    ]


def _intervals(results: Metrics) -> list[dict[str, tuple[float, float]]]:
    """Of figures [seeds, episodes]: each seed's means and half-widths of their 95 % intervals."""
    seeds = len(next(iter(results.values())))
    return [{name: interval(np.asarray(x[i])) for name, x in results.items()} for i in range(seeds)]


def _keep_best(run: Run, programs: Programs, best: Best, state: LearnerState, rows: list[dict[str, Any]]) -> Best:
    """The best of `best` and `state`, seed by seed: judged by the evaluation if there is one, else by training."""
    prefix = "eval/" if run.config.eval_interval else ""
    reward, cost = (
        np.asarray([row[prefix + f] for row in rows], np.float32) for f in ("episode_reward", "episode_cost")
    )
    old_reward, old_cost = np.asarray(best.reward), np.asarray(best.cost)
    improved = improves(reward, cost, old_reward, old_cost, run.cost_limits)
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


# ---------------------------------------------------------------------------------------------------------------------
# Evaluation of a finished run


def evaluate_run(
    out: pathlib.Path,
    episodes: int,
    deterministic: bool,
    which: str = "last",
    physics: str | None = None,
    say: Say = print,
) -> list[dict[str, Any]]:
    """One row per seed of a run: each figure's mean over episodes and the half-width of its 95 % interval.

    Args:
      out: the run folder, which is only read, or the name of a pretrained policy.
      deterministic: take mean actions instead of samples.
      which: `last` or `best`.
      physics: an engine other than the run's.
    """
    return evaluate_states(*load_run(out, which, physics, say), episodes, deterministic)


def evaluate_states(run: Run, state: ActingState, episodes: int, deterministic: bool) -> list[dict[str, Any]]:
    """The rows of `evaluate_run` for learner states with a leading [seeds], or what of them acts."""
    jax.config.update("jax_default_matmul_precision", folder.MATMUL_PRECISION)
    results = jax.device_get(jax.jit(evaluate_seeds(run, episodes, deterministic))(state))
    if np.any(results.get(OVERFLOW, 0) > 0):
        raise UsageError(f"{NO_ROOM}; evaluate with another --physics")
    return [
        {"seed": run.config.seed + i, "cost_limit": run.cost_limit, "step": step, **figures}
        for i, (figures, step) in enumerate(zip(_intervals(results), _steps(run, state), strict=True))
    ]


def _steps(run: Run, state: ActingState) -> list[int]:
    return [int(update) * run.config.batch_size for update in state.update]


def evaluate_baseline(task: str, policy: str, episodes: int, options: dict[str, Any]) -> dict[str, Any]:
    """Evaluates a policy that is not learned, over the same episodes as `evaluate_run`.

    Raises:
      UsageError: unknown task, option or policy.
    """
    env = tasks.make(task, **options)
    act = jax.vmap(tasks.baseline(env, policy))
    results = jax.device_get(jax.jit(lambda: play(env, lambda state, _: act(state), episodes))())
    return {"cost_limit": env.spec.cost_limit, **{name: interval(x) for name, x in results.items()}}
