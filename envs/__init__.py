"""Tasks with rewards and costs, as pure functions of arrays.

`make(name, **options)` builds one, `names()` lists them. Importing this package imports neither JAX nor MuJoCo.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from . import user
from .errors import TaskError, did_you_mean

if TYPE_CHECKING:
    from .base import Env

__pmt__ = "pmt-jax"  # tells our `envs` from the unrelated package of that name on PyPI

# name -> (module, class, the options that make this task of it)
_TASKS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "ant_2x4": ("ant.corridor", "AntCorridor", {"num_agents": 2}),
    "ant_4x2": ("ant.corridor", "AntCorridor", {"num_agents": 4}),
    "hand_over_2x6": ("hands.hand_over", "HandOver", {"variant": "2x6"}),
    "hand_over_4x3": ("hands.hand_over", "HandOver", {"variant": "4x3"}),
    "hand_over_safe_joint": ("hands.hand_over", "HandOver", {"variant": "safe_joint"}),
    "hand_over_safe_finger": ("hands.hand_over", "HandOver", {"variant": "safe_finger"}),
    "lane": ("toys", "Lane", {}),
    "switch": ("toys", "Switch", {}),
    "noisy": ("toys", "Noisy", {}),
    "voltage_33": ("voltage.control", "VoltageControl", {"case": "case33"}),
    "voltage_141": ("voltage.control", "VoltageControl", {"case": "case141"}),
}


def names() -> list[str]:
    """The tasks `make` knows."""
    return sorted(_TASKS)


def make(name: str, **options: Any) -> Env:
    """Builds a task.

    Args:
      name: one of `names()`, or a Python file that keeps the contract: `my_env.py`, `my_env.py:Name`.
      **options: the task's own options, e.g. `physics="mjx"`; see the task's class.

    Raises:
      TaskError: unknown name or option (the nearest known one is named), an engine that cannot run here, or a file
        that does not keep the contract.

    Example:
      >>> make("lane").spec.num_agents
      2
    """
    known = task_options(name)
    for option in options:
        if option not in known:
            raise TaskError(f"task '{name}' has no option '{option}'{did_you_mean(option, known)}")
    cls, fixed = _task(name)
    return user.build(cls, name, options) if user.is_file(name) else cls(**fixed, **options)


def task_options(name: str) -> list[str]:
    """The names of the options that a task takes.

    Raises:
      TaskError: unknown name.
    """
    cls, fixed = _task(name)
    return [p for p in inspect.signature(cls).parameters if p not in fixed]


def _task(name: str) -> tuple[Callable[..., Any], dict[str, Any]]:
    if user.is_file(name):
        return user.factory(name), {}
    if name not in _TASKS:
        raise TaskError(f"unknown task '{name}'{did_you_mean(name, names())} (pmt envs lists all)")
    module, class_name, fixed = _TASKS[name]
    return getattr(importlib.import_module(f".{module}", __name__), class_name), fixed
