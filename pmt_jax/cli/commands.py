"""The commands of `pmt`, and how one of them is found and run."""

from __future__ import annotations

import argparse
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

import pmt_jax

from ..config.methods import METHODS
from ..errors import UsageError
from ..output import result
from ..tasks import did_you_mean
from ..tasks import names as task_names
from . import doctor, pictures, policies, studies, tasks, train
from .parser import EVERYTHING, HELP, Parser, command, refuse_unknown
from .process import answer, interruptible

SHELLS = ("bash", "zsh", "fish")


def run(argv: Sequence[str] | None) -> int:
    """Runs the command in `argv`, or in the process's arguments; returns its exit code."""
    return answer("pmt", lambda: _run(sys.argv[1:] if argv is None else list(argv)))


def make_parser() -> tuple[Parser, dict[str, Parser]]:
    """The parser, and those of the commands by name."""
    parser = Parser(prog="pmt", description=str(pmt_jax.__doc__).splitlines()[0], allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"pmt {pmt_jax.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)
    for module in (train, policies, studies, pictures, tasks, doctor):
        module.add(commands)
    completion = command(
        commands,
        "completion",
        run_completion,
        'complete commands with Tab: eval "$(pmt completion bash)"',
        description="Prints a script that completes commands, flags, tasks and methods. bash and zsh evaluate it when "
        "they start; fish reads it from ~/.config/fish/completions/pmt.fish.",
    )
    completion.add_argument("shell", metavar="SHELL", help=" | ".join(SHELLS))
    return parser, dict(commands.choices)


@interruptible()
def run_completion(arguments: argparse.Namespace) -> int:
    """Prints a shell's completion script."""
    if arguments.shell not in SHELLS:
        raise UsageError(f"unknown shell '{arguments.shell}'{did_you_mean(arguments.shell, SHELLS)}")
    import shtab

    parser, commands = make_parser()
    words: dict[str, Any] = {"task": task_names(), "set_method": METHODS, "shell": SHELLS}
    for name, each in commands.items():
        for action in each._actions:
            if action.dest == "source" and name in ("train", "sweep"):
                action.choices = task_names()
            elif action.dest in words:
                action.choices = list(words[action.dest])
            elif action.dest == "source" or action.type is pathlib.Path:
                action.complete = shtab.FILE  # pyright: ignore[reportAttributeAccessIssue]
    result(shtab.complete(parser, arguments.shell))
    return 0


def _run(argv: Sequence[str]) -> int:
    parser, commands = make_parser()
    refuse_unknown(argv, commands)
    asked = next((i for i, word in enumerate(argv) if word in HELP), None)
    if asked is not None:  # last, so that it knows the other words
        end = asked + 1 + (list(argv[asked + 1 : asked + 2]) == [EVERYTHING])
        argv = [*argv[:asked], *(word for word in argv[end:] if word not in HELP), *argv[asked:end]]
    arguments = parser.parse_all(argv)
    if arguments.command is None:
        parser.print_help()
        return 0
    return arguments.run(arguments)
