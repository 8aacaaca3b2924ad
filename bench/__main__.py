"""Speed and memory, measured, compared with what was committed, and rendered into the documentation.

python -m bench all                            everything, into bench/results; then the documentation's tables
python -m bench all --quick                    does everything run? minutes, into a folder of its own
python -m bench all --only throughput,grid
python -m bench list
python -m bench compare HEAD~5 bench/results   results as files, folders or git revisions
python -m bench render --check                 are the documentation's tables what bench/results says?
"""

from __future__ import annotations

import argparse
import functools
import pathlib
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from pmt_jax.cli.main import answer, refuse_unknown
from pmt_jax.errors import UsageError

from . import compare, render, suite

say = functools.partial(print, flush=True)


class _Parser(argparse.ArgumentParser):
    """argparse that raises one sentence instead of printing its usage and exiting."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see python -m bench --help)")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code: 2 for a user's mistake, 1 where a bench failed or a table is old."""
    return answer("bench", lambda: _run(sys.argv[1:] if argv is None else list(argv)))


def _run(argv: Sequence[str]) -> int:
    parser, commands = _parser()
    refuse_unknown(argv, commands)
    arguments = parser.parse_args(argv)
    return arguments.run(arguments)


def _parser() -> tuple[_Parser, list[str]]:
    parser = _Parser(prog="python -m bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands: Any = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=_Parser)
    every = commands.add_parser("all", help="run all benches, or some, one after the other")
    every.add_argument("--quick", action="store_true", help="a smoke: few cases, few repeats")
    every.add_argument("--only", metavar="NAMES", help="with commas; python -m bench list shows them")
    every.add_argument("--out", type=pathlib.Path, help="a folder (default: bench/results; with --quick a new one)")
    every.set_defaults(run=_all)
    commands.add_parser("list", help="the benches, and how long they took").set_defaults(run=_list)
    compared = commands.add_parser("compare", help="ratios between results")
    compared.add_argument("old", help="a JSON file, a folder of them, or a git revision")
    compared.add_argument("new", help="the same")
    compared.set_defaults(run=_compare)
    rendered = commands.add_parser("render", help="make the tables of README.md and docs/ from bench/results")
    rendered.add_argument("--check", action="store_true", help="write nothing; exit code 1 where a table is old")
    rendered.set_defaults(run=_render)
    return parser, list(commands.choices)


def _all(arguments: argparse.Namespace) -> int:
    code = suite.run_all(arguments.only, arguments.out, arguments.quick, say)
    if arguments.out is None and not arguments.quick:
        render.documents_anew(check=False, say=say)
    return code


def _list(arguments: argparse.Namespace) -> int:
    reports = compare.load(str(compare.RESULTS))
    for name, bench in suite.BENCHES.items():
        found = [r for result, r in reports.items() if result == name or result.startswith(f"{name}_")]
        took = ", ".join(f"{r['seconds']} s on {r['device']}" for r in found if "seconds" in r)
        say(f"{name}: {bench.what}{f' (took {took})' if took else ''}")
    return 0


def _compare(arguments: argparse.Namespace) -> int:
    old, new = compare.load(arguments.old), compare.load(arguments.new)
    if pathlib.Path(arguments.old).is_file() and pathlib.Path(arguments.new).is_file():
        old = dict(zip(new, old.values(), strict=True))
    for name, report in new.items():
        if compare.figures(report):
            say(compare.describe(name, old.get(name), report))
    return 0


def _render(arguments: argparse.Namespace) -> int:
    return render.documents_anew(arguments.check, say)


if __name__ == "__main__":
    sys.exit(main())
