"""`pmt train --debug` names the first number that is not finite.

The checks are `chex.assert_tree_all_finite` under `chex.chexify`. Without `Setup.debug` nothing here adds an operation
to a program. With it every state of the task is checked too, before the vector environment replaces broken ones.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import logging
from collections.abc import Callable, Iterator
from typing import Any

import chex
import jax
import jax.custom_batching
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

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
    vector.resets_all = True  # a loop over resets would hide their checks, see `_loops_hidden`
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
            with _loops_hidden():  # the first call traces
                return chexified(*arguments)
        except AssertionError as error:
            raise NotFinite(str(error).partition("Custom message: ")[2].partition(". [failed")[0]) from None

    return run


@contextlib.contextmanager
def _loops_hidden() -> Iterator[None]:
    """Inside, what is traced has loops of `jax.lax.while_loop` that checkify does not look into.

    It refuses a loop that was vmapped, of a task or of a trust region. To it a function with a rule of its own for vmap
    is one operation, also after vmap if the rule gives such a function again.
    """
    loop = jax.lax.while_loop

    def hidden(proceed: Callable[[Any], jax.Array], body: Callable[[Any], Any], start: Any) -> Any:
        leaves, tree = jax.tree.flatten(start)

        def run(*leaves: jax.Array) -> list[jax.Array]:
            return jax.tree.leaves(loop(proceed, body, jax.tree.unflatten(tree, leaves)))

        traced = jax.make_jaxpr(run)(*leaves)  # what it closes over becomes its first arguments
        count = len(traced.consts)
        flat = _one_operation(lambda *x: jaxpr_as_fun(ClosedJaxpr(traced.jaxpr, x[:count]))(*x[count:]))
        return jax.tree.unflatten(tree, flat(*traced.consts, *leaves))

    jax.lax.while_loop = hidden
    try:
        yield
    finally:
        jax.lax.while_loop = loop


def _one_operation(function: Callable[..., Any]) -> Callable[..., Any]:
    operation = jax.custom_batching.custom_vmap(function)

    @operation.def_vmap
    def batched(size: int, axes: list[bool], *arguments: jax.Array) -> tuple[Any, Any]:
        each = jax.vmap(function, [0 if axis else None for axis in axes], axis_size=size)
        out = _one_operation(each)(*arguments)
        return out, jax.tree.map(lambda _: True, out)

    return operation
