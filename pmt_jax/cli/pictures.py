"""`pmt render`, `pmt plot`, `pmt report`: runs as films, curves and pages."""

from __future__ import annotations

import argparse
from typing import Any

from .. import numerics
from ..output import say
from .parser import RUN, add_deterministic, add_out, add_seed, add_trust, command, path, pixels, span, whole
from .process import interruptible


def add(commands: Any) -> None:
    """Adds the commands."""
    render = command(
        commands,
        "render",
        run_render,
        "play an episode of a run: pmt render runs/x -o x.html (or .gif, .mp4)",
        description="Plays one episode and writes it as a film, or as a page that replays it in any browser.",
    )
    render.add_argument("run_folder", metavar="RUN", type=path, help=RUN)
    add_out(render, "replay.html")
    add_seed(render)
    render.add_argument(
        "--episode", type=whole(0), default=0, metavar="N", help="which of the fixed starts (default 0)"
    )
    add_deterministic(render)
    add_trust(render)
    render.add_argument(
        "--steps", type=span, default=":", metavar="FROM:TO[:EVERY]", help="the control steps to show (default: all)"
    )
    render.add_argument(
        "--fps", type=whole(1, 1000), default=20, metavar="N", help="control steps shown a second (default 20)"
    )
    render.add_argument(
        "--size", type=pixels, default="640x360", metavar="WxH", help="pixels of a film (default 640x360)"
    )

    plot = command(
        commands,
        "plot",
        run_plot,
        "draw the training curves of runs: pmt plot runs/* -o curves.png (or .svg, .pdf)",
        description="Reward, cost, violations, multiplier and emotions over training; runs that differ in nothing but "
        "their seeds make one curve: the mean over seeds, in a band from the lowest to the highest.",
    )
    plot.add_argument("run_folders", metavar="RUN", nargs="+", type=path, help="run folders")
    add_out(plot, "curves.png")

    report = command(
        commands,
        "report",
        run_report,
        "everything about runs on one page: pmt report runs/* -o report.html",
        description="Settings, versions, curves, an evaluation with intervals and a replay, in one file.",
    )
    report.add_argument("run_folders", metavar="RUN", nargs="+", type=path, help="run folders")
    add_out(report, "report.html")
    report.add_argument(
        "--episodes", type=whole(1), default=32, metavar="N", help="of the evaluation, per seed (default 32)"
    )
    add_trust(report)


def run_render(arguments: argparse.Namespace) -> int:
    """Writes an episode as a film or a page."""
    with interruptible():
        numerics.check()
        from ..render import film
        from ..trust import trusting

    with trusting(arguments.trust):
        film.render(
            arguments.run_folder,
            arguments.out,
            seed=arguments.seed,
            number=arguments.episode,
            deterministic=arguments.deterministic,
            moments=arguments.steps,
            fps=arguments.fps,
            size=arguments.size,
            say=say,
        )
    return 0


def run_plot(arguments: argparse.Namespace) -> int:
    """Draws training curves."""
    with interruptible():
        from ..studies import plot

    plot.plot(arguments.run_folders, arguments.out)
    say(f"wrote {arguments.out}")
    return 0


def run_report(arguments: argparse.Namespace) -> int:
    """Writes everything about runs on one page."""
    with interruptible():
        numerics.check()
        from ..policies.load import check_trusted
        from ..render import report
        from ..trust import trusting

    with trusting(arguments.trust):
        for folder in arguments.run_folders:
            check_trusted(folder)
        report.report(arguments.run_folders, arguments.out, arguments.episodes, say=say)
    say(f"wrote {arguments.out}")
    return 0
