"""Run folders as they are read: settings, metrics of every seed, versions, and which runs are the same up to seeds.

Tables, plots and reports all read through here.
"""

from __future__ import annotations

import collections
import dataclasses
import json
import math
import os
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ..config.load import load_config
from ..config.settings import Config
from ..errors import UsageError
from ..files import Note, read_rows, to_stderr
from ..limits import KEY, LARGEST, WORST, Limits, judged, of_agents
from ..training import final
from ..training.health import count_faults
from ..training.history import checkpoint_steps, missing_rows, read_changes
from . import program_folder

LAST = 0.1  # share of the steps that a run's final metrics are averaged over
NOT_LEARNING = ("seed", "seeds", "log_interval", "eval_interval", "eval_episodes")  # do not change what is learned
REQUIRED = {"step": int, "seed": int, "task": str, "method": str, KEY: float}  # what every row says
TEXT = ("broken",)  # besides


@dataclasses.dataclass(frozen=True)
class RunLog:
    """A training run as its folder records it.

    Attributes:
      folder: where it lies.
      task, method: what was trained, and how.
      limits: on the costs of any agent.
      settings: {setting: value}, the task's own options as env.NAME.
      seeds: [S], ascending.
      steps: [P] environment steps of one seed, ascending.
      metrics: {name: [S, P]} the metrics that are numbers, nan where unknown.
      versions: what the numbers depend on besides the settings.
      broken: {seed: step} of those that stopped training before the end, which have no final metrics.
      evaluation: {name: [S]} what the last policies reach under mean actions (training/final.py), nan where unknown.
    """

    folder: pathlib.Path
    task: str
    method: str
    limits: Limits
    settings: dict[str, Any]
    seeds: tuple[int, ...]
    steps: np.ndarray
    metrics: dict[str, np.ndarray]
    versions: dict[str, Any] = dataclasses.field(default_factory=dict)
    broken: dict[int, int] = dataclasses.field(default_factory=dict)
    evaluation: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @property
    def deployed(self) -> RunLog | None:
        """The same run with the evaluation that ended it as its only metrics; None if there was none."""
        metrics = {name: values[:, None] for name, values in self.evaluation.items()}
        return dataclasses.replace(self, steps=self.steps[-1:], metrics=metrics, evaluation={}) if metrics else None

    @property
    def identity(self) -> str:
        """Equal for two runs that are the same up to their seeds."""
        learned = {name: value for name, value in self.settings.items() if name not in NOT_LEARNING}
        return repr((self.task, self.method, self.limits, sorted(learned.items()) or self.folder))

    @property
    def evaluated(self) -> bool:
        """Whether the final metrics come from evaluations, not from training."""
        return bool(np.isfinite(self._last("eval/episode_reward")).any())

    def final(self, name: str) -> np.ndarray | None:
        """[S] means of a metric over the last tenth of the steps, nan for a seed that broke; None if unknown.

        If evaluations were made there, they replace the training episodes. `..._worst` is the agent with the highest of
        these means, unknown where agents share their costs.
        """
        source = self._source(name)
        if not name.endswith(WORST):
            return self._final(source)
        mean = source.removesuffix(WORST)
        each = of_agents({x: self._final(x) for x in self.metrics if x.startswith(f"{mean}/agent_")}, mean)
        return np.max(each, axis=0) if each else None

    def _source(self, name: str) -> str:
        return f"eval/{name}" if self.evaluated else name

    def _final(self, source: str) -> np.ndarray | None:
        if source not in self.metrics:
            return None
        values = self._last(source)
        known = np.isfinite(values)
        mean = np.where(known, values, 0.0).sum(1) / np.maximum(known.sum(1), 1)
        return np.where(known.any(1) & ~np.isin(self.seeds, list(self.broken)), mean, np.nan)

    def throughout(self, name: str) -> np.ndarray | None:
        """[S] means of a metric over all steps of training, nan for a seed that broke; None if unknown."""
        if name not in self.metrics:
            return None
        mean = _averaged(self.metrics[name], [0])[:, 0]
        return np.where(np.isin(self.seeds, list(self.broken)), np.nan, mean)

    @property
    def excess(self) -> np.ndarray:
        """[S] how far a seed's costs at the end (see `final`) are beyond their limits, the agent and cost furthest."""
        return self.limits_on(self.judged_cost).excess(self._costs(self.judged_cost))

    @property
    def judged_cost(self) -> str:
        """The metric that limits are on: true costs, where not all of one cost is observed (`cost_seen`)."""
        hidden = self.settings.get("cost_seen", 1.0) < 1 and len(self.limits.each) == 1
        return "true_episode_cost" if hidden and "true_episode_cost" in self.metrics else "episode_cost"

    @property
    def true_limits(self) -> Limits:
        """The limits on true costs, of which the learner observes a share."""
        return self.limits.true(self.settings.get("cost_seen", 1.0))

    def limits_on(self, metric: str) -> Limits:
        """The limits on a metric of costs."""
        return self.true_limits if metric.startswith("true_") else self.limits

    def _costs(self, name: str) -> np.ndarray:
        """[S, N, K] the final means of what a cost is judged by; nan where unknown."""
        names = judged(self.metrics, self._source(name), len(self.limits.each))
        unknown = np.full(len(self.seeds), np.nan)
        each = [[unknown if (x := self._final(column)) is None else x for column in costs] for costs in names]
        return np.moveaxis(np.array(each), -1, 0)

    @property
    def faults(self) -> collections.Counter[str]:
        """How many steps of all seeds broke the contract of tasks (`health.count_faults`)."""
        return count_faults(self.metrics, self.settings.get("eval_episodes", 0))

    def until(self, step: int) -> RunLog:
        """The same run as if it had ended after this step.

        Raises:
          UsageError: it has no metrics of so early a step.
        """
        kept = self.steps <= step
        if not kept.any():
            raise UsageError(f"{self.folder} has no metrics up to step {step:,}: its first are of {self.steps[0]:,}")
        metrics = {name: values[:, kept] for name, values in self.metrics.items()}
        broken = {seed: at for seed, at in self.broken.items() if at <= step}
        evaluation = self.evaluation if kept.all() else {}
        return dataclasses.replace(self, steps=self.steps[kept], metrics=metrics, broken=broken, evaluation=evaluation)

    def thinned(self, points: int) -> RunLog:
        """The same run with its metrics averaged into at most so many points, over what is known in each."""
        starts = [part[0] for part in np.array_split(np.arange(len(self.steps)), min(points, len(self.steps)))]
        steps = self.steps[[*(start - 1 for start in starts[1:]), -1]]
        return dataclasses.replace(
            self, steps=steps, metrics={name: _averaged(values, starts) for name, values in self.metrics.items()}
        )

    def _last(self, name: str) -> np.ndarray:
        """[S, p] a metric over the last tenth of the steps."""
        nothing = np.full((len(self.seeds), len(self.steps)), np.nan)
        return self.metrics.get(name, nothing)[:, self.steps > (1 - LAST) * self.steps[-1]]


def _averaged(values: np.ndarray, starts: list[int]) -> np.ndarray:
    """[S, P] means over what is known of `values` [S, R] from each of `starts` to the next."""
    known = np.isfinite(values)
    count = np.add.reduceat(known, starts, axis=1, dtype=int)
    total = np.add.reduceat(np.where(known, values, 0.0), starts, axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


# ---------------------------------------------------------------------------------------------------------------------
# Reading


def read_all(paths: Sequence[pathlib.Path], note: Note | None = None) -> list[RunLog]:
    """The runs among and below `paths`, also the points of a sweep under way; other folders are left out with a note.

    Raises:
      UsageError: a path does not exist, none of them holds a run with metrics, or a run cannot be read.
    """
    note = note or to_stderr
    logs: dict[str, RunLog] = {}  # by the folders that links lead to
    reasons = []
    for path in dict.fromkeys(paths):
        if str(path).startswith("hub:"):
            raise UsageError(f"{path} is a pretrained policy, which has no metrics of its training; name a run folder")
        if not path.exists():
            raise UsageError(f"{path} is not a run folder: there is no such folder")
        begun = _under_way(path, note)  # first: what ends meanwhile is then found in both places
        folders, unfinished = _folders(path)
        reasons += unfinished
        for log in begun:
            logs.setdefault(os.path.realpath(log.folder), log)
        if not folders and not begun:
            reasons.append(f"{path} holds no run: no folder in it has a config.toml and a metrics.jsonl")
        for folder in folders:
            if (real := os.path.realpath(folder)) in logs:
                continue
            log = read(folder, note)
            if log is None:
                reasons.append(f"{folder} has no metrics yet: its metrics.jsonl has no row")
            else:
                logs[real] = log
    if not logs:
        raise UsageError("; ".join(reasons) or "no run folder was named")
    for reason in reasons:
        note(f"left out: {reason}")
    return [*logs.values()]


def _folders(path: pathlib.Path) -> tuple[list[pathlib.Path], list[str]]:
    """The run folders at and below `path`, also behind links, and why others that look like one are none.

    Hidden folders are left out.
    """
    found, reasons = [], []
    for folder, _, files in _walk(path):
        missing = [name for name in ("config.toml", "metrics.jsonl") if name not in files]
        if not missing:
            found.append(folder)
        elif len(missing) == 1 and folder != path:
            reasons.append(f"{folder} is no run folder: it has no {missing[0]}")
    return sorted(found), reasons


def _walk(path: pathlib.Path) -> Iterator[tuple[pathlib.Path, list[str], list[str]]]:
    """Each folder at and below `path` once, also behind links, with its folders and files; not below hidden ones."""
    met = set()
    for folder, inner, files in os.walk(path, followlinks=True):
        if (real := os.path.realpath(folder)) in met:  # a link to a folder above it
            inner.clear()
            continue
        met.add(real)
        yield pathlib.Path(folder), sorted(inner), files
        inner[:] = sorted(name for name in inner if not name.startswith("."))


def read(folder: pathlib.Path, note: Note = to_stderr) -> RunLog | None:
    """The run in `folder`; None if it has no metrics yet.

    Damaged lines are left out with a note, and rows that are missing get one; if a step occurs twice, the later line
    counts.

    Raises:
      UsageError: settings or metrics that cannot be read, or are of the wrong type.
    """
    metrics = folder / "metrics.jsonl"
    try:
        rows = read_rows(metrics, missing_ok=False, note=note)
    except OSError as error:
        raise UsageError(f"{folder} has no metrics: cannot read its metrics.jsonl ({error.strerror})") from None
    return _log(folder, rows, metrics, _config(folder / "config.toml"), note) if rows else None


def _under_way(path: pathlib.Path, note: Note) -> list[RunLog]:
    """The points of sweeps at and below `path` that have not ended, as far as they are; each names its later folder."""
    found: dict[pathlib.Path, RunLog] = {}
    hidden = ((folder, name) for folder, inner, _ in _walk(path) for name in inner if name.startswith(".group-"))
    groups = [folder / name for folder, name in hidden]
    for group in sorted(groups, key=lambda group: (group.parent, -int(group.name.split("-")[1]))):
        metrics = group / "run" / "metrics.jsonl"
        try:
            configs = {file.stem: _config(file) for file in program_folder.point_files(group)}
            rows = program_folder.rows(group, configs, note)
        except (UsageError, OSError):
            if not group.exists():  # its points have their own folders since a moment ago
                continue
            raise
        missing = [name for name in rows if rows[name] and not (group.parent / name / "config.toml").is_file()]
        places = {group.parent / name: name for name in missing}
        logs = {
            place: _log(place, rows[name], metrics, configs[name], note)
            for place, name in places.items()
            if place not in found  # of groups that hold the same points, the latest counts
        }
        for log in [*logs.values()][:1]:
            note(f"not ended: {len(logs)} point(s) of {group.parent}, read at step {log.steps[-1]:,}")
        found |= logs
    return [*found.values()]


def _log(
    folder: pathlib.Path, rows: Sequence[dict[str, Any]], metrics: pathlib.Path, config: Config, note: Note
) -> RunLog:
    """The run in `folder`, of its rows in the file `metrics`."""
    for row in rows:
        _check(row, metrics)
    changes = read_changes(metrics.parent, note)
    if missing := missing_rows(config, changes, rows, _written(metrics.parent, rows)):
        note(f"{folder} lacks {missing}; what is averaged over steps is of the others")
    steps, seeds = (sorted({row[name] for row in rows}) for name in ("step", "seed"))
    last = max(rows, key=lambda row: row["step"])
    return RunLog(
        folder=folder,
        task=last["task"],
        method=last["method"],
        limits=Limits.of_row(last),
        settings=flat(config) | _changed(changes),
        seeds=tuple(seeds),
        steps=np.array(steps),
        metrics=_metrics(rows, seeds, steps, metrics),
        versions=_versions(metrics.parent),
        broken={row["seed"]: row["step"] for row in reversed(rows) if row.get("broken") is not None},
        evaluation=_evaluation(folder, seeds, steps[-1], note) if folder == metrics.parent else {},
    )


def _evaluation(folder: pathlib.Path, seeds: list[int], step: int, note: Note) -> dict[str, np.ndarray]:
    """{name: [S]} of the evaluation after the last step; {} if there was none."""
    rows = [row for row in final.read(folder, step, note) if row.get("seed") in seeds]
    for row in rows:
        _check(row, folder / final.FILE)
    known = [{name: x for name, x in row.items() if name != "actions"} for row in rows]
    return {name: x[:, 0] for name, x in _metrics(known, seeds, [step], folder / final.FILE).items()}


def _config(file: pathlib.Path) -> Config:
    """The settings of a run; a mistake in them is said with the file's name, as a table may read many."""
    try:
        return load_config(file)
    except UsageError as error:
        raise UsageError(str(error) if str(file) in str(error) else f"{file}: {error}") from None


def _check(row: dict[str, Any], file: pathlib.Path) -> None:
    """Raises UsageError if a row's identity is missing or of the wrong type."""
    for name, kind in REQUIRED.items():
        value = row.get(name)
        words = {int: "a whole number", str: "a word", float: "a number"}[kind]
        fits = isinstance(value, int | float if kind is float else kind) and not isinstance(value, bool)
        if fits and isinstance(value, int) and not 0 <= value < 2**63:
            fits, words = False, f"{words} from 0 to 2**63"
        if not fits:
            raise UsageError(f"{file}: a row has {name} = {json.dumps(value)[:40]}, where {words} belongs")


def _metrics(
    rows: Sequence[dict[str, Any]], seeds: list[int], steps: list[int], file: pathlib.Path
) -> dict[str, np.ndarray]:
    """{name: [S, P]} of the rows of `file`."""
    seed_at, step_at = ({value: i for i, value in enumerate(x)} for x in (seeds, steps))
    found: dict[str, np.ndarray] = {}
    for row in rows:
        place = seed_at[row["seed"]], step_at[row["step"]]
        for name, value in row.items():
            if name in REQUIRED or name in TEXT:
                continue
            if name not in found:
                found[name] = np.full((len(seeds), len(steps)), np.nan)
            try:
                number = math.nan if value is None else float(value)
            except (TypeError, ValueError, OverflowError):
                number = None
            if number is None or LARGEST < abs(number) < math.inf:
                words = "a number or null" if number is None else "a number of 32 bits or null"
                where = f"{name} = {json.dumps(value)[:40]} at step {row['step']}"
                raise UsageError(f"{file}: a row has {where}, where {words} belongs")
            found[name][place] = number
    return found


def _changed(changes: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Which settings changed after which step (--change), as one more setting; {} if none did."""
    each = [f"{name} {x} at {row['step']:,}" for row in changes for name, x in row["changed"].items()]
    return {"changed": "; ".join(each)} if each else {}


def _written(folder: pathlib.Path, rows: Sequence[dict[str, Any]]) -> int:
    """The step up to which all rows must be there: of the newest checkpoint, or of the last row but one."""
    steps = sorted({row["step"] for row in rows})[:-1]  # the rows of the last may be being written
    return max([*steps[-1:], *checkpoint_steps(folder)[:1]], default=0)


def _versions(folder: pathlib.Path) -> dict[str, Any]:
    try:
        versions = json.loads((folder / "versions.json").read_text())
    except (OSError, ValueError):
        return {}
    return versions if isinstance(versions, dict) else {}


def flat(config: Config) -> dict[str, Any]:
    """{setting: value} of a run, the task's own options as env.NAME."""
    settings = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    options = dict(settings.pop("env"))
    return settings | {f"env.{name}": value for name, value in options.items()}


# ---------------------------------------------------------------------------------------------------------------------
# Runs that are the same up to seeds


@dataclasses.dataclass(frozen=True)
class Group:
    """Runs that differ in nothing but their seeds.

    Attributes:
      runs: at least one.
      settings: what sets it apart from other groups of its task and method, as `name=value name=value`.
    """

    runs: tuple[RunLog, ...]
    settings: str = ""

    @property
    def task(self) -> str:
        """What was trained."""
        return self.runs[0].task

    @property
    def method(self) -> str:
        """How it was trained."""
        return self.runs[0].method

    @property
    def label(self) -> str:
        """The method, and what sets it apart."""
        return " ".join(filter(None, (self.method, self.settings)))

    @property
    def seeds(self) -> tuple[int, ...]:
        """Of all runs."""
        return tuple(seed for run in self.runs for seed in run.seeds)

    def score(self, name: str, throughout: bool = False) -> np.ndarray | None:
        """[S] a metric's means over the last tenth of each run's steps, or all; None if a run does not have it."""
        found = [run.throughout(name) if throughout else run.final(name) for run in self.runs]
        known = [x for x in found if x is not None]
        return np.concatenate(known) if len(known) == len(found) else None


def groups(logs: Sequence[RunLog], note: Note | None = None) -> list[Group]:
    """Pools runs that are the same up to seeds, in the order given.

    Args:
      note: called with a sentence for a run whose seeds a longer one has too, which is then left out; if None, this
        is an error.

    Raises:
      UsageError: a seed counts twice.
    """
    alike: dict[str, list[RunLog]] = {}
    for log in logs:
        alike.setdefault(log.identity, []).append(log)
    pooled = [_without_repeats(runs, note) for runs in alike.values()]
    return [Group(tuple(runs), _differing(runs[0], [others[0] for others in pooled])) for runs in pooled]


def _without_repeats(runs: Sequence[RunLog], note: Note | None) -> list[RunLog]:
    kept: list[RunLog] = []
    for run in runs if note is None else sorted(runs, key=lambda run: -run.steps[-1]):
        twice = [(seed, other) for other in kept for seed in run.seeds if seed in other.seeds]
        if twice and note is None:
            seed, other = twice[0]
            both = f"{other.folder} and {run.folder}"
            raise UsageError(f"seed {seed} counts twice: {both} are the same run; leave one of them out")
        if twice and note is not None:
            note(f"left out: {run.folder} has settings and seeds of {twice[0][1].folder}")
        else:
            kept.append(run)
    return [run for run in runs if run in kept]


def _differing(run: RunLog, others: Iterable[RunLog]) -> str:
    """The settings of `run` that others of its task and method have otherwise, or else its folder's name."""
    rivals = [other for other in others if (other.task, other.method) == (run.task, run.method)]
    names = sorted({name for rival in rivals for name in rival.settings if name not in NOT_LEARNING})
    differing = [name for name in names if len({repr(rival.settings.get(name)) for rival in rivals}) > 1]
    if len(rivals) > 1 and not differing:
        return run.folder.name
    return " ".join(f"{name}={plain(run.settings.get(name, 'default'))}" for name in differing)


def plain(value: Any) -> str:
    """A setting's value, numbers as short as they can be."""
    if isinstance(value, tuple):
        return ("|" if any(isinstance(x, tuple) for x in value) else ",").join(map(plain, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
