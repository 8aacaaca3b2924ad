"""Tasks with rewards and costs, as pure functions of arrays.

`make(name, **options)` builds one, `names()` lists them. Importing this package imports neither JAX nor MuJoCo.
"""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from . import ant, multi_goal, user, velocity, voltage
from .columns import Column
from .errors import TaskError, did_you_mean

if TYPE_CHECKING:
    from .base import Env

__pmt__ = "pmt-jax"  # distinguishes this package from the unrelated `envs` on PyPI


class _Task(NamedTuple):
    """A row of the registry: where the class is, the options that make this task of it, its columns in tables."""

    module: str
    cls: str
    options: dict[str, Any] = {}
    columns: Mapping[str, Column] = {}


_TASKS = {
    "ant_2x4": _Task("ant.corridor", "AntCorridor", {"num_agents": 2}, ant.COLUMNS),
    "ant_4x2": _Task("ant.corridor", "AntCorridor", {"num_agents": 4}, ant.COLUMNS),
    "hand_over_2x6": _Task("hands.hand_over", "HandOver", {"variant": "2x6"}),
    "hand_over_4x3": _Task("hands.hand_over", "HandOver", {"variant": "4x3"}),
    "hand_over_safe_joint": _Task("hands.hand_over", "HandOver", {"variant": "safe_joint"}),
    "hand_over_safe_finger": _Task("hands.hand_over", "HandOver", {"variant": "safe_finger"}),
    **{
        f"multi_goal_{variant}": _Task("multi_goal.multi_goal", "MultiGoal", {"variant": variant}, multi_goal.COLUMNS)
        for variant in multi_goal.VARIANTS
    },
    "lane": _Task("toys", "Lane"),
    "switch": _Task("toys", "Switch"),
    "noisy": _Task("toys", "Noisy"),
    **{
        f"velocity_{variant}": _Task("velocity.velocity", "Velocity", {"variant": variant}, velocity.COLUMNS)
        for variant in velocity.VARIANTS
    },
    "voltage_33": _Task("voltage.control", "VoltageControl", {"case": "case33"}, voltage.COLUMNS),
    "voltage_141": _Task("voltage.control", "VoltageControl", {"case": "case141"}, voltage.COLUMNS),
}


def names() -> list[str]:
    """The tasks that `make` builds."""
    return sorted(_TASKS)


def make(name: str, **options: Any) -> Env:
    """Builds a task.

    Args:
      name: one of `names()`, or a Python file that keeps the contract: `my_env.py`, `my_env.py:Name`.
      **options: the task's own options, e.g. `physics="mjx"`; see the task's class.

    Raises:
      TaskError: unknown name or option (the nearest known one is named), an engine that cannot run here, or a file
        that does not keep the contract.

    Examples:
      >>> make("lane").spec.num_agents
      2
    """
    cls, fixed, known = _find(name)
    for option in options:
        if option == "physics" and option not in known and not _takes_any(cls):
            raise TaskError(f"task '{name}' is plain JAX and has no physics engine to choose; leave physics = auto")
        if option not in known and not _takes_any(cls):
            raise TaskError(f"task '{name}' has no option '{option}'{did_you_mean(option, known)}")
    return user.build(cls, name, options) if user.is_file(name) else cls(**fixed, **options)


def columns(name: str) -> Mapping[str, Column]:
    """The entries of a task's `info` that tables show, by their name in `info`; none for a task in a file.

    A free partition of a robot, like ant_6_2, has the columns of the robot's other tasks.
    """
    if name in _TASKS:
        return _TASKS[name].columns
    families = {known.split("_")[0]: task.columns for known, task in _TASKS.items()}
    return families.get(name.split("_")[0], {}) if re.fullmatch(r"[a-z_]+(_\d+)+", name) else {}


def task_options(name: str) -> dict[str, Any]:
    """The options that a task takes, with their defaults.

    Raises:
      TaskError: unknown name.
    """
    return _find(name)[2]


def explain_options(name: str) -> str:
    """What a task's docstring says of its options; '' if it has none.

    Raises:
      TaskError: unknown name.
    """
    cls, fixed, _ = _find(name)
    arguments = textwrap.dedent((inspect.getdoc(cls) or "").partition("Args:\n")[2])
    entries = re.split(r"\n(?=\S)", arguments)
    return "\n".join(entry for entry in entries if entry.partition(":")[0] not in fixed)


def _find(name: str) -> tuple[Callable[..., Any], dict[str, Any], dict[str, Any]]:
    """What builds a task, the options that make this task of it, and those that are left, with their defaults."""
    if user.is_file(name):
        cls, fixed = user.factory(name), {}
    elif name in _TASKS:
        task = _TASKS[name]
        cls, fixed = getattr(importlib.import_module(f".{task.module}", __name__), task.cls), task.options
    else:
        raise TaskError(f"unknown task '{name}'{did_you_mean(name, names())} (pmt envs lists all)")
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    named = [p for p in inspect.signature(cls).parameters.values() if p.kind not in several]
    return cls, fixed, {p.name: p.default for p in named if p.name not in fixed}


def _takes_any(make: Callable[..., Any]) -> bool:
    """Whether it has `**options`, which it hands on."""
    return any(p.kind is inspect.Parameter.VAR_KEYWORD for p in inspect.signature(make).parameters.values())
