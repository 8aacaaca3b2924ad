"""A run from its settings to its end: the task, the folder and the compiled programs, which `loop` then runs."""

from __future__ import annotations

import contextlib
import pathlib
from collections.abc import Callable, Sequence

import jax

from .. import tasks
from ..config.settings import Config
from ..learning import sharding
from ..learning.setup import Setup, Trials, make_setup
from ..learning.types import LearnerState
from ..output import Say, say, silent
from . import failures, lock, outlook, processes
from .compile import Programs, check_memory, compile_run, use_cache
from .loggers import check_loggers
from .loop import Conclude, Trainer, run
from .progress import alive
from .run_folder import MATMUL_PRECISION, Rescue, RunFolder
from .signals import Interrupts
from .workers import check_workers, start_workers

WarmStart = Callable[[Setup], Callable[[LearnerState], LearnerState] | None]


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
    devices: int | None = None,
    workers: int = 1,
    warm_start: WarmStart = lambda setup: None,
    debug: bool = False,
    change: bool = False,
    rescue: Rescue | None = None,
    conclude: Conclude = lambda folder: (),
) -> int:
    """Trains `config.seeds` seeds side by side and leaves a run folder behind.

    Args:
      out: the run folder; a new one, runs/TASK-METHOD-TIME, if None. It must not hold another run unless `resume`.
      resume: continue the run in `out` from its last checkpoint, bit for bit.
      cache: keep compiled programs on disk; loggers: where rows also go to: csv, tensorboard, wandb.
      profile: a folder for a JAX profiler trace of a few chunks.
      trials: settings and seeds of `config.seeds` trials, in place of the config's.
      devices: how many to split the run over, of all processes together: one if None, or all of several processes'.
      workers: processes that share the seeds and the CPUs (see workers.py).
      warm_start: what makes the first state begin where another run ended (`policies.warm_start.prepare`).
      change: the settings may differ from those of the run to resume; changes.jsonl in its folder keeps how.
      debug: stop at the first number that is not finite and name it; on one device.
      rescue: where the run is saved if its folder is gone; next to it if None.
      conclude: what is printed at the end of a run that has ended (`studies.verdict.lines`).

    Returns:
      The exit code: 0 when finished, 128 + the signal's number when interrupted (all saved), 1 when a seed (but not a
      trial) broke, `debug` found something, a program failed, or the folder is gone or could not be written any more.
      All processes return the same, and end with `processes.TRY_AGAIN` if one is gone; the first writes and prints.

    Raises:
      UsageError: a setting or the folder cannot be used; nothing has been written then.
    """
    jax.config.update("jax_default_matmul_precision", MATMUL_PRECISION)
    check_loggers(loggers)
    check_workers(config, workers, {"--devices": devices, "--debug": debug, "--profile": profile})
    if not processes.is_first():
        say, loggers, profile = silent, (), None
    if profile is not None:
        profile.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts(say, lock.release_all))
        setup = _make_setup(config, trials, devices, workers, debug, say)
        folder = stack.enter_context(contextlib.closing(RunFolder(setup, say, rescue)))
        folder.acquire(out, resume, change)
        begin = None if folder.saved else warm_start(setup)
        outlook.describe(setup, folder.path, say)
        state, programs = _compile(setup, cache, say)
        stack.callback(programs.close)
        trainer = Trainer(setup, programs, begin(state) if begin else state, folder, say)
        return run(trainer, stack, interrupts, lambda: trainer.open(stack, resume, loggers, profile), conclude)


def _make_setup(
    config: Config, trials: Trials | None, devices: int | None, workers: int, debug: bool, say: Say
) -> Setup:
    """The run's setup.

    Raises:
      UsageError: it needs more devices or memory than there are, or what `make_setup` raises.
    """
    mesh = sharding.make_mesh(config, devices)
    with tasks.announcing(say):
        setup = make_setup(config, trials=trials, mesh=mesh, workers=workers, debug=debug)
    check_memory(setup)
    return setup


def _compile(setup: Setup, cache: bool, say: Say) -> tuple[LearnerState, Programs]:
    """The first state and the run's programs, in this process or in its workers."""
    if cache:
        use_cache()
    with failures.named(), alive("compiling", say):
        return (start_workers if setup.workers > 1 else compile_run)(setup, say)
