"""`pmt train | eval | sweep | table | reproduce | ...`: words into settings, nothing else."""

from __future__ import annotations

import argparse
import dataclasses
import os
import pathlib
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import pmt_jax

from .. import tasks
from ..config import settings, toml
from ..config.methods import METHODS
from ..errors import UsageError
from ..output import say

_METAVARS = {int: "N", float: "X"}
_RUN = "a run folder, or a pretrained policy: hub:ant_2x4/r4sg (pmt hub lists them)"


class _Parser(argparse.ArgumentParser):
    """argparse that raises one sentence, with the nearest known word, instead of printing its usage and exiting."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")

    def parse_all(self, argv: Sequence[str]) -> argparse.Namespace:
        known, unknown = self.parse_known_args(argv)
        if unknown:
            flags = [f for a in _actions(self, known) for f in a.option_strings]
            raise UsageError(f"unknown argument '{unknown[0]}'{tasks.did_you_mean(unknown[0].split('=')[0], flags)}")
        return known


def _actions(parser: argparse.ArgumentParser, parsed: argparse.Namespace) -> list[argparse.Action]:
    chosen = getattr(parsed, "command", None)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction) and chosen in action.choices:
            return action.choices[chosen]._actions
    return parser._actions


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code (2 for a user's mistake)."""
    return answer("pmt", lambda: _run(sys.argv[1:] if argv is None else list(argv)))


def answer(name: str, command: Callable[[], int]) -> int:
    """The exit code of `command`; a user's mistake gets one sentence that begins with the program's `name`, and 2."""
    try:
        code = command()
        sys.stdout.flush()  # here, where a reader that has gone away is noticed, and not when Python ends
        return code
    except UsageError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # whoever read our output, head for example, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def refuse_unknown(argv: Sequence[str], commands: Sequence[str]) -> None:
    """Names the nearest command where the first word is none; argparse would list them all."""
    if argv and not argv[0].startswith("-") and argv[0] not in commands:
        raise UsageError(f"unknown command '{argv[0]}'{tasks.did_you_mean(argv[0], commands)}")


def _run(argv: Sequence[str]) -> int:
    parser, commands = _parser()
    refuse_unknown(argv, commands)
    arguments = parser.parse_all(argv)
    if arguments.command is None:
        parser.print_help()
        return 0
    return arguments.run(arguments)


def _parser() -> tuple[_Parser, list[str]]:
    parser = _Parser(prog="pmt", description=pmt_jax.__doc__, allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"pmt {pmt_jax.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    _add_train(commands)
    _add_eval(commands)
    _add_sweep(commands)
    _add_table(commands)
    _add_reproduce(commands)
    _add_export(commands)
    doctor = commands.add_parser("doctor", help="what of this machine can be used, and why not the rest")
    doctor.set_defaults(run=_doctor)
    _add_render(commands)
    _add_plot(commands)
    _add_report(commands)
    envs = commands.add_parser("envs", help="list the tasks", allow_abbrev=False)
    envs.set_defaults(run=_envs)
    hub = commands.add_parser("hub", help="list the pretrained policies, and how good they are", allow_abbrev=False)
    hub.set_defaults(run=_hub)
    return parser, list(commands.choices)


def _add_train(commands: Any) -> None:
    train = commands.add_parser(
        "train",
        help="train a team: pmt train ant_2x4",
        description="Trains on TASK, or as a TOML file says.",
        allow_abbrev=False,
    )
    train.add_argument(
        "source",
        metavar="TASK|CONFIG",
        help="a task's name (pmt envs lists them), a TOML file, or a Python file with a task of your own: my_env.py",
    )
    train.add_argument("--out", type=pathlib.Path, help="the run folder (default: runs/TASK-METHOD-TIME)")
    train.add_argument("--resume", action="store_true", help="continue the run in --out from its last checkpoint")
    train.add_argument("--no-cache", action="store_true", help="do not keep compiled programs on disk")
    train.add_argument(
        "--sink", default="", metavar="NAMES", help="figures also go to csv, tensorboard, wandb (any, with commas)"
    )
    train.add_argument("--profile", type=pathlib.Path, metavar="DIR", help="write a JAX profiler trace of a few chunks")
    _add_devices(train)
    hosts = train.add_argument_group("several processes", "for a run on many hosts; under SLURM's srun none is needed")
    hosts.add_argument("--coordinator", metavar="HOST:PORT", help="where the first process listens")
    hosts.add_argument("--process", metavar="I", help="which process this is, from 0")
    hosts.add_argument("--processes", metavar="N", help="how many there are")
    _add_settings(train)
    train.set_defaults(run=_train)


def _add_devices(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--devices",
        metavar="N",
        help="split seeds and environments over N devices (default 1; in several processes all)",
    )


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """A flag for every field of Config."""
    parser.add_argument("--preset", default="default", help=" | ".join(toml.presets()))
    group = parser.add_argument_group("settings", "each may also stand in the TOML file")
    defaults = settings.Config()
    for field in dataclasses.fields(settings.Config):
        name, text = field.name, field.metadata["help"]
        if name == "task":  # it is the positional argument
            continue
        kind = settings.FIELDS[name]
        words = " | ".join(METHODS) if name == "method" else settings.expectation(kind)
        default = getattr(defaults, name)
        hint = f"{text.replace('%', '%%')} [{words}; default {default}]" if name != "env" else f"{text} [{words}]"
        flag = f"--{name.replace('_', '-')}"
        action = "append" if name == "env" else "store"
        group.add_argument(flag, dest=f"set_{name}", metavar=_METAVARS.get(kind, "WORD"), action=action, help=hint)


def _given(arguments: argparse.Namespace) -> dict[str, Any]:
    """The settings that the command line names."""
    return {k.removeprefix("set_"): v for k, v in vars(arguments).items() if k.startswith("set_") and v is not None}


def _add_eval(commands: Any) -> None:
    evaluation = commands.add_parser(
        "eval",
        help="evaluate a trained run: pmt eval runs/x; or a baseline: pmt eval voltage_33 --policy droop",
        description="Reward, cost, violation rate and the task's own figures over whole episodes with fixed keys.",
        allow_abbrev=False,
    )
    evaluation.add_argument(
        "source",
        metavar="RUN|TASK",
        help="a run folder, a pretrained policy (pmt hub lists them), or with --policy a task's name",
    )
    evaluation.add_argument("--policy", help="a policy that is not learned: zero, random, droop or opf (voltage tasks)")
    evaluation.add_argument("--env", action="append", default=[], metavar="NAME=VALUE", help="the task's own options")
    evaluation.add_argument("--episodes", default="32", help="episodes per seed (default 32)")
    evaluation.add_argument("--deterministic", action="store_true", help="take the mean action instead of a sample")
    _add_which(evaluation)
    evaluation.add_argument("--physics", metavar="WORD", help="an engine other than the run's: auto, mjx, warp, mujoco")
    evaluation.set_defaults(run=_eval)


def _add_sweep(commands: Any) -> None:
    sweep = commands.add_parser(
        "sweep",
        help="train many settings side by side: pmt sweep ant_2x4 --set lambda_lr=0.03,0.1,0.3 --set fear_l2=0,1",
        description="Trains every combination of the --set values; the same command goes on where it was interrupted.",
        allow_abbrev=False,
    )
    sweep.add_argument("source", metavar="TASK|CONFIG", help="as for pmt train, or a TOML file with [[sweep]] tables")
    sweep.add_argument(
        "--set",
        action="append",
        default=[],
        dest="vary",
        metavar="NAME=VALUE,...",
        help="a setting's values, method included; a value with commas goes into brackets: hidden=[64,64],[128,128]; "
        "or with --random a range: NAME=LOW:HIGH, NAME=log:LOW:HIGH",
    )
    sweep.add_argument("--random", default="0", metavar="N", help="draw N values from each range of --set")
    sweep.add_argument("--draw-seed", default="0", metavar="N", help="of these draws (default 0)")
    sweep.add_argument("--out", type=pathlib.Path, required=True, help="the folder that gets a run folder per point")
    sweep.add_argument("--no-cache", action="store_true", help="do not keep compiled programs on disk")
    _add_jobs(sweep)
    _add_devices(sweep)
    _add_settings(sweep)
    sweep.set_defaults(run=_sweep)


def _add_jobs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--jobs", default="1", metavar="N", help="programs that train at a time, for a GPU that one does not fill"
    )


def _add_table(commands: Any) -> None:
    table = commands.add_parser(
        "table",
        help="compare runs, with intervals over seeds, beside the paper's numbers: pmt table runs/*",
        description="One row per task, method and settings: interquartile means with 95 % intervals.",
        allow_abbrev=False,
    )
    table.add_argument("sources", nargs="+", type=pathlib.Path, metavar="RUN", help="run folders, or folders of them")
    table.add_argument("--baseline", metavar="METHOD", help="also show the probability of improvement over this row")
    table.add_argument("--test", action="store_true", help="also test against it: Mann-Whitney's U, Holm's correction")
    _add_format(table)
    table.add_argument("-o", dest="output", type=pathlib.Path, metavar="FILE", help="write it there")
    table.set_defaults(run=_table)


def _add_reproduce(commands: Any) -> None:
    reproduce = commands.add_parser(
        "reproduce",
        help="run what is missing for a table of the paper and print it: pmt reproduce table1",
        description="The same command goes on where it was interrupted.",
        allow_abbrev=False,
    )
    reproduce.add_argument("table", metavar="TABLE", help="table1 | table2 | table3 | fig4")
    reproduce.add_argument(
        "--budget",
        default="smoke",
        metavar="WORD",
        help="smoke (default): minutes, to see that everything runs | paper: 5 seeds, all steps; days on a CPU",
    )
    reproduce.add_argument("--out", type=pathlib.Path, help="the folder of its runs (default: runs/reproduce-BUDGET)")
    reproduce.add_argument("--no-cache", action="store_true", help="do not keep compiled programs on disk")
    _add_jobs(reproduce)
    _add_devices(reproduce)
    _add_format(reproduce)
    reproduce.set_defaults(run=_reproduce)


def _add_format(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--format", default="text", metavar="WORD", help="text (default) | markdown | latex | json")


def _add_export(commands: Any) -> None:
    export = commands.add_parser(
        "export",
        help="write a trained policy as files: pmt export runs/x -o policy",
        description="Writes policy.stablehlo (jax.export), policy.npz (weights) and numpy_policy.py (their loader).",
        allow_abbrev=False,
    )
    export.add_argument("source", metavar="RUN", type=pathlib.Path, help=_RUN)
    export.add_argument("-o", "--out", type=pathlib.Path, required=True, metavar="DIR", help="the folder to write")
    export.add_argument("--seed", metavar="N", help="which of the run's seeds (default: its first)")
    _add_which(export)
    export.set_defaults(run=_export)


def _add_which(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--which", default="last", metavar="WORD", help="which learner state: last (default) | best")


def _add_render(commands: Any) -> None:
    render = commands.add_parser(
        "render",
        help="see an episode of a run: pmt render runs/x -o x.html (or .gif, .mp4)",
        description="Plays one episode and writes it as a film, or as a page that replays it in any browser.",
        allow_abbrev=False,
    )
    render.add_argument("run_folder", metavar="RUN", type=pathlib.Path, help=_RUN)
    render.add_argument("-o", "--out", type=pathlib.Path, default=pathlib.Path("replay.html"), metavar="FILE")
    render.add_argument("--seed", metavar="K", help="whose policy, of the run's seeds (default: its first)")
    render.add_argument("--episode", default="0", metavar="N", help="which of the fixed starts (default 0)")
    render.add_argument("--deterministic", action="store_true", help="take the mean action instead of a sample")
    render.add_argument(
        "--steps", default=":", metavar="FROM:TO[:EVERY]", help="the control steps to show (default: all)"
    )
    render.add_argument("--fps", default="20", metavar="N", help="control steps shown a second (default 20)")
    render.add_argument("--size", default="640x360", metavar="WxH", help="pixels of a film (default 640x360)")
    render.set_defaults(run=_render)


def _add_plot(commands: Any) -> None:
    plot = commands.add_parser(
        "plot",
        help="draw the training curves of runs: pmt plot runs/* -o curves.png (or .svg, .pdf)",
        description="Reward, cost, violations, multiplier and emotions over training; runs that differ in nothing but "
        "their seeds make one curve: the mean over seeds, in a band from the lowest to the highest.",
        allow_abbrev=False,
    )
    plot.add_argument("run_folders", metavar="RUN", nargs="+", type=pathlib.Path, help="run folders")
    plot.add_argument("-o", "--out", type=pathlib.Path, default=pathlib.Path("curves.png"), metavar="FILE")
    plot.set_defaults(run=_plot)


def _add_report(commands: Any) -> None:
    report = commands.add_parser(
        "report",
        help="everything about runs on one page: pmt report runs/* -o report.html",
        description="Settings, versions, curves, an evaluation with intervals and a replay, in one file.",
        allow_abbrev=False,
    )
    report.add_argument("run_folders", metavar="RUN", nargs="+", type=pathlib.Path, help="run folders")
    report.add_argument("-o", "--out", type=pathlib.Path, default=pathlib.Path("report.html"), metavar="FILE")
    report.add_argument("--episodes", default="32", help="of the evaluation, per seed (default 32)")
    report.set_defaults(run=_report)


def _train(arguments: argparse.Namespace) -> int:
    config = settings.load_config(arguments.source, preset=arguments.preset, **_given(arguments))
    if arguments.resume and arguments.out is None:
        raise UsageError("--resume needs --out, the folder of the run to continue")
    count, process = _optional("--devices", arguments.devices, 1), _optional("--process", arguments.process, 0)
    hosts = _optional("--processes", arguments.processes, 1)
    _quiet_xla()
    from ..training import processes, trainer

    processes.join(arguments.coordinator, process, hosts)
    return trainer.train(
        config,
        arguments.out,
        arguments.resume,
        cache=not arguments.no_cache,
        loggers=[name for name in arguments.sink.split(",") if name],
        profile=arguments.profile,
        say=say,
        count=count,
    )


def _quiet_xla() -> None:
    """Silences XLA's C++ log before it loads: every program taken from the compile cache would print a page of CPU
    features that it wrongly takes for missing."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def _eval(arguments: argparse.Namespace) -> int:
    episodes = _whole("--episodes", arguments.episodes, least=1)
    _quiet_xla()
    from ..policies import evaluate

    if arguments.policy:
        options = dict(settings.convert("env", arguments.env))
        rows = [evaluate.evaluate_baseline(arguments.source, arguments.policy, episodes, options)]
        how = f"policy {arguments.policy}"
    else:
        source, physics = pathlib.Path(arguments.source), arguments.physics
        rows = evaluate.evaluate_run(source, episodes, arguments.deterministic, arguments.which, physics, say=say)
        how = f"{'mean' if arguments.deterministic else 'sampled'} actions"
        how += " of the best policy" if arguments.which == "best" else ""
    print(f"{arguments.source}: {episodes} episodes a seed, {how}; mean +- half-width of the 95 % interval")
    for row in rows:
        whose = f"seed {row['seed']} after {row['step']:,} steps " if "seed" in row else ""
        print(f"{whose}(cost limit {row['cost_limit']:g} an episode)")
        for name, figures in row.items():
            if isinstance(figures, tuple):
                print(f"  {name:24} {figures[0]:12.4f} +- {figures[1]:.4f}")
    return 0


def _sweep(arguments: argparse.Namespace) -> int:
    from ..studies.points import from_file, from_words, has_parts, make_points

    draws, seed = _whole("--random", arguments.random, 0), _whole("--draw-seed", arguments.draw_seed, 0)
    if has_parts(arguments.source) and (arguments.vary or draws):
        raise UsageError(f"{arguments.source} says itself what to sweep; leave out --set and --random")
    if not (arguments.vary or has_parts(arguments.source)):
        raise UsageError("nothing varies: give --set NAME=VALUE,..., or a TOML file with a [sweep] table")
    words = arguments.vary
    parts = [from_words(arguments.source, words, draws, seed)] if words else from_file(arguments.source)
    points = make_points(parts, arguments.preset, **_given(arguments))
    count = _optional("--devices", arguments.devices, 1)
    at_once = _alone("pmt sweep", arguments.jobs)
    from ..studies import sweep

    return sweep.sweep(parts, points, arguments.out, sweep.Launch(not arguments.no_cache, say, count, at_once))


def _alone(command: str, jobs: str) -> int:
    """Refuses to run once in each of several processes, which would write into the same folders; the number of jobs."""
    at_once = _whole("--jobs", jobs, least=1)
    _quiet_xla()
    from ..studies.workers import share_memory
    from ..training import processes

    processes.make_room()
    if at_once > 1:
        share_memory()
    if processes.in_step():
        raise UsageError(f"{command} runs in one process; start it without srun, or with srun --ntasks=1")
    return at_once


def _table(arguments: argparse.Namespace) -> int:
    from ..files import writing
    from ..studies import table
    from ..studies.rows import rows
    from ..studies.run_log import read_all

    found = rows(read_all(arguments.sources))
    text = table.render(found, arguments.format, arguments.baseline, arguments.test)
    if arguments.output is None:
        print(text, end="")
        return 0
    with writing(arguments.output) as partial:
        partial.write_text(text)
    return 0


def _reproduce(arguments: argparse.Namespace) -> int:
    count = _optional("--devices", arguments.devices, 1)
    at_once = _alone("pmt reproduce", arguments.jobs)
    from ..studies import reproduce, sweep

    out = arguments.out or pathlib.Path("runs") / f"reproduce-{arguments.budget}"
    launch = sweep.Launch(not arguments.no_cache, say, count, at_once)
    return reproduce.reproduce(arguments.table, arguments.budget, out, arguments.format, launch)


def _whole(flag: str, text: str, least: int) -> int:
    if not text.isdecimal() or int(text) < least:
        raise UsageError(f"{flag} must be a whole number of at least {least}, not '{text}'")
    return int(text)


def _optional(flag: str, text: str | None, least: int) -> int | None:
    return None if text is None else _whole(flag, text, least)


def _export(arguments: argparse.Namespace) -> int:
    seed = _optional("--seed", arguments.seed, 0)
    _quiet_xla()
    from ..policies.export import export_policy

    export_policy(arguments.source, arguments.out, seed, arguments.which)
    print(f"wrote policy.stablehlo, policy.npz and numpy_policy.py into {arguments.out}")
    return 0


def _doctor(arguments: argparse.Namespace) -> int:
    del arguments
    _quiet_xla()
    from . import doctor

    return doctor.report(say)


def _render(arguments: argparse.Namespace) -> int:
    seed = _optional("--seed", arguments.seed, 0)
    number = _whole("--episode", arguments.episode, 0)
    steps = [None if part == "" else _whole("--steps", part, 0) for part in arguments.steps.split(":")]
    if len(steps) not in (2, 3) or steps[2:] == [0]:
        raise UsageError(f"--steps must be FROM:TO or FROM:TO:EVERY, like 100:300:2, not '{arguments.steps}'")
    size = arguments.size.split("x")
    if len(size) != 2:
        raise UsageError(f"--size must be WIDTHxHEIGHT in pixels, like 640x360, not '{arguments.size}'")
    width, height = (_whole("--size", part, 32) for part in size)
    fps = _whole("--fps", arguments.fps, 1)
    _quiet_xla()
    from ..render import film

    film.render(
        arguments.run_folder,
        arguments.out,
        seed=seed,
        number=number,
        deterministic=arguments.deterministic,
        moments=slice(*steps),
        fps=fps,
        size=(width, height),
        say=say,
    )
    return 0


def _plot(arguments: argparse.Namespace) -> int:
    from ..studies import plot

    plot.plot(arguments.run_folders, arguments.out)
    say(f"wrote {arguments.out}")
    return 0


def _report(arguments: argparse.Namespace) -> int:
    episodes = _whole("--episodes", arguments.episodes, 1)
    _quiet_xla()
    from ..render import report

    report.report(arguments.run_folders, arguments.out, episodes, say=say)
    say(f"wrote {arguments.out}")
    return 0


def _envs(arguments: argparse.Namespace) -> int:
    del arguments
    print("\n".join(tasks.names()))
    return 0


def _hub(arguments: argparse.Namespace) -> int:
    del arguments
    from ..policies import hub

    print("mean actions, per episode; +- half-width of the 95 % interval over episodes (docs/pretrained.md)")
    for name in hub.names():
        facts = hub.about(name)
        (reward, rewards), (cost, costs) = (facts["figures"][f"episode_{what}"] for what in ("reward", "cost"))
        limit = f"limit {facts['cost_limit']:g}"
        print(f"{name:28} reward {reward:9.2f} +- {rewards:<7.2f} cost {cost:7.2f} +- {costs:<6.2f} {limit}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
