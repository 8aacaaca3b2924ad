"""The start of a run from what another has learned (`init`)."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ..config.settings import Config
from ..errors import UsageError
from ..learning import learner, sharding
from ..learning.setup import Setup
from ..learning.types import Critic, LearnerState, TrainState
from .load import load_run

Change = Callable[[LearnerState], LearnerState]

ACTING = ("actor", "obs_moments")  # a pretrained policy has no more
FUNCTION = ("activation", "obs_norm")  # with other ones the same weights are another function
LEARNED = (*ACTING, "critic", "cost_critic", "fear", "largest_cost", "regret", "state_moments")


def prepare(setup: Setup) -> Change | None:
    """What turns the first state of a run [seeds] into the one that `init` asks for; None without it.

    Seed i (of each point of a sweep) takes what the other run's seed i has learned, counted round if that run has fewer
    seeds. Optimisers, multipliers, environments and keys begin anew.

    Raises:
      UsageError: there is no such run, or its networks are of another kind.
    """
    if not setup.config.init:
        return None
    hyper, keys, axes = setup.vmap_arguments
    like = jax.eval_shape(jax.vmap(functools.partial(learner.init, setup), axes), hyper, keys)
    index = setup.trials.index if setup.trials else jnp.arange(setup.config.seeds)
    changes = _networks(setup.config, like, index)

    def change(state: LearnerState) -> LearnerState:
        parts = {name: _with(getattr(state, name), learned) for name, learned in changes.items()}
        return sharding.place(setup.mesh, dataclasses.replace(state, **parts))

    return change


def _learned(part: Any) -> Any:
    """What a part of a learner state has learned: all of it but the state of an optimiser."""
    if isinstance(part, Critic):
        return part.net.params, part.returns
    return part.params if isinstance(part, TrainState) else part


def _with(part: Any, learned: Any) -> Any:
    """The part with what another has learned; the inverse of `_learned`."""
    if isinstance(part, Critic):
        return Critic(dataclasses.replace(part.net, params=learned[0]), learned[1])
    return dataclasses.replace(part, params=learned) if isinstance(part, TrainState) else learned


def _networks(config: Config, like: LearnerState, index: jax.Array) -> dict[str, Any]:
    """What the run that `config` names has learned of all that both have, for the seeds at `index` [seeds] of it."""
    source = config.init
    made, state = load_run(pathlib.Path(source))
    names = LEARNED if isinstance(state, LearnerState) else ACTING
    both = [name for name in names if None not in (getattr(state, name), getattr(like, name))]
    parts = {name: (_learned(getattr(state, name)), getattr(like, name)) for name in both}
    taken = {name: _taken(source, name, *part, index) for name, part in parts.items()}
    for name in FUNCTION:
        if (given := getattr(made.config, name)) != getattr(config, name):
            flag = f"--{name.replace('_', '-')} {given}"
            raise UsageError(f"the networks of {source} have {name} = '{given}', this run's do not; add {flag}")
    return taken


def _taken(source: str, name: str, theirs: Any, like: Any, index: jax.Array) -> Any:
    """`theirs` [other seeds, ...] at `index` [seeds], counted round; it must have the shapes of the part `like`."""
    like = _learned(like)
    shapes = [jax.tree.map(lambda x: x.shape[1:], tree) for tree in (theirs, like)]
    if shapes[0] != shapes[1]:
        raise UsageError(
            f"{name} of {source} has other shapes than this run's; start from a run of a task with the same "
            "observations and agents, with the same hidden, layer_norm and recurrent, and of a method that also "
            "has one policy for all agents (mappo, ippo) or one for each (all others), and critics of the same "
            "(ippo and ippo_l have those of observations), and one fear network for all agents or one for each "
            "(f4sg_letter)"
        )
    return jax.tree.map(lambda x: x[index % x.shape[0]], theirs)
