"""argparse with errors of one sentence: the parser, types of arguments, and flags that several commands share."""

from __future__ import annotations

import argparse
import pathlib
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn

from ..config.fields import INT32_MAX
from ..errors import UsageError
from ..output import result
from ..tasks import did_you_mean

RUN = "a run folder, or a pretrained policy: hub:ant_2x4/r4sg (pmt hub lists them)"
SOURCE = "a task's name (pmt envs lists them), a TOML file, or a Python file with a task of your own: my_env.py"
HELP = ("-h", "--help")
EVERYTHING = "all"  # after --help


class Parser(argparse.ArgumentParser):
    """Raises one sentence, with the nearest known word, instead of printing its usage and exiting."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$|-inf$")  # argparse knows no -1e-3

    def error(self, message: str) -> NoReturn:
        """Raises argparse's message, or the sentence of one of the types below."""
        fault = re.fullmatch(r"argument (?:\S+/)?(\S+): (must .*)", message, re.DOTALL)
        raise UsageError(f"{fault[1]} {fault[2]}" if fault else f"{message} (see {self.prog} --help)")

    def _print_message(self, message: str, file: Any = None) -> None:
        """Help, which argparse would drop where it cannot be written."""
        del file
        result(message.removesuffix("\n"))

    def parse_all(self, argv: Sequence[str]) -> argparse.Namespace:
        """As `parse_args`, but an unknown flag gets the nearest known one, or what a command has in its place."""
        known, unknown = self.parse_known_args(argv)
        if unknown and not unknown[0].startswith("-"):
            raise UsageError(f"unexpected word '{unknown[0]}' (see {self.prog} {known.command} --help)")
        if unknown and (word := unknown[0].split("=")[0]) in getattr(known, "elsewhere", {}):
            raise UsageError(f"unknown argument '{word}': {known.elsewhere[word]}")
        if unknown:
            flags = [f for a in _actions(self, known) for f in a.option_strings]
            raise UsageError(f"unknown argument '{unknown[0]}'{did_you_mean(unknown[0].split('=')[0], flags)}")
        return known


def _actions(parser: argparse.ArgumentParser, parsed: argparse.Namespace) -> list[argparse.Action]:
    chosen = getattr(parsed, "command", None)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction) and chosen in action.choices:
            return action.choices[chosen]._actions
    return parser._actions


def refuse_unknown(argv: Sequence[str], commands: Iterable[str]) -> None:
    """Names the nearest command if the first word is none; argparse would list them all."""
    if argv and not argv[0].startswith("-") and argv[0] not in commands:
        raise UsageError(f"unknown command '{argv[0]}'{did_you_mean(argv[0], commands)}")


def command(commands: Any, name: str, run: Callable[[argparse.Namespace], int], help: str, **options: Any) -> Parser:
    """Adds the command `name`, which `run` executes."""
    parser = commands.add_parser(name, help=help, allow_abbrev=False, **options)
    parser.set_defaults(run=run)
    return parser


# ---------------------------------------------------------------------------------------------------------------------
# Types of arguments


def whole(least: int, most: int = INT32_MAX) -> Callable[[str], int]:
    """The type of a whole number within bounds."""

    def read(text: str) -> int:
        if not (text.isascii() and text.isdecimal()) or int(text[:20]) < least:
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {least}, not '{text}'")
        if int(text[:20]) > most:
            raise argparse.ArgumentTypeError(f"must be a whole number of at most {most}, not '{text}'")
        return int(text)

    return read


def path(text: str) -> pathlib.Path:
    """The type of a path; a `~` that the shell left, as in --out=~/runs, is the home."""
    try:
        return pathlib.Path(text).expanduser()
    except RuntimeError:
        raise argparse.ArgumentTypeError(f"must be a path, but '{text}' begins with a home that is unknown") from None


def span(text: str) -> slice:
    """The type of FROM:TO or FROM:TO:EVERY, each part a whole number or nothing."""
    parts = text.split(":")
    if len(parts) in (2, 3):
        found = slice(*(whole(0)(part) if part else None for part in parts))
        if found.step != 0:
            return found
    raise argparse.ArgumentTypeError(f"must be FROM:TO or FROM:TO:EVERY, like 100:300:2, not '{text}'")


def pixels(text: str) -> tuple[int, int]:
    """The type of WIDTHxHEIGHT."""
    parts = text.split("x")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT in pixels, like 640x360, not '{text}'")
    width, height = (whole(32, 8192)(part) for part in parts)
    return width, height


def names(text: str) -> list[str]:
    """The type of words with commas between them."""
    return [name for name in text.split(",") if name]


# ---------------------------------------------------------------------------------------------------------------------
# Flags that several commands share


def add_cache(parser: Any) -> None:
    """--no-cache."""
    parser.add_argument("--no-cache", action="store_true", help="do not keep compiled programs on disk")


def add_devices(parser: Any) -> None:
    """--devices."""
    parser.add_argument(
        "--devices",
        type=whole(1),
        metavar="N",
        help="split seeds and environments over N devices, or a CPU into N (default 1; in several processes all)",
    )


def add_jobs(parser: Any) -> None:
    """--jobs, --devices, --no-cache: how programs of many runs are trained."""
    parser.add_argument(
        "--jobs",
        type=whole(1),
        default=1,
        metavar="N",
        help="programs that train at a time; for a GPU that one program does not fill",
    )
    add_devices(parser)
    add_cache(parser)


def add_format(parser: Any) -> None:
    """--format."""
    parser.add_argument("--format", default="text", metavar="WORD", help="text (default) | markdown | latex | json")


def add_which(parser: Any) -> None:
    """--which."""
    parser.add_argument("--which", metavar="WORD", help="which learner state: last (default) | best")


def add_deterministic(parser: Any) -> None:
    """--deterministic."""
    parser.add_argument("--deterministic", action="store_true", help="take the mean action instead of a sample")


def add_trust(parser: Any) -> None:
    """--trust."""
    parser.add_argument(
        "--trust",
        action="store_true",
        help="execute the Python file that a run or a file of settings names, although you have not trained with it; "
        "remembered until that file changes",
    )


def add_seed(parser: Any) -> None:
    """--seed."""
    parser.add_argument("--seed", type=whole(0), metavar="N", help="which of the run's seeds (default: its first)")


def add_out(parser: Any, default: str) -> None:
    """-o."""
    out = pathlib.Path(default)
    parser.add_argument("-o", "--out", type=path, default=out, metavar="FILE", help=f"(default {default})")
