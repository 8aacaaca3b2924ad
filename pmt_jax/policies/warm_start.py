"""The start of a run from what another has learned: all of its networks (`init`), or its fear (`init_fear`)."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ..config.methods import label
from ..errors import UsageError
from ..learning import learner, sharding
from ..learning.setup import Setup
from ..learning.types import Critic, LearnerState, Params, TrainState
from .load import load_run

Change = Callable[[LearnerState], LearnerState]

ACTING = ("actor", "obs_moments")  # a pretrained policy has no more
LEARNED = (*ACTING, "critic", "cost_critic", "fear", "largest_cost", "regret", "state_moments")


def prepare(setup: Setup) -> Change | None:
    """What turns the first state of a run [seeds] into the one that `init` and `init_fear` ask for; None without them.

    Seed i takes what the other run's seed i has learned, counted round if that run has fewer seeds. Optimisers,
    multipliers, environments and keys begin anew.

    Raises:
      UsageError: there is no such run, its networks have other shapes, or one of the two methods has no fear.
    """
    config = setup.config
    if not (config.init or config.init_fear):
        return None
    hyper, keys, axes = setup.vmap_arguments
    like = jax.eval_shape(jax.vmap(functools.partial(learner.init, setup), axes), hyper, keys)
    changes: dict[str, Any] = {}
    if config.init:
        changes |= _networks(config.init, like)
    if config.init_fear:
        changes |= _fear(config.init_fear, like, setup)

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


def _networks(source: str, like: LearnerState) -> dict[str, Any]:
    """What the other run has learned of all that both have."""
    _, state = load_run(pathlib.Path(source))
    names = LEARNED if isinstance(state, LearnerState) else ACTING
    both = [name for name in names if None not in (getattr(state, name), getattr(like, name))]
    return {name: _taken(source, name, _learned(getattr(state, name)), getattr(like, name)) for name in both}


def _fear(source: str, like: LearnerState, setup: Setup) -> dict[str, Any]:
    """The fear of the other run and its moments of states; if teams differ, all agents begin with the mean fear."""
    other, state = load_run(pathlib.Path(source))
    if like.fear is None:
        raise UsageError(
            f"init_fear is for methods with a fear network (f4sg, mixed), not for {label(setup.config.method)}"
        )
    if not isinstance(state, LearnerState) or state.fear is None:
        raise UsageError(f"{source} has no fear network; init_fear needs a run folder of f4sg or mixed")
    ours, theirs = setup.vector.spec, other.vector.spec
    params, largest = state.fear.params, state.largest_cost
    if ours.num_agents != theirs.num_agents and ours.num_costs == theirs.num_costs:
        if other.nets.own_fear:
            raise UsageError(
                f"{source} has a fear network for each of its {theirs.num_agents} agents; init_fear needs a run of "
                f"{ours.num_agents} agents, or one of f4sg or mixed"
            )
        params = _shared_by_agents(params, other.nets.fear_head, theirs.num_agents, ours.num_agents)
        largest = jnp.repeat(largest.max(1, keepdims=True), ours.num_agents, 1)
    return {
        "largest_cost": _taken(source, "largest_cost", largest, like.largest_cost),
        "fear": _taken(source, "fear", params, like.fear),
        "state_moments": _taken(source, "state_moments", state.state_moments, like.state_moments),
    }


def _shared_by_agents(params: Params, head: str, have: int, want: int) -> Params:
    """The weights of a network with heads [have, K] as one with heads [want, K], each the mean over agents."""

    def shared(x: jax.Array) -> jax.Array:  # [..., have * K]
        mean = x.reshape(*x.shape[:-1], have, -1).mean(-2)
        return jnp.tile(mean, want)

    layers = params["params"]
    return {**params, "params": {**layers, head: jax.tree.map(shared, layers[head])}}


def _taken(source: str, name: str, theirs: Any, like: Any) -> Any:
    """`theirs` [other seeds, ...] for as many seeds as the part `like` has."""
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
    return jax.tree.map(lambda x, new: x[jnp.arange(new.shape[0]) % x.shape[0]], theirs, like)
