"""Speed and memory, measured, compared with what was committed, and rendered into the documentation.

python -m bench list                           what is measured, and how long it took
python -m bench run                            everything, into bench/results; then the documentation's tables
python -m bench run --quick                    does everything run? minutes, into a folder of its own
python -m bench run ant grid                   some of it
python -m bench peers --quick                  training compared with brax, JaxMARL, PyTorch and plain loops
python -m bench compare HEAD~5 bench/results   results as files, folders or git revisions
python -m bench render --check                 are the documentation's tables what bench/results says?
python -m bench store RUN... -o FILE.json      training runs as a result for tables and pictures
python -m bench publish RUN...                 the best policy of each run becomes the pretrained one of its task
"""

from __future__ import annotations

import argparse
import functools
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from pmt_jax.cli import end
from pmt_jax.cli.parser import Parser, command, refuse_unknown, whole
from pmt_jax.cli.process import answer
from pmt_jax.studies import plot

from . import compare, records, render, runner
from .cases import BENCHES
from .tables import runs

say = functools.partial(print, flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code: 2 for a user's mistake, 1 if a bench failed or a table is old."""
    return answer("bench", lambda: _run(sys.argv[1:] if argv is None else list(argv)))


def _run(argv: Sequence[str]) -> int:
    parser = Parser(prog="python -m bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands: Any = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    _add_measuring(commands)
    _add_showing(commands)
    refuse_unknown(argv, commands.choices)
    arguments = parser.parse_all(argv)
    return arguments.run(arguments)


def _add_measuring(commands: Any) -> None:
    command(commands, "list", _list, "the benches, and how long they took")
    every = command(commands, "run", _run_benches, "run all benches, or some, one after the other")
    every.add_argument("names", nargs="*", metavar="NAME", help="python -m bench list shows them")
    every.add_argument("--out", type=pathlib.Path, help="a folder (default: bench/results; for parts a new one)")
    one = command(commands, "measure", _measure, "run one bench in this process, as `run` does in another")
    one.add_argument("name", choices=BENCHES)
    one.add_argument("--out", type=pathlib.Path, required=True, help="a JSON file")
    peers = command(commands, "peers", _peers, "train for the same time as brax, JaxMARL, PyTorch and plain loops")
    peers.add_argument(
        "--out", type=pathlib.Path, help="a JSON file (default: in bench/results; with --quick a new one)"
    )
    peers.add_argument("--jaxmarl", type=pathlib.Path, metavar="FOLDER", help="a clone of JaxMARL, for its trainer")
    peers.add_argument("--quick", action="store_true", help="one turn of a few seconds each")
    for parser in (every, one):
        parser.add_argument("--quick", action="store_true", help="a smoke: few cases, few repeats")
        parser.add_argument("--threads", type=whole(0), default=0, help="use so many of the CPU's")
        parser.add_argument("--only", default="", metavar="WORDS", help="cases whose labels have all these")


def _add_showing(commands: Any) -> None:
    compared = command(commands, "compare", _compare, "ratios between results")
    compared.add_argument("old", help="a JSON file, a folder of them, or a git revision")
    compared.add_argument("new", help="the same")
    rendered = command(commands, "render", _render, "make the tables of README.md and docs/ from bench/results")
    rendered.add_argument("--check", action="store_true", help="write nothing; exit code 1 if a table is old")
    stored = command(commands, "store", _store, "training runs as a result")
    stored.add_argument("folders", nargs="+", type=pathlib.Path, metavar="RUN", help="run folders, or folders of them")
    stored.add_argument("-o", "--out", type=pathlib.Path, required=True, help="a JSON file")
    stored.add_argument("--same-end", action="store_true", help="read all at the last step that every run reached")
    stored.add_argument("--points", type=whole(1), default=plot.POINTS, help="the most of a curve (default 100)")
    published = command(commands, "publish", _publish, "make pretrained policies of runs, and report their metrics")
    published.add_argument(
        "folders", nargs="*", type=pathlib.Path, metavar="RUN", help="run folders, or hub:NAME to measure it anew"
    )
    published.add_argument("--episodes", type=whole(1), default=64, help="of the evaluations (default 64)")


def _list(arguments: argparse.Namespace) -> int:
    reports = records.load()
    for name, bench in BENCHES.items():
        found = [r for result, r in reports.items() if result == name or result.startswith(f"{name}_")]
        took = ", ".join(f"{r['seconds']} s on {r['device']}" for r in found if "seconds" in r)
        say(f"{name}: {bench.what}{f' (took {took})' if took else ''}")
    return 0


def _run_benches(arguments: argparse.Namespace) -> int:
    asked = arguments.quick, arguments.threads, arguments.only
    code = runner.run(arguments.names, arguments.out, *asked, say)
    if arguments.out is None and not any(asked):
        render.documents_anew(check=False, say=say)
    return code


def _measure(arguments: argparse.Namespace) -> int:
    runner.measure(arguments.name, arguments.out, arguments.quick, arguments.threads, arguments.only, say)
    return 0


def _peers(arguments: argparse.Namespace) -> int:
    from .peers import contest  # which imports what the learners need

    return contest.run(arguments.out, arguments.quick, arguments.jaxmarl, say)


def _compare(arguments: argparse.Namespace) -> int:
    old, new = records.load(arguments.old), records.load(arguments.new)
    if pathlib.Path(arguments.old).is_file() and pathlib.Path(arguments.new).is_file():
        old = dict(zip(new, old.values(), strict=True))
    for name, report in new.items():
        if compare.figures(report):
            say(compare.describe(name, old.get(name), report))
    return 0


def _render(arguments: argparse.Namespace) -> int:
    return render.documents_anew(arguments.check, say)


def _store(arguments: argparse.Namespace) -> int:
    stored = runs.store(arguments.folders, arguments.out, arguments.same_end, arguments.points)
    say(f"{stored} run(s) in {arguments.out}")
    return 0


def _publish(arguments: argparse.Namespace) -> int:
    from pmt_jax.policies import publish
    from pmt_jax.training.compile import use_cache

    use_cache()
    for folder in arguments.folders:
        facts = publish.publish(folder, arguments.episodes)
        reward, cost = (facts["figures"][f"episode_{what}"][0] for what in ("reward", "cost"))
        say(f"{folder}: seed {facts['seed']}, {facts['which']}, reward {reward:.2f}, cost {cost:.2f}")
    records.write(records.RESULTS / "hub.json", publish.rows(), "python -m bench publish")
    return render.documents_anew(check=False, say=say)


if __name__ == "__main__":
    end(main())
