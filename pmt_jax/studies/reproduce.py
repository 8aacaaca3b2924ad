"""`pmt reproduce`: the paper's tables, trained and printed next to the paper's numbers."""

from __future__ import annotations

import contextlib
import pathlib
from collections.abc import Mapping, Sequence

from ..config.methods import METHODS
from ..errors import UsageError
from ..output import result
from ..tasks import did_you_mean, names
from ..training import lock
from . import table
from .points import Part, Points, make_points
from .rows import rows
from .run_log import read_all
from .sweep import ONE_AT_A_TIME, Launch, check_tasks, missing_programs, train_programs


def reproduce(
    name: str,
    budget: str,
    seeds: int | None,
    out: pathlib.Path,
    layout: str = "text",
    launch: Launch = ONE_AT_A_TIME,
) -> int:
    """Trains what is missing of a table of the paper, its methods on its tasks, and prints it next to the paper's.

    Args:
      name: a table in paper.toml; budget: one of its budgets; layout: of the table, see `table.FORMATS`.
      seeds: of each method on each task; None for the budget's.

    Raises:
      UsageError: an unknown table or budget, or a task that cannot run here.
    """
    paper = table.paper()
    choices = (
        ("table", name, paper["tables"]),
        ("budget", budget, paper["budgets"]),
        ("format", layout, table.FORMATS),
    )
    for what, word, known in choices:
        if word not in known:
            raise UsageError(f"unknown {what} '{word}'{did_you_mean(word, known)}")
    wanted = paper["tables"][name]
    settings = {**paper["budgets"], **wanted.get("budgets", {})}[budget]
    absent = [task for task in wanted["tasks"] if task not in names()]
    if absent:
        raise UsageError(f"{name} needs the task '{absent[0]}', which this version of pmt-jax does not have")
    methods = wanted.get("methods", paper.get("methods", list(METHODS)))
    plans = {task: plan(task, methods, settings, seeds) for task in wanted["tasks"]}
    check_tasks(next(iter(points.values())) for points in plans.values())
    with contextlib.ExitStack() as stack:
        for task in plans:
            stack.enter_context(lock.acquire(out / task))
        missing = [missing_programs(points, out / task, launch.say) for task, points in plans.items()]
        code = train_programs([program for programs in missing for program in programs], launch)
    if code:
        return code
    logs = read_all([out / task / point for task, points in plans.items() for point in points])
    if layout == "text":
        launch.say(f"\n{wanted['title']}, budget '{budget}'\n")
    result(table.render(rows(logs), layout, wanted["baseline"]))
    return 0


def plan(task: str, methods: Sequence[str], budget: Mapping[str, str], seeds: int | None = None) -> Points:
    """A budget's settings of a task: its `source` for that task, or its `preset` over the task's own, and `seeds`."""
    source = budget.get("source", "{task}").format(task=task)
    fixed = {} if seeds is None else {"seeds": seeds}
    return make_points([Part(source, {"method": methods})], preset=budget.get("preset", "default"), **fixed)
