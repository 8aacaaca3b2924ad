"""The loop of a run over chunks of updates: where it stands, what is saved of it, and how it ends."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import math
import os
import pathlib
import shlex
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..config import load
from ..learning import sharding
from ..learning.debug import NotFinite
from ..learning.evaluation import is_better
from ..learning.setup import Setup
from ..learning.types import Best, LearnerState
from ..output import Say, say
from . import chunks, failures, final, health, lock, processes
from .checkpoint import CHECKPOINT_SECONDS, unpack
from .compile import Programs
from .history import checkpoint_steps
from .loggers import Profile
from .metrics import Row, evaluation_columns, judged_cost, make_rows, seed_intervals, without_metrics
from .progress import Progress, alive, duration
from .run_folder import RunFolder
from .signals import Interrupts
from .workers import WorkerLost

Conclude = Callable[[pathlib.Path], Sequence[str]]
MOST_REASONS = 5  # of seeds that broke, printed at the end


def run(
    trainer: Trainer,
    stack: contextlib.ExitStack,
    interrupts: Interrupts,
    begin: Callable[[], None],
    conclude: Conclude,
) -> int:
    """Trains to the end, or until something stops it; returns the exit code.

    Args:
      stack: closes what `begin` opens.
      interrupts: the signals that reach this process.
      begin: what comes before the first chunk (`Trainer.open`).
      conclude: as for `trainer.train`.
    """
    try:
        begin()
        trainer.train(interrupts)
        stack.close()
    except processes.Parted as parted:
        say(trainer.parted(parted))  # every process: the first may be the one that is gone
        lock.release_all()
        os._exit(processes.TRY_AGAIN)  # JAX's own end waits for the others
    except lock.Gone as gone:
        trainer.say(trainer.rescue(gone))
        return 1
    except NotFinite as found:
        trainer.say(f"stopped: {found}; saved as of step {trainer.step:,}")
        return 1
    except (failures.Failed, WorkerLost) as failure:
        trainer.say(f"stopped: {failure}; {trainer.saved}. Continue with: {trainer.command}")
        return 1
    except OSError as error:
        with contextlib.suppress(OSError):  # what could not be written cannot be flushed either
            stack.close()
        trainer.say(trainer.write_failure(error))
        return 1
    return trainer.finish(conclude)


class Trainer:
    """A run: its setup, compiled programs, checkpoints, loggers, and where training stands.

    Attributes:
      state, best: of all seeds; a seed that broke keeps its last state that was finite.
      step: environment steps done by each seed that trains.
      seconds: spent on them, over all sessions.
      broken: {index of a seed: why it trains no more}.
    """

    def __init__(
        self, setup: Setup, programs: Programs, state: LearnerState, folder: RunFolder, say: Say = say
    ) -> None:
        """Begins at the first `state`; `open` may replace it by a saved one."""
        self.setup, self.config, self.programs, self.folder, self.say = setup, setup.config, programs, folder, say
        self.state, self.best = state, Best.initial(state)
        self.step, self.seconds = 0, 0.0
        self.broken: dict[int, str] = {}
        self.faults: collections.Counter[str] = collections.Counter()
        self.total = self.config.total_steps
        self._row, self._row_start, self._row_updates = chunks.OpenRow(), state, 0
        self._speed: float | None = None  # seconds that an update took in the last chunk
        self._busy = threading.Lock()  # held by whoever may change or save what is below, except while programs run
        self._busy.acquire()
        self._signal = 0
        self._progress: Progress | None = None
        self._is_open = self._is_left = False  # begun to write; interrupted before the evaluation that ends the run

    def open(
        self,
        stack: contextlib.ExitStack,
        resume: bool,
        loggers: Sequence[str],
        profile: pathlib.Path | None,
    ) -> None:
        """Opens what is written to until `stack` closes, and continues from the newest checkpoint if `resume`."""
        if resume:
            self._restore()
        else:
            self.folder.begin()
        self.folder.open_loggers(loggers, self.step)
        if processes.is_first():
            self._progress = stack.enter_context(contextlib.closing(Progress(self.total, self.step)))
        self._profile = stack.enter_context(contextlib.closing(Profile(profile)))
        self._is_open = True

    def _restore(self) -> None:
        """Continues from the newest checkpoint, if there is one."""
        tree, row = {"last": self.state, "best": self.best}, {}
        if saved := self.folder.saved:
            self.step, tree, row = saved.step, unpack(saved.packed, tree), dict(saved.row)
        rows = self.folder.resume(self.step, ended=self.step >= self.total)
        self.say(f"resuming after {self.step:,} steps")
        seconds = row.pop("seconds", np.array([rows[-1]["seconds"] if rows else 0.0]))
        self._row, self.seconds = chunks.OpenRow.of(row), float(seconds[0])
        for each in rows:
            self.faults += health.count_faults(each, self.config.eval_episodes)
        self.state = self._row_start = sharding.place(self.setup.mesh, tree["last"])
        best = tree["best"]
        self.best = dataclasses.replace(best, state=sharding.place(self.setup.mesh, best.state))
        if self.setup.debug:  # a seed that broke goes on from its last finite state, to be looked at
            return
        reasons = {row["seed"] - self.config.seed: row.get("broken") for row in rows}
        for i, update in enumerate(np.asarray(sharding.gather(self.state.update))):
            # One that an evaluation broke has no update less.
            if reasons.get(i) or int(update) * self.config.batch_size < self.step:  # beyond int32
                self.broken[i] = reasons.get(i) or f"seed {self.config.seed + i} broke before step {self.step:,}"

    # -----------------------------------------------------------------------------------------------------------------
    # The loop

    def train(self, interrupts: Interrupts) -> None:
        """Trains until done, interrupted, or no seed can train on; saves at intervals and at the end."""
        begin = saved = time.monotonic()
        before = self.seconds
        interrupts.save_first(self._rescue)
        while self.step < self.total and not self.all_broken and not self._agree_to_stop(interrupts):
            self._profile.before_chunk()
            self._before = self.state, self.step, self._row, self._row_start, dict(self.broken)
            try:
                with failures.named(), self._others_may_save():
                    rows = self.train_chunk()
                    self.evaluate(rows)
            except BaseException as error:
                self._go_back()
                self._save_before(error)
                raise
            self.seconds = before + time.monotonic() - begin
            if rows:
                self._log(rows)
                self.keep_best(rows)
            self.folder.check()
            if processes.agree(time.monotonic() - saved > CHECKPOINT_SECONDS):
                self.save()
                saved = time.monotonic()
        self.save()
        if self.step >= self.total and not self.all_broken:
            self._evaluate_finally(interrupts)

    def _evaluate_finally(self, interrupts: Interrupts) -> None:
        """The evaluation that ends the run, unless it has been made; a signal leaves it to --resume."""
        if self.folder.is_evaluated(self.step):
            return
        if self._agree_to_stop(interrupts):
            self._is_left = True
            return
        assert self.programs.final
        self.say(f"evaluating {final.episodes(self.setup)} episodes a seed under mean actions ...")
        self._before = self.state, self.step, self._row, self._row_start, dict(self.broken)
        try:
            with failures.named(), self._others_may_save(), alive("evaluating", self.say):
                results = self.programs.final(self.state)
            if self.setup.overflow and np.any(results[self.setup.overflow] > 0):
                raise failures.Failed(health.NO_ROOM)
        except (failures.Failed, WorkerLost) as failure:  # what was trained is whole
            self.say(f"note: the evaluation could not be made: {failure}")
            return
        self.folder.write_evaluation(final.rows(self.setup, self.step, results, set(self.broken)))

    @contextlib.contextmanager
    def _others_may_save(self) -> Iterator[None]:
        """While programs run inside, another thread may end the process (see `_rescue`)."""
        self._busy.release()
        try:
            yield
        finally:
            self._busy.acquire()

    def _go_back(self) -> None:
        """Forgets what came after the last whole chunk."""
        self.state, self.step, self._row, self._row_start, self.broken = self._before

    def _rescue(self) -> str:
        """Saves the state before a chunk that takes too long; the last words of the process, "" if it must wait."""
        if jax.process_count() > 1:  # all would have to save at the same point
            return ""
        self._busy.acquire()  # and never released: the process ends
        self._go_back()
        try:
            with contextlib.suppress(jax.errors.JaxRuntimeError):
                self.save()
        except lock.Gone as gone:
            return self.rescue(gone)
        except OSError as error:
            return self.write_failure(error)
        return f"interrupted in a long chunk: {self.saved}. Continue with: {self.command}"

    @property
    def all_broken(self) -> bool:
        """Whether no seed can train on."""
        return len(self.broken) == self.config.seeds

    def _agree_to_stop(self, interrupts: Interrupts) -> bool:
        """Whether a signal has reached any of the processes."""
        self._signal = processes.agree(interrupts.received[0] if interrupts.received else 0)
        return self._signal > 0

    def train_chunk(self) -> list[Row]:
        """Trains all seeds for some updates; the rows, if one ends with them.

        Seeds that break stay where they were when the row began.
        """
        done, begin = self.step // self.config.batch_size, time.monotonic()
        updates = processes.agree(chunks.plan(self.config, done, self._speed))
        state, metrics = self.programs.chunk(self.state, updates)
        self._row = self._row.then(updates, jax.device_get(metrics))
        self._speed = (time.monotonic() - begin) / updates
        self.step += updates * self.config.batch_size
        gone, rows = dict(self.broken), []
        lost = [i in self.broken or hopeless for i, hopeless in enumerate(self._row.hopeless)]
        if done + updates == chunks.row_end(self.config, done) or all(lost):
            rows = self._end_row()
        if self.broken:
            broken = np.array([i in self.broken for i in range(self.config.seeds)])
            # The row's start stays whole: `train` may go back to it.
            state = self.programs.where_seed(broken, state, self._row_start)
        self.state = state
        if rows:
            self._row, self._row_start, self._row_updates = chunks.OpenRow(), state, self._row.updates
        for i, reason in self.broken.items():
            if rows:
                rows[i] = without_metrics(rows[i], reason) if i in gone else rows[i] | {"broken": reason}
        return rows

    def _end_row(self) -> list[Row]:
        """The rows of the updates since the last ones, and which seeds broke meanwhile."""
        metrics = dict(self._row.metrics)
        finite, spread = metrics.pop("finite"), metrics.pop("cost_spread", np.zeros((self.config.seeds, 1)))
        rows = make_rows(self.setup, self.step, metrics)
        overflow = health.overflow(self.setup, [row for i, row in enumerate(rows) if i not in self.broken])
        steps = self._row.updates * self.config.batch_size
        for i, row in enumerate(rows):
            reason = overflow or health.unshared(row, spread[i].max())
            reason = reason or health.diagnose(self.setup, i, row, bool(finite[i]), steps)
            if reason and i not in self.broken:
                self.broken[i] = reason
        return rows

    def evaluate(self, rows: list[Row]) -> None:
        """Adds the columns of an evaluation, nan if none is due."""
        if self.programs.evaluate is None or not rows:
            return
        updates, interval = self.step // self.config.batch_size, self.config.eval_interval
        # A whole multiple of the interval is among the updates of the row.
        due = updates % interval < self._row_updates and not self.all_broken
        nothing = dict.fromkeys(self.programs.measures, (math.nan, math.nan))
        results = seed_intervals(jax.device_get(self.programs.evaluate(self.state))) if due else [nothing] * len(rows)
        for i, (row, result) in enumerate(zip(rows, results, strict=True)):
            row |= evaluation_columns(nothing if i in self.broken else result)
            if reason := health.diagnose_evaluation(self.setup, row):
                self.broken[i] = row["broken"] = reason

    def _log(self, rows: list[Row]) -> None:
        for row in rows:
            row["seconds"] = round(self.seconds, 3)
            self.faults += health.count_faults(row, self.config.eval_episodes)
        self.folder.log(rows)
        if self._progress:
            assert self._speed is not None  # a chunk has ended
            self._progress.show(rows, self.config.seeds * self.config.batch_size / self._speed)

    def keep_best(self, rows: list[Row]) -> None:
        """Keeps each seed's state if it is the best so far, by the evaluation if there is one, else by training."""
        prefix = "eval/" if self.config.eval_interval else ""
        whole = [not row["broken"] for row in rows]
        reward = np.where(whole, np.asarray([row[f"{prefix}episode_reward"] for row in rows], np.float32), np.nan)
        cost, limit = np.asarray([judged_cost(row, prefix) for row in rows], np.float32).T
        cost = np.where(whole, cost, np.nan)
        best_reward, best_cost = np.asarray(self.best.reward), np.asarray(self.best.cost)
        improved = is_better(reward, cost, best_reward, best_cost, limit)
        if improved.any():
            state = self.programs.where_seed(improved, self.best.state, self.state)
            self.best = Best(state, np.where(improved, reward, best_reward), np.where(improved, cost, best_cost))

    @property
    def _tree(self) -> dict[str, Any]:
        """What a checkpoint holds: the states, and what is known of a row that has not ended."""
        state = self.state
        lost = ~np.asarray(self._row.metrics.get("finite", np.ones(self.config.seeds, bool)))
        if lost.any():  # the end of the row will say why
            state = self.programs.where_seed(lost, jax.tree.map(jnp.copy, state), self._row_start)
        row = dict(self._row.metrics) | {"seconds": np.full(self.config.seeds, self.seconds)}
        return {"last": state, "best": self.best, "row": row}

    def save(self) -> None:
        """Writes a checkpoint after the step that training has reached."""
        self.folder.save(self.step, self._tree)

    def _save_before(self, error: BaseException) -> None:
        """Saves the state before the chunk in which `error` was raised, if the device still returns it."""
        if not isinstance(error, Exception) or jax.process_count() > 1:  # others would wait for this one for ever
            return
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            self.save()

    @property
    def saved(self) -> str:
        """How much of the run its newest checkpoint holds, in words."""
        newest = next(iter(self.folder.checkpoints.steps()), None)
        if newest == self.step:
            return f"saved as of step {self.step:,}"
        return "nothing could be saved" if newest is None else f"what came after step {newest:,} could not be saved"

    # -----------------------------------------------------------------------------------------------------------------
    # The end

    def finish(self, conclude: Conclude = lambda folder: ()) -> int:
        """Prints how training ended and what to do next; returns the exit code.

        Args:
          conclude: as for `train`.
        """
        self._list_broken()
        if wrong := health.faults(self.faults, self.step * self.config.seeds):
            self.say(f"note: {wrong}")
        if (self.step < self.total or self._is_left) and not self.all_broken:
            self.say(f"interrupted after {self.step:,} steps; saved. Continue with: {self.command}")
            return 128 + self._signal
        if not self.all_broken:
            next_step = (
                "" if self.setup.trials else f"; evaluate with: {shlex.join(['pmt', 'eval', str(self.folder.path)])}"
            )
            self.say(f"done: {self.step:,} steps in {duration(self.seconds)}{next_step}")
            for line in conclude(self.folder.path) if processes.is_first() else ():
                self.say(line)
        # A trial that diverges is a result of its sweep, lost contacts are not.
        overflow = any(health.NO_ROOM in reason for reason in self.broken.values())
        return int(overflow or (bool(self.broken) and not self.setup.trials))

    def _list_broken(self) -> None:
        """Prints which seeds broke and why, the first few in full."""
        reasons = list(dict.fromkeys(self.broken.values()))
        for reason in reasons[:MOST_REASONS]:
            self.say(f"stopped: {reason}")
        if len(reasons) > MOST_REASONS:
            self.say(
                f"stopped: {len(reasons) - MOST_REASONS} more, see `broken` in {self.folder.path / 'metrics.jsonl'}"
            )
        if self.broken and not self.setup.trials:
            seeds = ", ".join(str(self.config.seed + i) for i in sorted(self.broken))
            where = self.folder.path
            self.say(f"seed(s) {seeds} broke; the last finite state and the best of every seed are saved in {where}")

    def rescue(self, gone: lock.Gone) -> str:
        """Saves a run next to its folder that is gone; returns what happened and how to continue."""
        if not self._is_open:
            return f"stopped: {gone}; nothing new was trained yet"
        try:
            saved = self.folder.rescue(self.step, self._tree)
        except OSError as error:
            return (
                f"stopped: {gone}; what was trained is lost, as no folder next to it can be written: {error.strerror}"
            )
        return f"stopped: {gone}; saved as of step {self.step:,} in {saved}. Continue with: {self._continuing(saved)}"

    def parted(self, parted: processes.Parted) -> str:
        """What happened to a run of several processes, one of which is gone, and how to continue."""
        steps = checkpoint_steps(self.folder.path)
        saved = f"saved as of step {steps[0]:,}" if steps else "nothing was saved here yet"
        return f"stopped: {parted}; {saved}. Continue with: {self.command}"

    def write_failure(self, error: OSError) -> str:
        """What to do about a full disk, a quota, or a share that is gone."""
        begun = (self.folder.path / "config.toml").is_file()
        then = f"continue: {self.command}" if begun else "train again into another --out"
        why = error.strerror or error
        return f"stopped: cannot write into {self.folder.path}: {why}. What was saved is whole; make room and {then}"

    @property
    def command(self) -> str:
        """What continues the run."""
        return self._continuing(self.folder.path)

    def _continuing(self, out: pathlib.Path) -> str:
        """What continues the run in `out`."""
        moved = out != self.folder.path
        if self.setup.trials:
            return "the same command" + " with the first part of that path as --out" * moved
        if jax.process_count() > 1:
            return "the same command with --resume" + f" --out {shlex.quote(str(out))}" * moved
        split = f" --devices {self.setup.mesh.size}" if self.setup.mesh else ""
        split += f" --workers {self.setup.workers}" if self.setup.workers > 1 else ""
        return load.resume_command(str(out)) + split
