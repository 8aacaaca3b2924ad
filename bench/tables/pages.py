"""What task and method pages show of the code itself: observations, actions, options and settings.

Each kind is a function from a name, or several joined by +, to Markdown; `bench.render` puts it into a page.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import typing
from collections.abc import Callable
from typing import Any, Literal

import envs
from envs.base import declarations
from envs.blocks import Blocks, slices
from pmt_jax.config import load
from pmt_jax.config.methods import METHODS
from pmt_jax.config.settings import FIELDS, Config
from pmt_jax.errors import UsageError
from pmt_jax.formats import markdown
from pmt_jax.tasks import did_you_mean


@functools.cache
def _task(name: str) -> Any:
    if name not in envs.names():
        raise UsageError(f"unknown task '{name}'{did_you_mean(name, envs.names())}")
    return envs.make(name)


def as_observation(name: str) -> str:
    """One agent's observation, a line a block."""
    return _blocks(declarations(_task(name)).observation)


def as_state(name: str) -> str:
    """The global state, a line a block."""
    return _blocks(declarations(_task(name)).state)


def _blocks(blocks: Blocks) -> str:
    body = []
    for block, where in zip(blocks, slices(blocks).values(), strict=True):
        index = f"{where.start}" if block.size == 1 else f"{where.start} to {where.stop - 1}"
        body.append([index, block.name, block.unit, block.meaning or "-"])
    return markdown(("index", "what", "unit", "meaning"), body)


def as_actions(tasks: str) -> str:
    """What each agent's action entries drive, a line an agent."""
    body = []
    for name in tasks.split("+"):
        for agent, entries in enumerate(declarations(_task(name)).actions):
            body.append([f"`{name}`", str(agent), ", ".join(f"{i} {entry}" for i, entry in enumerate(entries))])
    return markdown(("task", "agent", "entries"), body)


def as_options(name: str) -> str:
    """A task's own options with their defaults, as its class explains them."""
    explained = re.split(r"\n(?=\S)", envs.explain_options(name).strip())
    meaning = {}
    for entry in explained:
        words, _, text = entry.partition(": ")
        meaning |= dict.fromkeys(words.split(", "), " ".join(text.split()).rstrip("."))
    defaults = envs.task_options(name)
    return markdown(
        ("option", "default", "meaning"), ([f"`{x}`", _shown(defaults[x]), meaning.get(x, "-")] for x in defaults)
    )


def _shown(default: Any) -> str:
    if default is None or default == "":
        return "none"
    words = ",".join(map(str, default)) if isinstance(default, tuple) else str(default)
    return f"`{words.lower() if isinstance(default, bool) else words}`"


def as_tasks(tasks: str) -> str:
    """The numbers of tasks, a line each; `all` stands for all of them."""
    body = []
    for name in envs.names() if tasks == "all" else tasks.split("+"):
        spec = _task(name).spec
        entries = " or ".join(map(str, sorted({int(n) for n in spec.action_mask.sum(1)}, reverse=True)))
        line = [spec.num_agents, entries, spec.obs_dim, spec.state_dim, spec.horizon, f"{spec.cost_limit:g}"]
        about = load.about(name).partition(";")[0]
        body.append([f"`{name}`", about, *map(str, line)])
    head = ("task", "what", "agents", "action entries", "observation", "state", "steps", "cost limit")
    return markdown(head, body)


def as_settings(names: str) -> str:
    """Settings with their defaults, the values they take, and what they mean, from the settings' own descriptions."""
    fields = {field.name: field for field in dataclasses.fields(Config)}
    body = []
    for name in names.split("+"):
        if name not in FIELDS:
            raise UsageError(f"unknown setting '{name}'{did_you_mean(name, FIELDS)}")
        kind = FIELDS[name]
        values = ", ".join(f"`{x}`" for x in typing.get_args(kind)) if typing.get_origin(kind) is Literal else "-"
        body.append([f"`{name}`", _shown(fields[name].default), values, fields[name].metadata["help"]])
    return markdown(("setting", "default", "values", "meaning"), body)


def as_switches(_: str) -> str:
    """The table of methods: the switches that make each of them."""
    body = []
    for name, method in METHODS.items():
        order = f"{method.order}, {'one shared actor' if method.share_actor else 'an actor each'}"
        cost = "-" if method.constraint == "none" else str(method.cost_signal)
        surrogate = "as printed" if method.letter else method.surrogate.replace("_", " ")
        surrogate = "-" if method.constraint == "trust_region" else surrogate
        rest = [method.ratio_weight, surrogate, method.critic]
        body.append([f"`{name}`", order, method.constraint.replace("_", " "), cost, *rest])
    columns = ("method", "update", "constraint", "cost signal", "ratio weight", "surrogate", "critics see")
    return markdown(columns, body)


KINDS: dict[str, Callable[[str], str]] = {
    "observation": as_observation,
    "state": as_state,
    "actions": as_actions,
    "options": as_options,
    "tasks": as_tasks,
    "settings": as_settings,
    "switches": as_switches,
}
