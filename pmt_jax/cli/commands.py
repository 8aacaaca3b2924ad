"""The commands that `pmt` knows, and how one of them is found and run."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import pmt_jax

from . import doctor, pictures, policies, studies, tasks, train
from .parser import HELP, Parser, refuse_unknown
from .process import answer


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
    return parser, dict(commands.choices)


def _run(argv: Sequence[str]) -> int:
    parser, commands = make_parser()
    refuse_unknown(argv, commands)
    asked = [word for word in argv if word in HELP][:1]  # last, so that it knows the other words
    arguments = parser.parse_all([word for word in argv if word not in HELP] + asked)
    if arguments.command is None:
        parser.print_help()
        return 0
    return arguments.run(arguments)
