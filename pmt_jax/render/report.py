"""`pmt report`: all that is known of runs on one page."""

from __future__ import annotations

import html
import math
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

from ..errors import UsageError
from ..files import check_writable, writing
from ..limits import WORST
from ..policies import evaluate
from ..studies import plot, table
from ..studies.rows import rows
from ..studies.run_log import Group, RunLog, read_all
from ..training.health import faults
from . import episode, page

FIRST = ("method", "task", "limit", "seeds within", "worst seed")  # columns of the scores that must be in view


def report(
    folders: Sequence[pathlib.Path],
    out: pathlib.Path,
    episodes: int = 32,
    say: Callable[[str], None] = print,
) -> None:
    """Puts run folders on one page: curves, evaluation, emotions, replay, settings and versions, all in one file.

    If a run lacks something (a checkpoint, for example), the page has a note in its place.

    Args:
      folders: runs, or folders of runs; other folders are left out with a note.
      out: an .html file.
      episodes: of the evaluation, per seed and kind of action.

    Raises:
      UsageError: no run at all, another ending, or `out` that cannot be written.
    """
    if out.suffix != ".html":
        raise UsageError(f"cannot write {out}: the ending of a report must be .html")
    check_writable(out)
    logs = read_all(folders, say)
    title = _title(logs)
    body = [*_heading(title, logs), *_or_reason(lambda: scores(logs)), *_curve_sections(plot.pooled(logs, say))]
    for log in logs:
        say(f"evaluating {log.folder} ...")
        body += _run_section(log, episodes)
    with writing(out) as partial:
        partial.write_text(page.page(title, body))


def _title(logs: Sequence[RunLog]) -> str:
    methods, tasks = (", ".join(dict.fromkeys(x)) for x in zip(*((r.method, r.task) for r in logs), strict=True))
    return f"{methods} on {tasks}"


def _heading(title: str, logs: Sequence[RunLog]) -> list[str]:
    seeds = sum(len(log.seeds) for log in logs)
    many = f"{len(logs)} run{'s' * (len(logs) != 1)}, {seeds} seed{'s' * (seeds != 1)} in all."
    return [f"<h1>{html.escape(title)}</h1>", f"<p>{many} Made by pmt report.</p>"]


def scores(logs: Sequence[RunLog]) -> list[str]:
    """The table that `pmt table` prints of the runs."""
    head, lines, notes = table.cells(rows(logs, note=lambda _: None))
    first = [head.index(name) for name in FIRST]
    order = first + [i for i in range(len(head)) if i not in first]
    cells = [[line[i].replace(", ", ",\u00a0") for i in order] for line in lines]  # an interval may go below its mean
    explained = f"<details><summary>What the columns mean</summary><p>{html.escape(' '.join(notes))}</p></details>"
    return ["<h2>Scores</h2>", f'<div class="scores">{page.table([head[i] for i in order], cells)}</div>', explained]


# ---------------------------------------------------------------------------------------------------------------------
# Curves


def _curve_sections(shown: Sequence[Group]) -> list[str]:
    body = []
    for task in dict.fromkeys(group.task for group in shown):
        chosen = [group for group in shown if group.task == task]
        for title, wanted in (("Training", plot.titles(chosen)), ("Emotions", plot.EMOTIONS)):
            names = plot.panels(chosen, wanted)
            if not names:
                continue
            figures = (
                f'<figure aria-label="{html.escape(name)}">{plot.inline(chosen, name, wanted[name])}</figure>'
                for name in names
            )
            body.append(f"<h2>{title} on {html.escape(task)}</h2>")
            body.append(f'<ul class="legend">{"".join(map(_key, chosen, plot.looks(chosen)))}</ul>')
            body.append(f"<p>Curves: {html.escape(plot.caption(chosen))}.</p>")
            body.append(f'<div class="curves">{"".join(figures)}</div>')
    return body


def _key(group: Group, look: plot.Look) -> str:
    """An entry of the legend: a line as in the panels, and a name."""
    dashes = " ".join(f"{2.5 * float(length):g}" for length in look.dashes.split())
    line = f'<path d="M0 6H28" stroke="{look.colour}" stroke-width="3" stroke-dasharray="{dashes}"/>'
    swatch = f'<svg width="28" height="12" aria-hidden="true">{line}</svg>'
    return f"<li>{swatch}<span>{html.escape(plot.label(group))}</span></li>"


# ---------------------------------------------------------------------------------------------------------------------
# One run


def _run_section(log: RunLog, episodes: int) -> list[str]:
    played = _or_reason(lambda: evaluation(log.folder, episodes)) + _or_reason(lambda: _replay(log.folder))
    return [
        f"<section>\n<h2>{html.escape(log.folder.name)}</h2>",
        f"<p>{html.escape(_summary(log))}</p>",
        *dict.fromkeys(played),  # what both lack is reported once
        *_details("Settings", log.settings),
        *_details("Versions", log.versions),
        "</section>",
    ]


def _summary(log: RunLog) -> str:
    seeds = ", ".join(map(str, log.seeds))
    seconds = log.metrics.get("seconds", [[math.nan]])[0][-1]
    wrong = faults(log.faults, int(log.steps[-1]) * len(log.seeds))
    broke = "".join(f" Seed {seed} broke by step {step:,} and was not trained on." for seed, step in log.broken.items())
    took = f" in {seconds:,.0f} s" if math.isfinite(seconds) else ""
    return (
        f"{log.method} on {log.task}, seeds {seeds}; {int(log.steps[-1]):,} environment steps a seed{took}; "
        f"limit on an episode's cost {log.limits}.{f' {wrong}.' if wrong else ''}{broke}"
    )


def _or_reason(make: Callable[[], list[str]]) -> list[str]:
    """A part of the page, or the sentence that says why it is missing."""
    try:
        return make()
    except UsageError as error:
        return [f"<p>{html.escape(str(error))}</p>"]


def evaluation(folder: pathlib.Path, episodes: int) -> list[str]:
    """Lines of HTML: the run's policies on new episodes, with sampled and with mean actions."""
    kinds = {"sampled": False, "mean": True}
    found = {kind: evaluate.evaluate_run(folder, episodes, mean) for kind, mean in kinds.items()}
    results = [(kind, row) for kind in kinds for row in found[kind]]
    first = results[0][1]
    wanted = ("episode_reward", "episode_cost", f"episode_cost{WORST}", "within_limit", "violation_rate")
    main = [name for name in wanted if name in first]
    others = [name for name, x in first.items() if isinstance(x, tuple) and name not in main]

    def listing(names: Sequence[str]) -> str:
        cells = (
            [f"seed {row['seed']}, {kind}", *(_with_interval(row[name]) for name in names)] for kind, row in results
        )
        heads = (name.removeprefix("info/").removeprefix("episode_").replace("_", " ") for name in names)
        return page.table(["policy", *heads], cells)

    wrong = [f"<p>Seed {row['seed']}, {kind} actions: {row['faults']}.</p>" for kind, row in results if row["faults"]]
    return [
        f"<h3>Evaluation</h3><p>{episodes} whole episode{'s' * (episodes > 1)} a seed from fixed starts, actions "
        "sampled or the mean; mean and half-width of its 95 % interval.</p>",
        *wrong,
        listing(main),
        f"<details><summary>All metrics of the task</summary>{listing(others)}</details>" if others else "",
    ]


def _with_interval(metric: tuple[float, float]) -> str:
    """A metric and the half-width of its interval, with the digits that the interval leaves a meaning."""
    mean, half = metric
    if not math.isfinite(half):
        return f"{mean:,.4f} ± -"
    digits = 4 if not half > 0 else min(6, max(0, 1 - math.floor(math.log10(half))))
    return f"{mean:,.{digits}f} ± {half:,.{digits}f}"


def _replay(folder: pathlib.Path) -> list[str]:
    return ["<h3>An episode</h3>", page.replay(episode.record_run(folder), play=False)]


def _details(title: str, values: dict[str, Any]) -> list[str]:
    if not values:
        return []
    lines = page.table([], [(name, str(value)) for name, value in values.items()])
    return [f"<details><summary>{title}</summary>{lines}</details>"]
