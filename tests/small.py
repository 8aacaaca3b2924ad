"""One small update of each method, compiled once a process: tests change traced numbers, which compiles nothing."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pmt_jax import load_config, make_setup
from pmt_jax.config.settings import HYPER_FIELDS, Hyper
from pmt_jax.learning import learner
from pmt_jax.learning.setup import Setup
from pmt_jax.learning.types import Batch, LearnerState, Metrics, Tag

SMALL = {"num_envs": 8, "rollout_length": 25, "steps": 8 * 25 * 3, "log_interval": 1, "hidden": (8,), "epochs": 2}
SMALL |= {"episode_starts": "together", "cost_margin": 0.0}  # each batch is an episode


class Program(NamedTuple):
    """A method's setup, and its jitted functions: (hyper, key) -> first state, (hyper, state) -> the next, metrics."""

    setup: Setup
    init: Callable[[Hyper, jax.Array], LearnerState]
    step: Callable[[Hyper, LearnerState], tuple[LearnerState, Metrics]]

    def hyper(self, **changes: float) -> Hyper:
        """The settings' traced numbers, with changes."""
        return dataclasses.replace(self.setup.hyper, **{name: jnp.float32(x) for name, x in changes.items()})


@functools.cache
def program(method: str, **changes: object) -> Program:
    """On `switch`, where costs are there from the first step."""
    setup = make_setup(load_config("switch", method=method, **{**SMALL, **changes}))
    init, step = (functools.partial(f, setup) for f in (learner.init, learner.train_step))
    return Program(setup, jax.jit(init), jax.jit(step))


@functools.cache
def trained(method: str, **changes: Any) -> tuple[LearnerState, Metrics]:
    """The state after three updates, and the metrics of the last; `changes` of traced numbers compile nothing."""
    made = program(method, **{name: x for name, x in changes.items() if name not in HYPER_FIELDS})
    hyper, metrics = made.hyper(**{name: x for name, x in changes.items() if name in HYPER_FIELDS}), {}
    state = made.init(hyper, jax.random.key(0))
    for _ in range(3):
        state, metrics = made.step(hyper, state)
    return state, metrics


@functools.cache
def acted() -> tuple[Setup, LearnerState, Batch]:
    """A method with regret after its team has acted in `switch` for a batch."""
    made = program("r4sg")
    start = made.init(made.setup.hyper, jax.random.key(0))
    tagged = {tag: jax.random.fold_in(jax.random.key(1), tag) for tag in Tag}
    state, batch = jax.jit(functools.partial(learner.act, made.setup))(made.setup.hyper, start, tagged)
    return made.setup, state, batch


def weights(state: LearnerState) -> dict[str, Any]:
    """What methods that are equal agree in."""
    return {"actor": state.actor.params, "critic": state.critic.net.params, "lambda": state.constraint.multiplier}


def differ(a: Any, b: Any, by: float = 1e-4) -> bool:
    """Whether two pytrees of the same structure are finite and not the same, by more than rounding."""
    pairs = list(zip(*(map(np.asarray, jax.tree.leaves(tree)) for tree in (a, b)), strict=True))
    assert jax.tree.structure(a) == jax.tree.structure(b)
    assert all(np.isfinite(x).all() for pair in pairs for x in pair)
    return any(np.abs(x - y).max(initial=0.0) > by for x, y in pairs)
