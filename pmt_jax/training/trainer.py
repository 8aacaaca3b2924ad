"""A run from its settings to its last checkpoint: files, clocks and signals around the compiled programs."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import pathlib
import shlex
import time
from collections.abc import Callable, Sequence

import jax
import numpy as np

from .. import tasks
from ..config import toml
from ..config.settings import Config
from ..errors import UsageError
from ..learning import sharding
from ..learning.debug import NotFinite
from ..learning.evaluation import is_better
from ..learning.setup import Setup, Trials, make_setup
from ..learning.types import Best, LearnerState
from ..output import Say, say, silent
from . import claims, health, jobs, processes, run_folder
from .checkpoint import Checkpoints, has_checkpoint
from .compile import Programs, check_memory, compile_run, use_cache
from .loggers import Logger, Profile, check_loggers, open_loggers
from .metrics import Row, evaluation_columns, judged_cost, make_rows, seed_intervals, without_metrics
from .progress import Progress, duration
from .signals import Interrupts

CHECKPOINT_SECONDS = 300.0
WarmStart = Callable[[Setup], Callable[[LearnerState], LearnerState] | None]
MOST_REASONS = 5  # of seeds that broke, printed at the end


def train(
    config: Config,
    out: pathlib.Path | None,
    resume: bool = False,
    *,
    cache: bool = True,
    loggers: Sequence[str] = (),
    profile: pathlib.Path | None = None,
    say: Say = say,
    trials: Trials | None = None,
    count: int | None = None,
    workers: int = 1,
    warm_start: WarmStart = lambda setup: None,
    debug: bool = False,
    change: bool = False,
) -> int:
    """Trains `config.seeds` seeds side by side and leaves a run folder behind.

    Args:
      out: the run folder; a new one, runs/TASK-METHOD-TIME, if None. It must not hold another run unless `resume`.
      resume: continue the run in `out` from its last checkpoint, bit for bit.
      cache: keep compiled programs on disk for the next start.
      loggers: where the rows are written besides metrics.jsonl: csv, tensorboard, wandb.
      profile: a folder for a JAX profiler trace of a few chunks.
      trials: settings and seeds of `config.seeds` trials, in place of the config's.
      count: of devices to split the run over, of all processes together: one if None, or all of several processes'.
        Of these, the first writes and prints, and all return the same.
      workers: processes that share the seeds and the CPUs (see jobs.py).
      warm_start: what makes the first state begin where another run ended (`policies.warm_start.prepare`).
      change: the settings may differ from those of the run to resume; changes.jsonl in its folder keeps how.
      debug: stop at the first number that is not finite and name it; on one device.

    Returns:
      The exit code: 0 when finished, 128 + the signal's number when interrupted (all saved), 1 when a seed (but not a
      trial) broke, `debug` found something or the folder could not be written any more.

    Raises:
      UsageError: a setting or the folder cannot be used; nothing has been written then.
    """
    jax.config.update("jax_default_matmul_precision", run_folder.MATMUL_PRECISION)
    check_loggers(loggers)
    jobs.check(config, workers, {"--devices": count, "--debug": debug, "--profile": profile})
    if not processes.is_first():
        say, loggers, profile = silent, (), None
    if profile is not None:
        profile.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts(say, claims.release_all))
        with tasks.announcing(say):
            setup = dataclasses.replace(_make_setup(config, trials, count, debug), jobs=workers)
        begin = None if resume and out and has_checkpoint(out) else warm_start(setup)
        out = processes.by_first(lambda: _claim_folder(stack, setup, out, resume, say, change))
        _describe(setup, out, say)
        if cache:
            use_cache()
        state, programs = (jobs.start if workers > 1 else compile_run)(setup, say)
        stack.callback(programs.close)
        trainer = Trainer(setup, programs, begin(state) if begin else state, out, say)
        return _run(trainer, stack, interrupts, lambda: trainer.open(stack, resume, loggers, profile))


def _make_setup(config: Config, trials: Trials | None, count: int | None, debug: bool) -> Setup:
    """The run's setup.

    Raises:
      UsageError: `debug` on several devices, or more memory than there is.
    """
    mesh = sharding.make_mesh(config, count)
    if debug and mesh:
        raise UsageError("--debug runs on one device in one process; leave out --devices")
    setup = dataclasses.replace(make_setup(config), trials=trials, mesh=mesh, debug=debug)
    check_memory(setup)
    return setup


def _run(trainer: Trainer, stack: contextlib.ExitStack, interrupts: Interrupts, begin: Callable[[], None]) -> int:
    """Trains to the end, or until something stops it; returns the exit code."""
    try:
        begin()
        trainer.train(interrupts)
        stack.close()
    except NotFinite as found:
        trainer.say(f"stopped: {found}; saved as of step {trainer.step:,}")
        return 1
    except jobs.Lost as lost:
        trainer.say(f"stopped: {lost}; saved as of step {trainer.step:,}. Continue with: {trainer.command}")
        return 1
    except OSError as error:
        with contextlib.suppress(OSError):  # what could not be written cannot be flushed either
            stack.close()
        trainer.say(trainer.write_failure(error))
        return 1
    return trainer.finish()


def _claim_folder(
    stack: contextlib.ExitStack, setup: Setup, out: pathlib.Path | None, resume: bool, say: Say, change: bool
) -> pathlib.Path:
    """The run folder, which belongs to this process until `stack` closes."""
    created = out is None
    out = out or run_folder.create(setup)
    run_folder.check_out(out, resume)
    stack.enter_context(claims.claim(out, created))
    run_folder.check_content(out, setup, resume, say, change)
    return out


def _describe(setup: Setup, out: pathlib.Path, say: Say) -> None:
    """Prints what will be trained, where and with what."""
    config, device = setup.config, jax.devices()[0]
    steps = config.num_updates * config.batch_size
    threads = f", {len(os.sched_getaffinity(0))} CPUs" if hasattr(os, "sched_getaffinity") else ""
    seeds = f"{config.seeds} seed(s) from {config.seed}"
    if setup.trials:
        seeds = f"{config.seeds} runs, seeds {setup.trials.seed.min()} to {setup.trials.seed.max()}"
    say(f"pmt: {config.method} on {config.task}, {seeds}, into {out}")
    say(f"device {device.device_kind} ({device.platform}{threads}), physics engine {setup.vector.env.engine}")
    advice = tasks.advice(setup.vector.env) if config.physics == "auto" else None
    if advice:
        say(advice)
    if setup.mesh:
        seeds, environments = setup.mesh.devices.shape
        say(
            f"{setup.mesh.size} devices in {jax.process_count()} process(es): seeds in {seeds} part(s), "
            f"each seed's environments in {environments}"
        )
    if setup.jobs > 1:
        say(f"{setup.jobs} worker processes share the seeds and the CPUs")
    say(
        f"batch {config.num_envs} environments x {config.rollout_length} steps = {config.batch_size:,} a seed, "
        f"{config.num_updates:,} updates = {steps:,} steps a seed"
    )


class Trainer:
    """A run: its setup, compiled programs, checkpoints, loggers, and where training stands.

    Attributes:
      state, best: of all seeds; a seed that broke keeps its last state that was finite.
      step: environment steps done by each seed that trains.
      seconds: spent on them, over all sessions.
      broken: {index of a seed: why it trains no more}.
    """

    def __init__(
        self, setup: Setup, programs: Programs, state: LearnerState, out: pathlib.Path, say: Say = say
    ) -> None:
        """Begins at the first `state`; `open` may replace it by a saved one."""
        self.setup, self.config, self.programs, self.out, self.say = setup, setup.config, programs, out, say
        self.state, self.best = state, run_folder.initial_best(state)
        self.step, self.seconds = 0, 0.0
        self.broken: dict[int, str] = {}
        self.total = self.config.num_updates * self.config.batch_size
        self._signal = 0
        self._loggers: list[Logger] = []

    def open(
        self,
        stack: contextlib.ExitStack,
        resume: bool,
        loggers: Sequence[str],
        profile: pathlib.Path | None,
    ) -> None:
        """Opens what is written to until `stack` closes, and continues from the newest checkpoint if `resume`."""
        if not resume:
            processes.by_first(lambda: run_folder.write_settings(self.out, self.setup))
        self.checkpoints = stack.enter_context(contextlib.closing(Checkpoints(self.out)))
        if resume:
            self._restore()
            if self.step < self.total:
                processes.by_first(lambda: run_folder.record_changes(self.out, self.step, self.config, self.say))
                processes.by_first(lambda: run_folder.write_settings(self.out, self.setup))
            else:
                run_folder.check_unchanged(self.out, self.step, self.config)
        processes.by_first(lambda: self._open_loggers(stack, loggers))
        self._profile = stack.enter_context(contextlib.closing(Profile(profile)))

    def _open_loggers(self, stack: contextlib.ExitStack, names: Sequence[str]) -> None:
        for logger in open_loggers(names, self.out, self.config, self.step):
            self._loggers.append(stack.enter_context(contextlib.closing(logger)))
        self._progress = stack.enter_context(contextlib.closing(Progress(self.total, self.step)))

    def _restore(self) -> None:
        """Continues from the newest checkpoint, if there is one, and deletes later traces of the run."""
        saved = {"last": self.state, "best": self.best}
        if self.checkpoints.steps():
            self.step, saved = self.checkpoints.load(saved, self.say)
        self.checkpoints.forget_after(self.step)
        rows = processes.by_first(lambda: run_folder.keep_rows_until(self.out, self.step, self.say))
        self.say(f"resuming after {self.step:,} steps")
        self.seconds = rows[-1]["seconds"] if rows else 0.0
        self.state = sharding.place(self.setup.mesh, saved["last"])
        best = saved["best"]
        self.best = dataclasses.replace(best, state=sharding.place(self.setup.mesh, best.state))
        if self.setup.debug:  # a seed that broke goes on from its last finite state, to be looked at
            return
        reasons = {row["seed"] - self.config.seed: row.get("broken") for row in rows}
        for i, update in enumerate(np.asarray(sharding.gather(self.state.update))):
            if int(update) * self.config.batch_size < self.step:  # beyond int32
                self.broken[i] = reasons.get(i) or f"seed {self.config.seed + i} broke before step {self.step:,}"

    # -----------------------------------------------------------------------------------------------------------------
    # The loop

    def train(self, interrupts: Interrupts) -> None:
        """Trains until done, interrupted, or no seed can train on; saves at intervals and at the end."""
        begin = saved = time.monotonic()
        before = self.seconds
        interrupts.save_first()
        while self.step < self.total and not self.all_broken and not self._agree_to_stop(interrupts):
            self._profile.before_chunk()
            before_chunk = self.state, self.step
            try:
                rows = self._train_chunk()
                self._evaluate(rows)
            except (NotFinite, jobs.Lost):
                self.state, self.step = before_chunk
                self._save()
                raise
            self.seconds = before + time.monotonic() - begin
            self._log(rows)
            self._keep_best(rows)
            if processes.agree(time.monotonic() - saved > CHECKPOINT_SECONDS):
                self._save()
                saved = time.monotonic()
        self._save()

    @property
    def all_broken(self) -> bool:
        """Whether no seed can train on."""
        return len(self.broken) == self.config.seeds

    def _agree_to_stop(self, interrupts: Interrupts) -> bool:
        """Whether a signal has reached any of the processes."""
        self._signal = processes.agree(interrupts.received[0] if interrupts.received else 0)
        return self._signal > 0

    def _train_chunk(self) -> list[Row]:
        """Trains all seeds for `log_interval` updates; those that break stay where they were."""
        begin = time.monotonic()
        state, metrics = self.programs.chunk(self.state)
        metrics = jax.device_get(metrics)
        self._rate = self.config.seeds * self.config.log_interval * self.config.batch_size / (time.monotonic() - begin)
        finite = metrics.pop("finite")
        self.step += self.config.log_interval * self.config.batch_size
        rows = make_rows(self.setup, self.step, metrics)
        gone = dict(self.broken)
        self._find_broken(rows, finite)
        if self.broken:
            broken = np.array([i in self.broken for i in range(self.config.seeds)])
            state = self.programs.take(broken, state, self.state)  # self.state stays whole: `train` may go back to it
        self.state = state
        for i, reason in self.broken.items():
            rows[i] = without_metrics(rows[i], reason) if i in gone else rows[i] | {"broken": reason}
        return rows

    def _find_broken(self, rows: list[Row], finite: np.ndarray) -> None:
        overflow = health.overflow(self.setup, [row for i, row in enumerate(rows) if i not in self.broken])
        for i, row in enumerate(rows):
            reason = overflow or health.diagnose(self.setup, i, row, bool(finite[i]))
            if reason and i not in self.broken:
                self.broken[i] = reason

    def _evaluate(self, rows: list[Row]) -> None:
        """Adds the columns of an evaluation, nan if none is due."""
        if self.programs.evaluate is None:
            return
        updates = self.step // self.config.batch_size
        due = updates % self.config.eval_interval < self.config.log_interval and not self.all_broken
        nothing = dict.fromkeys(self.programs.measures, (math.nan, math.nan))
        results = seed_intervals(jax.device_get(self.programs.evaluate(self.state))) if due else [nothing] * len(rows)
        for i, (row, result) in enumerate(zip(rows, results, strict=True)):
            row |= evaluation_columns(nothing if i in self.broken else result)

    def _log(self, rows: list[Row]) -> None:
        for row in rows:
            row["seconds"] = round(self.seconds, 3)

        def write() -> None:
            for logger in self._loggers:
                logger.write(rows)
            self._progress.show(rows, self._rate)

        processes.by_first(write)

    def _keep_best(self, rows: list[Row]) -> None:
        """Keeps each seed's state if it is the best so far, by the evaluation if there is one, else by training."""
        prefix = "eval/" if self.config.eval_interval else ""
        whole = [not row["broken"] for row in rows]
        reward = np.where(whole, np.asarray([row[f"{prefix}episode_reward"] for row in rows], np.float32), np.nan)
        cost, limit = np.asarray([judged_cost(row, prefix) for row in rows], np.float32).T
        cost = np.where(whole, cost, np.nan)
        best_reward, best_cost = np.asarray(self.best.reward), np.asarray(self.best.cost)
        improved = is_better(reward, cost, best_reward, best_cost, limit)
        if improved.any():
            state = self.programs.take(improved, self.best.state, self.state)
            self.best = Best(state, np.where(improved, reward, best_reward), np.where(improved, cost, best_cost))

    def _save(self) -> None:
        self.checkpoints.save(self.step, {"last": self.state, "best": self.best})

    # -----------------------------------------------------------------------------------------------------------------
    # The end

    def finish(self) -> int:
        """Prints how training ended and what to do next; returns the exit code."""
        self._list_broken()
        if self.step < self.total and not self.all_broken:
            self.say(f"interrupted after {self.step:,} steps; saved. Continue with: {self.command}")
            return 128 + self._signal
        if not self.all_broken:
            next_step = "" if self.setup.trials else f"; evaluate with: {shlex.join(['pmt', 'eval', str(self.out)])}"
            self.say(f"done: {self.step:,} steps in {duration(self.seconds)}{next_step}")
        # A trial that diverges is a result of its sweep, lost contacts are not.
        overflow = any(health.NO_ROOM in reason for reason in self.broken.values())
        return int(overflow or (bool(self.broken) and not self.setup.trials))

    def _list_broken(self) -> None:
        """Prints which seeds broke and why, the first few in full."""
        reasons = list(dict.fromkeys(self.broken.values()))
        for reason in reasons[:MOST_REASONS]:
            self.say(f"stopped: {reason}")
        if len(reasons) > MOST_REASONS:
            self.say(f"stopped: {len(reasons) - MOST_REASONS} more, see `broken` in {self.out / 'metrics.jsonl'}")
        if self.broken and not self.setup.trials:
            seeds = ", ".join(str(self.config.seed + i) for i in sorted(self.broken))
            self.say(f"seed(s) {seeds} broke; the last finite state and the best of every seed are saved in {self.out}")

    def write_failure(self, error: OSError) -> str:
        """What to do about a full disk, a quota, or a share that is gone."""
        begun = (self.out / "config.toml").is_file()
        then = f"continue: {self.command}" if begun else "train again into another --out"
        why = error.strerror or error
        return f"stopped: cannot write into {self.out}: {why}. What was saved is whole; make room and {then}"

    @property
    def command(self) -> str:
        """What continues the run."""
        if self.setup.trials:
            return "the same command"
        if jax.process_count() > 1:
            return "the same command with --resume"
        split = f" --devices {self.setup.mesh.size}" if self.setup.mesh else ""
        split += f" --jobs {self.setup.jobs}" if self.setup.jobs > 1 else ""
        return toml.resume_command(str(self.out)) + split
