"""`pmt envs`: the tasks, or one of them in full."""

from __future__ import annotations

import argparse
from typing import Any

from .. import tasks
from ..config import toml
from ..config.settings import load_config
from ..output import say
from .parser import command, limits
from .process import at_once


def add(commands: Any) -> None:
    """Adds the command."""
    parser = command(commands, "envs", run, "list the tasks, or describe one of them: pmt envs ant_2x4")
    parser.add_argument("task", nargs="?", metavar="TASK", help="a task's name, or a Python file of your own")


@at_once()
def run(arguments: argparse.Namespace) -> int:
    """Lists the tasks, which needs no JAX, or describes one, which builds it."""
    if arguments.task is not None:
        return _describe(arguments.task)
    width = max(map(len, tasks.names()))
    for name in tasks.names():
        say(f"{name:{width}}  {toml.about(name)}")
    say("\npmt envs TASK describes one in full, pmt train TASK --help shows its settings.")
    return 0


def _describe(name: str) -> int:
    env = tasks.make(name)
    spec = env.spec
    actions = sorted({int(n) for n in spec.action_mask.sum(1)})
    facts = {
        "agents": f"{spec.num_agents}, with {' or '.join(map(str, actions))} action entries each",
        "observation": f"{spec.obs_dim} numbers an agent; global state {spec.state_dim}",
        "costs": f"{spec.num_costs} an agent; limit {limits(spec.cost_limit)} an episode",
        "horizon": f"{spec.horizon} control steps",
        "engines": _engines(env),
        "settings": ", ".join(known for known in (name, f"paper/{name}") if known in toml.names()) or "the defaults",
    }
    say(f"{name}: {toml.about(name) or 'a task of your own'}")
    for what, text in facts.items():
        say(f"  {what:12} {text}")
    options = tasks.options(name) | (dict(load_config(name).env) if name in toml.names() else {})
    defaults = ", by default " + ", ".join(f"{k}={v}" for k, v in options.items()) if options else ": it has none"
    say(f"  options      --env NAME=VALUE{defaults}")
    for line in tasks.explain_options(name).splitlines():
        say(f"    {line}")
    return 0


def _engines(env: tasks.Env) -> str:
    """Which engines can simulate a task here, and why others cannot."""
    if env.engine == "xla":
        return "none: the task is plain JAX"
    _, obstacles = tasks.engines(env)
    listing = "; ".join(f"{name}: {why}" if why else name for name, why in obstacles.items())
    return f"{listing}; auto takes {env.engine}"
