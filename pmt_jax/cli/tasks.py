"""`pmt envs`: the tasks, or one of them in full."""

from __future__ import annotations

import argparse
from typing import Any

from .. import numerics, tasks
from ..config import load
from ..config.load import load_config
from ..output import result
from ..trust import check_source
from .parser import command
from .process import interruptible


def add(commands: Any) -> None:
    """Adds the command."""
    parser = command(commands, "envs", run, "list the tasks, or describe one of them: pmt envs ant_2x4")
    parser.add_argument("task", nargs="?", metavar="TASK", help="a task's name, or a Python file of your own")


@interruptible()
def run(arguments: argparse.Namespace) -> int:
    """Lists the tasks, which needs no JAX, or describes one, which builds it."""
    if arguments.task is not None:
        return _describe(arguments.task)
    width = max(map(len, tasks.names()))
    for name in tasks.names():
        result(f"{name:{width}}  {load.about(name)}")
    result("\npmt envs TASK describes one in full, pmt train TASK --help shows its settings.")
    return 0


def _describe(name: str) -> int:
    from ..limits import Limits

    check_source(name, ())
    numerics.check()
    env = tasks.make(name)
    spec = env.spec
    actions = sorted({int(n) for n in spec.action_mask.sum(1)})
    facts = {
        "agents": f"{spec.num_agents}, with {' or '.join(map(str, actions))} action entries each",
        "observation": f"{spec.obs_dim} numbers an agent; global state {spec.state_dim}",
        "costs": f"{spec.num_costs} an agent; limit {Limits.of_task(spec)} an episode",
        "horizon": f"{spec.horizon} control steps",
        "engines": _engines(env),
        "settings": ", ".join(known for known in (name, f"paper/{name}") if known in load.names()) or "the defaults",
    }
    result(f"{name}: {load.about(name) or 'a task of your own'}")
    for what, text in facts.items():
        result(f"  {what:12} {text}")
    options = tasks.options(name) | (dict(load_config(name).env) if name in load.names() else {})
    defaults = ", by default " + ", ".join(f"{k}={v}" for k, v in options.items()) if options else ": it has none"
    result(f"  options      --env NAME=VALUE{defaults}")
    for line in tasks.explain_options(name).splitlines():
        result(f"    {line}")
    return 0


def _engines(env: tasks.Env) -> str:
    """Which engines can simulate a task here, and why others cannot."""
    if env.engine == "xla":
        return "none: the task is plain JAX"
    _, obstacles = tasks.engines(env)
    listing = "; ".join(f"{name}: {why}" if why else name for name, why in obstacles.items())
    return f"{listing}; auto takes {env.engine}"
