"""A trained team from its run folder or from the hub: as a learner state, and as a pure function."""

from __future__ import annotations

import pathlib
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ..config.load import load_config
from ..errors import UsageError
from ..learning.setup import Setup
from ..learning.types import ActingState
from ..tasks import did_you_mean
from ..training.run_folder import MATMUL_PRECISION, load_saved
from ..trust import check, trusting
from . import hub

WHICH = ("last", "best")

Policy = Callable[..., Any]  # see `policy_function`


def check_trusted(folder: pathlib.Path) -> None:
    """Refuses a run whose task or method is in a Python file that this user has neither trained with nor said to trust.

    Raises:
      UsageError: loading the run would execute that file, or one in the run folder.
    """
    if not hub.is_name(folder) and (folder / "config.toml").is_file():
        config = load_config(folder / "config.toml")
        for name in (config.task, config.method):
            check(name, f"{folder} is a run of", folder)


def load_run(
    folder: pathlib.Path,
    which: str = "last",
    physics: str | None = None,
    warn: Callable[[str], object] = warnings.warn,
) -> tuple[Setup, ActingState]:
    """A run's settings and a learner state of it, with a leading [seeds].

    Args:
      folder: the run folder, or the name of a pretrained policy, which holds only what acts, of one seed.
      which: `last`, or `best`: each seed's own best (see docs/howto/evaluate.md).
      physics: an engine other than the run's.
      warn: called with a sentence for each damaged checkpoint, which is passed over.

    Raises:
      UsageError: the folder holds no run, or no checkpoint; or there is no such policy.
    """
    if which not in WHICH:
        raise UsageError(f"unknown checkpoint '{which}'{did_you_mean(which, WHICH)}")
    if hub.is_name(folder):
        return hub.load(str(folder), physics)
    if not pathlib.Path(folder).exists() and f"{hub.PREFIX}{folder}" in hub.names():
        raise UsageError(f"{folder} is a pretrained policy, not a run folder; name it {hub.PREFIX}{folder}")
    check_trusted(folder)
    setup, _, saved = load_saved(folder, physics, warn)
    return setup, saved["last"] if which == "last" else saved["best"].state


def load_policy(
    folder: str | pathlib.Path, seed: int | None = None, which: str = "last", trust: bool = False
) -> Policy:
    """A run's team policy as a pure function, to be jitted and vmapped at will.

    Args:
      folder: the run folder, which is only read, or the name of a pretrained policy: `hub:ant_2x4/r4sg`.
      seed: one of the run's seeds; its first if None.
      which: `last`, or `best`: the seed's own best (see docs/howto/evaluate.md).
      trust: execute the task's Python file even if you have not trained with it, and remember it.

    Returns:
      policy: raw observations obs [N, O] -> mean action [N, A], 0 where an agent has no such entry. Observations are
        normalised inside; the task clips actions by its own rule. One of a recurrent run is
        (obs, hidden [N, H]) -> (action, hidden); without `hidden` an episode begins.

    Raises:
      UsageError: no run, no checkpoint, or no such seed.
    """
    with trusting(trust):
        setup, _, state = load_seed(folder, seed, which, physics="auto")  # nothing will be simulated
    return policy_function(setup, state)


def load_seed(
    folder: str | pathlib.Path, seed: int | None = None, which: str = "last", physics: str | None = None
) -> tuple[Setup, int, ActingState]:
    """A run's setup, one of its seeds (its first if None), and that seed's learner state.

    Raises:
      UsageError: as `load_run`, or the run has no such seed.
    """
    setup, states = load_run(pathlib.Path(folder), which, physics)
    first, count = setup.config.seed, setup.config.seeds
    chosen = first if seed is None else seed
    if chosen not in range(first, first + count):
        raise UsageError(f"{folder} has no seed {seed}; it has {', '.join(map(str, range(first, first + count)))}")
    return setup, chosen, jax.tree.map(lambda x: x[chosen - first], states)


def policy_function(setup: Setup, state: ActingState) -> Policy:
    """The mean action of one seed's policy: obs [N, O] -> action [N, A], padded entries 0.

    A recurrent one is (obs, hidden [N, H]) -> (action, hidden); without `hidden` an episode begins. Both raise a
    UsageError for observations of another shape.
    """
    mask = jnp.asarray(setup.vector.spec.action_mask)
    memory = setup.nets.start(1)
    expected = (setup.vector.spec.num_agents, setup.vector.spec.obs_dim)

    def act(obs: jax.Array, hidden: jax.Array | None) -> tuple[jax.Array, jax.Array | None]:
        if jnp.shape(obs)[-2:] != expected:
            raise UsageError(f"this policy takes observations [..., N, O] that end in {expected}, not {jnp.shape(obs)}")
        with jax.default_matmul_precision(MATMUL_PRECISION):
            mean, _, hidden = setup.nets.act(state.actor.params, setup.scale(state.obs_moments, obs), hidden)
        return mean * mask, hidden

    def policy(obs: jax.Array) -> jax.Array:
        return act(obs, None)[0]

    def recurrent(obs: jax.Array, hidden: jax.Array | None = None) -> tuple[jax.Array, jax.Array | None]:
        assert memory is not None
        return act(obs, memory.actor[0] if hidden is None else hidden)

    return policy if memory is None else recurrent
