"""How good and how safe a trained team is: whole episodes under fixed keys, with intervals."""

from __future__ import annotations

import pathlib
import warnings
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from .. import tasks
from ..errors import UsageError
from ..files import check_writable, writing
from ..learning.evaluation import STEP, play
from ..learning.setup import Setup
from ..learning.types import ActingState
from ..limits import Limits
from ..training import failures
from ..training.compile import evaluate_seeds
from ..training.health import FAULTS, NO_ROOM, faults
from ..training.metrics import seed_intervals
from ..training.run_folder import MATMUL_PRECISION
from . import hub, minari_dataset
from .load import load_run


def evaluate_run(
    out: pathlib.Path,
    episodes: int,
    deterministic: bool,
    which: str = "last",
    physics: str | None = None,
    say: Callable[[str], object] = warnings.warn,
    save: pathlib.Path | None = None,
) -> list[dict[str, Any]]:
    """One row per seed of a run: each metric's mean over episodes and the half-width of its 95 % interval.

    `faults` says which steps broke the contract of tasks; it is empty if none did.

    A state that was chosen, a pretrained policy or `best`, is evaluated from other starts than it was chosen by.

    Args:
      out: the run folder, which is only read, or the name of a pretrained policy.
      deterministic: take mean actions instead of samples.
      which: `last` or `best`.
      physics: an engine other than the run's.
      say: called with a sentence for each damaged checkpoint, which is passed over.
      save: an .npz file for every step of every episode (docs/howto/evaluate.md lists its arrays), or the name of a
        Minari data set, minari:NAME-v0.

    Raises:
      UsageError: there is no such run, the physics lost contacts, or `save` cannot be written.
    """
    _check_place(save)
    chosen = which == "best" or hub.is_name(out)
    return evaluate_states(*load_run(out, which, physics, say), episodes, deterministic, fresh=chosen, save=save)


def evaluate_states(
    setup: Setup,
    state: ActingState,
    episodes: int,
    deterministic: bool,
    fresh: bool,
    save: pathlib.Path | None = None,
) -> list[dict[str, Any]]:
    """The rows of `evaluate_run` for learner states with a leading [seeds], or what of them acts.

    Args:
      fresh: from starts other than those that training and `publish` choose by.
    """
    jax.config.update("jax_default_matmul_precision", MATMUL_PRECISION)
    program = evaluate_seeds(setup, episodes, deterministic, fresh, record=save is not None)
    with failures.named():
        results = jax.device_get(jax.jit(program)(state))
    if setup.overflow and np.any(results[setup.overflow] > 0):
        raise UsageError(f"{NO_ROOM}; evaluate with another --physics")
    if save:
        results = _save_steps(save, results, setup.config.seed)
    wrong = _take_faults(results)
    return [
        {"seed": setup.config.seed + i, **setup.limits.columns, "step": step, "faults": wrong[i], **figures}
        for i, (figures, step) in enumerate(zip(seed_intervals(results), _steps(setup, state), strict=True))
    ]


def _steps(setup: Setup, state: ActingState) -> list[int]:
    return [int(update) * setup.config.batch_size for update in state.update]


def evaluate_baseline(
    task: str, policy: str, episodes: int, options: dict[str, Any], save: pathlib.Path | None = None
) -> dict[str, Any]:
    """Evaluates a policy that is not learned, over the same episodes as `evaluate_run`.

    Raises:
      UsageError: unknown task, option or policy, or `save` cannot be written.
    """
    _check_place(save)
    env = tasks.make(task, **options)
    act = jax.vmap(tasks.baseline(env, policy))
    record = save is not None
    with failures.named():
        results = jax.device_get(jax.jit(lambda: play(env, lambda state, _: act(state), episodes, record=record))())
    one_seed = {name: x[None] for name, x in results.items()}
    if save:
        one_seed = _save_steps(save, one_seed, 0)
    (wrong,) = _take_faults(one_seed)
    (figures,) = seed_intervals(one_seed)
    return {**Limits.of_task(env.spec).columns, "faults": wrong, **figures}


def _take_faults(results: dict[str, np.ndarray]) -> list[str]:
    """Removes the counts of steps that broke the contract of tasks; says for every seed what was wrong, "" if nothing.

    Args:
      results: metrics [seeds, episodes].
    """
    counts = {name: results.pop(name).sum(1).astype(int).tolist() for name in FAULTS}
    steps = results["episode_length"].sum(1).astype(int).tolist()
    return [faults({name: x[i] for name, x in counts.items()}, total) for i, total in enumerate(steps)]


def _check_place(save: pathlib.Path | None) -> None:
    """Refuses, before anything is evaluated, what could not be written."""
    if save is not None and str(save).startswith(minari_dataset.PREFIX):
        minari_dataset.check(str(save))
    elif save is not None and save.suffix != ".npz":
        raise UsageError(f"cannot write {save}: its ending must be .npz, or its beginning {minari_dataset.PREFIX}")
    elif save is not None:
        check_writable(save, "--save")


def _save_steps(out: pathlib.Path, results: dict[str, np.ndarray], first_seed: int) -> dict[str, np.ndarray]:
    """Writes what was recorded of every step [seeds, horizon, episodes, ...] as [seeds, episodes, steps, ...].

    Of the observations after a step, the last of an episode is kept; the others are those before the next step.

    Returns:
      the other metrics.
    """
    length = results["episode_length"].astype(np.int32)
    recorded = {name: x.swapaxes(1, 2)[:, :, : length.max()] for name, x in results.items() if name.startswith(STEP)}
    table: dict[str, Any] = {"seed": np.arange(first_seed, first_seed + len(length)), "length": length}
    table |= {name.removeprefix(STEP): x for name, x in recorded.items()}
    last = np.maximum(length - 1, 0)[:, :, None, None, None]
    table["final_obs"] = np.take_along_axis(table.pop("next_obs"), last, axis=2)[:, :, 0]
    if str(out).startswith(minari_dataset.PREFIX):
        minari_dataset.write(str(out), table)
        return {name: x for name, x in results.items() if name not in recorded}
    with writing(out, "--save") as partial, partial.open("wb") as file:
        np.savez_compressed(file, **table)
    return {name: x for name, x in results.items() if name not in recorded}
