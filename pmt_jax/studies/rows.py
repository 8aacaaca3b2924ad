"""Rows of a table: one score per seed and column, pooled over runs that share task, method and settings.

A score is a metric's mean over the last tenth of the steps, of the evaluations made there (`eval/...` in metrics.jsonl:
whole episodes under mean actions) if the run made any, else of the training episodes that ended there (sampled
actions).
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from ..config.methods import METHODS
from ..errors import UsageError
from ..files import Note
from ..limits import WORST, Limits
from ..tasks import columns as task_columns
from ..training.health import faults
from . import statistics
from .run_log import Group, RunLog, groups


class Column(NamedTuple):
    """A metric as a column.

    Attributes:
      name: the column's head.
      metric: its name in metrics.jsonl.
      low, high: no value lies beyond; intervals are cut there.
      note: what it is, under the table.
      throughout: whether a score is the mean over all of training, not over its last tenth.
    """

    name: str
    metric: str
    low: float = -math.inf
    high: float = math.inf
    note: str = ""
    throughout: bool = False


COLUMNS = (
    Column("reward", "episode_reward", note="reward: undiscounted, of the team, per episode"),
    Column("cost", "episode_cost", 0, note="cost: undiscounted, of one agent (mean over agents), per episode"),
    Column("worst agent", f"episode_cost{WORST}", 0, note="worst agent: cost of the agent whose is highest"),
    Column("violation rate", "violation_rate", 0, 1, "violation rate: share of steps with a cost for some agent"),
    Column("true cost", "true_episode_cost", 0, note="true: with the costs that the learner did not observe"),
    Column("true worst agent", f"true_episode_cost{WORST}", 0),
    Column("true violation rate", "true_violation_rate", 0, 1),
    Column("true step cost", "true_step_cost", 0),
    Column(
        "episodes within", "within_limit", 0, 1, "episodes within: share of episodes whose cost is within the limit"
    ),
    Column(
        "cost beyond",
        "episode_cost_beyond",
        0,
        note="cost beyond: an episode's cost beyond the limit, 0 within it, mean over all of training",
        throughout=True,
    ),
)


def columns(tasks: Iterable[str]) -> list[Column]:
    """All columns that runs of these tasks may have, in order: the common ones, then what the tasks declare."""
    declared = {name: column for task in tasks for name, column in task_columns(task).items()}
    own = (Column(c.name, f"info/{x}", c.low, c.high, f"{c.name}: {c.definition}") for x, c in declared.items())
    return [*COLUMNS, *own]


@dataclasses.dataclass(frozen=True)
class TableRow:
    """The seeds of all runs with the same task, method and settings.

    Attributes:
      task, method: their names; settings: what differs from other rows of the same task, as `name=value`.
      limits: on the costs of any agent.
      steps: environment steps per seed (the fewest, if runs differ).
      source: `evaluation` or `training`, what the scores are taken from.
      scores: {column: [seeds]} in the task's units; nan if a seed has none.
      excess: [seeds] cost beyond the limit, see `RunLog.excess`; of the cost in `scores` if None.
      true_limits: on true costs; None if unknown.
      faults: which steps broke the contract of tasks, in a sentence; empty if none did.
      deployed: `reward`, `cost` (of the worst agent) and `beyond` [seeds] of the evaluations under mean actions that
        ended the runs, and `evaluated`, whether there was one; a seed that broke has nan. Empty if no run has one.
    """

    task: str
    method: str
    settings: str
    limits: Limits
    steps: int
    source: str
    scores: dict[str, np.ndarray]
    excess: np.ndarray | None = None
    true_limits: Limits | None = None
    faults: str = ""
    deployed: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def score(self, column: str) -> np.ndarray:
        """[seeds] of a column, nan if the row does not have it; where agents share costs, all are the worst agent."""
        nothing = np.full(len(next(iter(self.scores.values()), [0])), np.nan)
        return self.scores.get(column, self.scores.get(column.replace("worst agent", "cost"), nothing))

    @property
    def beyond(self) -> np.ndarray:
        """[seeds] cost beyond the limit, of the agent and cost furthest beyond; at most 0 within it."""
        return self.limits.excess(self.score("worst agent")[:, None, None]) if self.excess is None else self.excess

    def limit_on(self, column: str) -> str:
        """The limit on the costs of a column, in words."""
        return str(self.true_limits or self.limits if column.startswith("true ") else self.limits)

    @property
    def label(self) -> str:
        """The method, and what sets it apart."""
        return " ".join(filter(None, (self.method, self.settings)))

    @property
    def rank(self) -> tuple[bool, float]:
        """Sorts the best first: by reward within the cost limit, then by cost beyond it; nan last."""
        reward, beyond = statistics.iqm(self.score("reward")), statistics.iqm(self.beyond)
        key = -reward if beyond <= 0 else beyond
        return (not beyond <= 0, math.inf if math.isnan(key) else key)


RowOrGroup = TypeVar("RowOrGroup", TableRow, Group)


def rows(logs: Sequence[RunLog], note: Note | None = None) -> list[TableRow]:
    """One row per task, method and settings, in the order of the tasks' names and of METHODS.

    Args:
      note: as for `run_log.groups`.

    Raises:
      UsageError: two runs of one row have trained the same seed, or only one of them was evaluated.
    """
    return in_order([_row(group) for group in groups(logs, note)])


def in_order(rows: Sequence[RowOrGroup]) -> list[RowOrGroup]:
    """Sorted by task, then by `place`."""
    return sorted(rows, key=lambda row: (row.task, place(row.method)))


def place(method: str) -> int:
    """Sorts methods as METHODS is; those that are not in it come last."""
    order = list(METHODS)
    return order.index(method) if method in order else len(order)


def _row(group: Group) -> TableRow:
    first, last = group.runs[0], group.runs[-1]
    if len({run.evaluated for run in group.runs}) > 1:
        raise UsageError(f"{first.folder} and {last.folder} cannot share a row: only one was evaluated in training")
    scores = {c.name: group.score(c.metric, c.throughout) for c in columns([group.task])}
    if first.judged_cost.startswith("true_") and (beyond := scores["cost beyond"]) is not None:
        scores["cost beyond"] = beyond / first.settings["cost_seen"]  # the metric counts what was noticed
    return TableRow(
        task=group.task,
        method=group.method,
        settings=group.settings,
        limits=first.limits,
        steps=int(min(run.steps[-1] for run in group.runs)),
        source="evaluation" if first.evaluated else "training",
        scores={name: x for name, x in scores.items() if x is not None},
        excess=np.concatenate([run.excess for run in group.runs]),
        true_limits=first.true_limits,
        faults=faults(
            sum((run.faults for run in group.runs), collections.Counter()),
            sum(len(run.seeds) * int(run.steps[-1]) for run in group.runs),
        ),
        deployed=_deployed(group),
    )


def _deployed(group: Group) -> dict[str, np.ndarray]:
    """See `TableRow.deployed`."""
    ends = [run.deployed for run in group.runs]
    if not any(ends):
        return {}
    unknown = [np.full(len(run.seeds), np.nan) for run in group.runs]

    def joined(read: Callable[[RunLog], np.ndarray | None]) -> np.ndarray:
        found = [read(end) if end else None for end in ends]
        return np.concatenate([other if x is None else x for x, other in zip(found, unknown, strict=True)])

    def cost(end: RunLog) -> np.ndarray | None:
        worst = end.final(f"{end.judged_cost}{WORST}")
        return end.final(end.judged_cost) if worst is None else worst

    return {
        "reward": joined(lambda end: end.final("episode_reward")),
        "cost": joined(cost),
        "beyond": joined(lambda end: end.excess),
        "evaluated": np.concatenate([np.full(len(run.seeds), bool(run.deployed)) for run in group.runs]),
    }


def shown(rows: Sequence[TableRow]) -> list[Column]:
    """The columns that any row has, in order; true costs only if a run did not observe all of them."""
    every = columns(row.task for row in rows)
    present = [column for column in every if any(column.name in row.scores for row in rows)]
    observed = all(same(row.scores.get("true cost"), row.scores.get("cost")) for row in rows)
    return [column for column in present if not (observed and column.name.startswith("true "))]


def same(true: np.ndarray | None, observed: np.ndarray | None) -> bool:
    """Whether true costs are the observed ones, as far as both are known."""
    return true is None or observed is None or np.array_equal(true, observed, equal_nan=True)


def compared(rows: Sequence[TableRow]) -> tuple[str, str]:
    """The columns that rows are compared by: reward, and the cost as it was, observed or not, of the worst agent."""
    names = [column.name for column in shown(rows)]
    return "reward", next(x for x in ("true worst agent", "true cost", "worst agent", "cost") if x in (*names, "cost"))
