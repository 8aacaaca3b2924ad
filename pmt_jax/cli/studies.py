"""`pmt sweep`, `pmt table`, `pmt compare`, `pmt reproduce`: many runs."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Sequence
from typing import Any

from ..errors import UsageError
from ..files import to_stderr
from ..output import check_written, result, say
from ..trust import check_source, trusting
from .flags import add_settings, given
from .parser import SOURCE, add_format, add_jobs, add_trust, command, path, whole
from .process import interruptible, refuse_many

OF_RUNS = {  # flags of `pmt train`, and what many runs have in their place
    "--resume": "the same command without it continues what was interrupted",
    "--workers": "only pmt train has workers; --jobs N trains N programs at a time",
}


def add(commands: Any) -> None:
    """Adds the commands."""
    _add_sweep(commands)
    _add_table(commands)
    _add_compare(commands)
    _add_reproduce(commands)


def _add_sweep(commands: Any) -> None:
    sweep = command(
        commands,
        "sweep",
        run_sweep,
        "train many settings side by side: pmt sweep ant_2x4 --set lambda_lr=1,2,4 --set emotion_l2=0,1",
        usage="pmt sweep TASK|CONFIG --set NAME=VALUE,... [--set ...] --out DIR [--SETTING VALUE ...]",
        description="Trains every combination of the --set values; the same command continues an interrupted sweep.",
        add_help=False,
    )
    sweep.add_argument("source", metavar="TASK|CONFIG", help=f"{SOURCE}; a TOML file may hold [[sweep]] tables")
    sweep.add_argument(
        "--set",
        action="append",
        default=[],
        dest="vary",
        metavar="NAME=VALUE,...",
        help="a setting's values, method included; a value with commas goes into brackets: hidden=[64,64],[128,128]; "
        "or with --random a range: NAME=LOW:HIGH, NAME=log:LOW:HIGH",
    )
    sweep.add_argument("--random", type=whole(1), default=0, metavar="N", help="draw N values from each range of --set")
    sweep.add_argument("--draw-seed", type=whole(0), default=0, metavar="N", help="seed of these draws (default 0)")
    sweep.add_argument("--out", type=path, required=True, metavar="DIR", help="gets a run folder per point")
    sweep.add_argument(
        "--part",
        metavar="I/N",
        help="train share I of N of the programs; N such commands, also on several hosts that share DIR, finish the "
        "sweep (in a SLURM job array the task's own share; 1/1 for all)",
    )
    sweep.set_defaults(elsewhere=OF_RUNS)
    add_jobs(sweep)
    add_trust(sweep)
    add_settings(sweep)


def _add_table(commands: Any) -> None:
    table = command(
        commands,
        "table",
        run_table,
        "compare runs with intervals over seeds, next to the paper's numbers: pmt table runs/*",
        description="One row per task, method and settings: interquartile means with 95 % intervals.",
    )
    table.add_argument("sources", nargs="+", type=path, metavar="RUN", help="run folders, or folders of them")
    table.add_argument("--baseline", metavar="METHOD", help="also show the probability of improvement over this row")
    table.add_argument(
        "--test",
        action="store_true",
        help="also print p values against the baseline: Mann-Whitney U, Holm's correction",
    )
    add_format(table)
    table.add_argument("-o", dest="output", type=path, metavar="FILE", help="write the table to this file instead")


def _add_compare(commands: Any) -> None:
    compare = command(
        commands,
        "compare",
        run_compare,
        "compare two runs of one task: pmt compare runs/f4sg runs/mappo_l -o curves.png",
        description="Reward, cost and seeds within the limit: difference of means and probability of improvement, "
        "each with its 95-percent interval over seeds.",
    )
    for name in ("first", "second"):
        run = "a run folder, or a folder of runs that differ only in their seeds"
        compare.add_argument(name, metavar="RUN", type=path, help=run)
    compare.add_argument("-o", "--out", type=path, metavar="FILE", help="also draw the curves: .png, .svg, .pdf")


def _add_reproduce(commands: Any) -> None:
    reproduce = command(
        commands,
        "reproduce",
        run_reproduce,
        "train the missing runs of a table of the paper and print it: pmt reproduce table1",
        description="The same command continues where it was interrupted.",
    )
    reproduce.add_argument("table", metavar="TABLE", help="table1 | table2 | table3 | fig4 | velocity")
    reproduce.add_argument(
        "--budget",
        default="smoke",
        metavar="WORD",
        help="smoke (default): minutes, to see that everything runs | paper: all steps and seeds; days on a CPU",
    )
    reproduce.add_argument("--seeds", type=whole(1), metavar="N", help="seeds a run (default: the budget's)")
    reproduce.add_argument(
        "--out", type=path, metavar="DIR", help="the folder of its runs (default: runs/reproduce-BUDGET)"
    )
    reproduce.set_defaults(elsewhere=OF_RUNS)
    add_jobs(reproduce)
    add_format(reproduce)


@interruptible()
def run_sweep(arguments: argparse.Namespace) -> int:
    """Trains all combinations of some settings' values."""
    from ..studies.points import from_file, from_words, has_parts, make_points

    source, words, draws = arguments.source, arguments.vary, arguments.random
    if has_parts(source) and (words or draws):
        raise UsageError(f"{source} already has a sweep; leave out --set and --random")
    if not (words or has_parts(source)):
        raise UsageError("nothing varies: give --set NAME=VALUE,..., or a TOML file with a [[sweep]] table")
    parts = [from_words(source, words, draws, arguments.draw_seed)] if words else from_file(source)
    points = make_points(parts, arguments.preset, **given(arguments))
    refuse_many("pmt sweep", arguments.jobs, arguments.devices)
    from ..policies.load import check_trusted
    from ..studies import shares, sweep

    with trusting(arguments.trust):
        named = [name for config in points.values() for name in (config.task, config.method)]
        check_source(source, named, [arguments.set_method or "", *_methods(words)])
        for run in {config.init for config in points.values() if config.init}:
            check_trusted(pathlib.Path(run))  # here, because worker processes do not ask again
        if share := shares.read(arguments.part) if arguments.part else shares.of_array():
            if arguments.jobs > 1:
                raise UsageError("--part trains one program at a time; start more parts instead of --jobs")
            code = shares.train(share, parts, points, arguments.out, _launch(arguments))
        else:
            code = sweep.sweep(parts, points, arguments.out, _launch(arguments))
    check_written()
    return code


def _methods(words: Sequence[str]) -> list[str]:
    """The methods that `--set method=...` names."""
    return [name for word in words if word.startswith("method=") for name in word.removeprefix("method=").split(",")]


def _launch(arguments: argparse.Namespace) -> Any:
    from ..studies import sweep

    return sweep.Launch(not arguments.no_cache, say, arguments.devices, arguments.jobs)


@interruptible()
def run_table(arguments: argparse.Namespace) -> int:
    """Prints or writes runs as a table."""
    from ..files import writing
    from ..studies import table
    from ..studies.rows import rows
    from ..studies.run_log import read_all

    found = rows(read_all(arguments.sources))
    text = table.render(found, arguments.format, arguments.baseline, arguments.test)
    if arguments.output is None:
        result(text.removesuffix("\n"))
        return 0
    with writing(arguments.output) as partial:
        partial.write_text(text)
    if arguments.output.is_file():  # behind what goes to /dev/stdout it would be one more line of the table
        say(f"wrote {arguments.output}")
    return 0


@interruptible()
def run_compare(arguments: argparse.Namespace) -> int:
    """Prints how two runs differ."""
    from ..studies import compare

    result(compare.compare(arguments.first, arguments.second, arguments.out).removesuffix("\n"))
    if arguments.out:
        say(f"wrote {arguments.out}")
    return 0


@interruptible()
def run_reproduce(arguments: argparse.Namespace) -> int:
    """Trains what is missing of one of the paper's tables and prints it."""
    refuse_many("pmt reproduce", arguments.jobs, arguments.devices)
    from ..studies import reproduce

    out = arguments.out or pathlib.Path("runs") / f"reproduce-{arguments.budget}"
    wanted = (arguments.table, arguments.budget, arguments.seeds)
    launch = _launch(arguments)
    if arguments.format != "text":  # which other programs read
        launch = launch._replace(say=to_stderr)
    code = reproduce.reproduce(*wanted, out, arguments.format, launch)
    check_written()
    return code
