"""`pmt train`: trains a team."""

from __future__ import annotations

import argparse
import logging
import sys
from typing import Any

from .. import numerics
from ..config.load import load_config
from ..errors import UsageError
from ..output import say
from ..trust import check_source, trusting
from .flags import add_settings, given
from .parser import SOURCE, add_cache, add_devices, add_trust, command, names, path, whole
from .process import check_system, interruptible


def add(commands: Any) -> None:
    """Adds the command."""
    parser = command(
        commands,
        "train",
        run,
        "train a team: pmt train ant_2x4",
        usage="pmt train TASK|CONFIG [--SETTING VALUE ...]",
        description="Trains on TASK, or with the settings of a TOML file. A file may hold every setting below.",
        add_help=False,
    )
    parser.add_argument("source", metavar="TASK|CONFIG", help=SOURCE)
    output = add_settings(parser)["output"]
    output.add_argument("--out", type=path, metavar="DIR", help="the run folder (default: a new one in runs/)")
    output.add_argument("--resume", action="store_true", help="continue the run in --out from its last checkpoint")
    output.add_argument(
        "--change", action="store_true", help="with --resume: continue with settings other than those of the run"
    )
    output.add_argument(
        "--loggers",
        type=names,
        default=[],
        metavar="NAMES",
        help="metrics also go to any of csv, tensorboard, wandb",
    )
    output.add_argument("--profile", type=path, metavar="DIR", help="JAX profiler trace of a few chunks")
    output.add_argument(
        "--debug", action="store_true", help="stop at the first number that is not finite and name its tensor; slower"
    )
    output.add_argument("--verbose", action="store_true", help="show what Warp prints about each of its kernels")
    add_cache(output)
    add_trust(output)
    hosts = parser.add_argument_group("devices and processes", "under SLURM's srun, processes need no flag")
    add_devices(hosts)
    hosts.add_argument(
        "--workers",
        type=whole(1),
        default=1,
        metavar="N",
        help="processes that share seeds and CPUs (default 1)",
    )
    hosts.add_argument("--coordinator", metavar="HOST:PORT", help="where the first process listens")
    hosts.add_argument("--process", type=whole(0), metavar="I", help="which process this is, from 0")
    hosts.add_argument("--processes", type=whole(1), metavar="N", help="how many there are")


@interruptible()
def run(arguments: argparse.Namespace) -> int:
    """Trains as the arguments say."""
    config = load_config(arguments.source, preset=arguments.preset, **given(arguments))
    if arguments.resume and arguments.out is None:
        raise UsageError("--resume needs --out, the folder of the run to continue")
    if arguments.change and not arguments.resume:
        raise UsageError("--change belongs to --resume; without it the settings are those of a new run")
    with trusting(arguments.trust):
        check_source(arguments.source, [config.task, config.method], [arguments.set_method or ""])
        if arguments.verbose:
            logging.getLogger("envs").setLevel(logging.INFO)
        if sys.stdout.isatty():
            say("loading JAX and the task ...")  # ten seconds with Warp
        check_system()
        numerics.check_settings()
        from ..policies import warm_start
        from ..studies import verdict
        from ..training import processes, trainer

        processes.join(arguments.coordinator, arguments.process, arguments.processes, arguments.devices)
        numerics.check_devices()
        return trainer.train(
            config,
            arguments.out,
            arguments.resume,
            cache=not arguments.no_cache,
            loggers=arguments.loggers,
            profile=arguments.profile,
            say=say,
            devices=arguments.devices,
            workers=arguments.workers,
            warm_start=warm_start.prepare,
            debug=arguments.debug,
            change=arguments.change,
            conclude=verdict.lines,
        )
