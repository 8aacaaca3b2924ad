"""`pmt train --debug` names the first number that is not finite.

The checks are `chex.assert_tree_all_finite` under `chex.chexify`. Without `Setup.debug` nothing here adds an operation
to a program. With it every state of the task is checked too, before the vector environment replaces broken ones.
"""

from __future__ import annotations

import copy
import functools
import logging
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp

from .. import tasks
from .setup import Setup

SEEDS = "seeds"  # the axis that a checked program is vmapped over


class NotFinite(Exception):
    """Names the tensor, the seed and the update that is not finite."""


def check_finite(setup: Setup, update: jax.Array, **named: Any) -> None:
    """Checks every floating tensor of some pytrees, in the order given; nothing without `setup.debug`.

    Args:
      update: [] int32, the number of the update that computes them.
      **named: pytrees by the names that the message shows.
    """
    if not setup.debug:
        return
    seed = setup.config.seed + jax.lax.axis_index(SEEDS)
    for name, tree in named.items():
        for path, x in jax.tree_util.tree_leaves_with_path(tree):
            if jnp.issubdtype(x.dtype, jnp.floating):
                what = f"{name}{jax.tree_util.keystr(path)}".replace("{", "{{").replace("}", "}}")
                chex.assert_tree_all_finite(
                    x,
                    custom_message=f"{what} of seed {{}} is not finite in update {{}}",
                    custom_message_format_vars=[seed, update],
                )


def watched(setup: Setup, update: jax.Array) -> tasks.VectorEnv:
    """The run's environments, whose states are checked; the same object without `setup.debug`."""
    if not setup.debug:
        return setup.vector
    vector = copy.copy(setup.vector)
    vector.resets_all = True  # checkify knows no loop under a vmap
    vector.env = _Watched(vector.env, functools.partial(check_finite, setup, update))
    return vector


class _Watched:
    """An environment that passes each of its states to `check`."""

    def __init__(self, env: tasks.Env, check: Callable[..., None]) -> None:
        self._env, self._check = env, check
        self.spec, self.engine = env.spec, env.engine

    def reset(self, key: jax.Array) -> tasks.State:
        """As the environment's."""
        state = self._env.reset(key)
        self._check(**{"task.reset": state})
        return state

    def step(self, state: tasks.State, action: jax.Array) -> tasks.State:
        """As the environment's."""
        after = self._env.step(state, action)
        self._check(action=action, **{"task.step": after})
        return after


def checked(program: Callable[..., Any]) -> Callable[..., Any]:
    """A jitted program whose checks raise.

    Raises:
      NotFinite: when it is called, by the first check that fails.
    """
    logging.getLogger("absl").setLevel(logging.ERROR)  # chex warns when Python ends, whether or not it has waited
    chexified = chex.chexify(program, async_check=False)

    def run(*arguments: Any) -> Any:
        try:
            return chexified(*arguments)
        except AssertionError as error:
            raise NotFinite(str(error).partition("Custom message: ")[2].partition(". [failed")[0]) from None

    return run
