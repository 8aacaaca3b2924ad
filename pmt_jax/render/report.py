"""`pmt report`: all that is known of runs on one page."""

from __future__ import annotations

import html
import json
import math
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

from ..errors import UsageError, optional
from ..files import writing
from ..studies import plot

# ---------------------------------------------------------------------------------------------------------------------
# plot.Curves


# ---------------------------------------------------------------------------------------------------------------------
# The page


def report(
    folders: Sequence[pathlib.Path],
    out: pathlib.Path,
    episodes: int = 32,
    say: Callable[[str], None] = print,
) -> None:
    """Puts run folders on one page: curves, evaluation, emotions, replay, settings and versions, all in one file.

    What a run lacks (a checkpoint, say) is told in its place; the rest of the page is made.

    Args:
      out: an .html file.
      episodes: of the evaluation, per seed and kind of action.

    Raises:
      UsageError: a folder without figures, another ending, matplotlib missing, or `out` that cannot be written.
    """
    from . import page

    if out.suffix != ".html":
        raise UsageError(f"cannot write {out}: the ending of a report must be .html")
    optional("matplotlib", "render")
    runs = [plot.read(folder) for folder in folders]
    body = [*_heading(runs), *_curve_sections(plot.pool(runs))]
    for folder, run in zip(folders, runs, strict=True):
        say(f"evaluating {folder} ...")
        body.append(f"<section>\n<h2>{html.escape(folder.name)}</h2>")
        body.append(f"<p>{html.escape(_summary(run))}</p>")
        body += _or_reason(lambda folder=folder: _evaluation(folder, episodes))
        body += _or_reason(lambda folder=folder: _replay(folder))
        body += [*_details("Settings", run.settings), *_details("Versions", _versions(folder)), "</section>"]
    with writing(out) as partial:
        partial.write_text(page.page(_title(runs), body))


def _title(runs: Sequence[plot.Curves]) -> str:
    methods, tasks = (
        ", ".join(dict.fromkeys(words)) for words in zip(*((r.method, r.task) for r in runs), strict=True)
    )
    return f"{methods} on {tasks}"


def _heading(runs: Sequence[plot.Curves]) -> list[str]:
    seeds = sum(len(run.seeds) for run in runs)
    many = f"{len(runs)} run{'s' * (len(runs) != 1)}, {seeds} seed{'s' * (seeds != 1)} in all."
    return [f"<h1>{html.escape(_title(runs))}</h1>", f"<p>{many} Made by pmt report.</p>"]


def _summary(run: plot.Curves) -> str:
    seeds = ", ".join(map(str, run.seeds))
    took = f" in {run.seconds:,.0f} s" if math.isfinite(run.seconds) else ""
    return (
        f"{run.method} on {run.task}, seeds {seeds}; {int(run.steps[-1]):,} environment steps a seed{took}; "
        f"limit on an episode's cost {run.cost_limit:g}."
    )


def _curve_sections(runs: Sequence[plot.Curves]) -> list[str]:
    body = []
    for task in dict.fromkeys(run.task for run in runs):
        chosen = [run for run in runs if run.task == task]
        for title, wanted in (("Training", plot.PANELS), ("Emotions", plot.EMOTIONS)):
            panels = plot.panels(chosen, wanted)
            if not panels:
                continue
            swatches = (
                f'<span style="color:{plot.COLOURS[i % len(plot.COLOURS)]}">&#9632;</span> {html.escape(label)}'
                for i, label in enumerate(plot.labels(chosen))
            )
            figures = (
                f'<figure aria-label="{html.escape(name)}">{plot.inline(chosen, name)}</figure>' for name in panels
            )
            body.append(f"<h2>{title} on {html.escape(task)}</h2>")
            body.append(f"<p>{' &nbsp; '.join(swatches)}. Lines are means over seeds, bands reach from the lowest to")
            body.append(f'the highest.</p>\n<div class="curves">{"".join(figures)}</div>')
    return body


def _or_reason(make: Callable[[], list[str]]) -> list[str]:
    """A part of the page, or the sentence that says why it is missing."""
    try:
        return make()
    except UsageError as error:
        return [f"<p>{html.escape(str(error))}</p>"]


def _evaluation(folder: pathlib.Path, episodes: int) -> list[str]:
    from ..policies import evaluate
    from . import page

    kinds = {"sampled": False, "mean": True}
    found = {kind: evaluate.evaluate_run(folder, episodes, mean) for kind, mean in kinds.items()}
    rows = [(kind, row) for kind in kinds for row in found[kind]]
    main = [name for name in ("episode_reward", "episode_cost", "violation_rate") if name in rows[0][1]]
    others = [name for name, x in rows[0][1].items() if isinstance(x, tuple) and name not in main]

    def table(names: Sequence[str]) -> str:
        cells = ([f"seed {row['seed']}, {kind}", *(_with_interval(row[name]) for name in names)] for kind, row in rows)
        heads = (name.removeprefix("info/").removeprefix("episode_").replace("_", " ") for name in names)
        return page.table(["policy", *heads], cells)

    return [
        f"<h3>Evaluation</h3><p>{episodes} whole episodes a seed from fixed starts, actions sampled or the mean; "
        "mean and half-width of its 95 % interval.</p>",
        table(main),
        f"<details><summary>All figures of the task</summary>{table(others)}</details>" if others else "",
    ]


def _with_interval(figure: tuple[float, float]) -> str:
    """A figure and the half-width of its interval, with the digits that the interval leaves a meaning."""
    mean, half = figure
    digits = 4 if not half > 0 else min(6, max(0, 1 - math.floor(math.log10(half))))
    return f"{mean:,.{digits}f} ± {half:,.{digits}f}"


def _replay(folder: pathlib.Path) -> list[str]:
    from . import episode, page

    return ["<h3>An episode</h3>", page.replay(episode.record_run(folder), play=False)]


def _versions(folder: pathlib.Path) -> dict[str, Any]:
    try:
        return json.loads((folder / "versions.json").read_text())
    except (OSError, json.JSONDecodeError):
        return {}


def _details(title: str, values: dict[str, Any]) -> list[str]:
    from . import page

    if not values:
        return []
    rows = page.table([], [(name, str(value)) for name, value in values.items()])
    return [f"<details><summary>{title}</summary>{rows}</details>"]
