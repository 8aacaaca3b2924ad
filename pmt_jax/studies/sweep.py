"""Many settings at once: what is traced differs within one program, what is static gets a program each.

A finished point is a run folder like any other. Points of one program train together as the trials of one hidden run,
`.group-N`, which checkpoints and resumes as every run does and is cut into the points' folders when it is done.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import pathlib
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..config.methods import METHODS
from ..config.settings import HYPER_FIELDS, Config, differences, load_config, to_toml
from ..errors import UsageError
from ..files import read_rows
from ..learning.setup import Trials, make_setup
from ..tasks import did_you_mean, names
from ..training import trainer
from ..training.checkpoint import Checkpoints
from ..training.run_folder import Say, load_saved
from . import table, workers

Points = dict[str, Config]  # by the name of the point's folder


class Launch(NamedTuple):
    """How programs are trained.

    Attributes:
      cache: keep compiled programs on disk.
      say: prints a line.
      count: of devices, as for `experiment.train`.
      at_once: programs that train at a time, each in a process of its own where it is more than one.
    """

    cache: bool = True
    say: Say = print
    count: int | None = None
    at_once: int = 1


ONE_AT_A_TIME = Launch()


def grid(
    source: str | pathlib.Path, vary: Mapping[str, Sequence[str]], preset: str = "default", **fixed: Any
) -> Points:
    """All combinations of the values in `vary`, by name: `fear_l2=0,lambda_lr=0.1`.

    Args:
      source, preset, fixed: as for `load_config`.
      vary: values of fields of Config, `method` included.

    Raises:
      UsageError: an unknown field, or a value that does not fit.
    """
    points = {}
    for values in itertools.product(*vary.values()):
        chosen: dict[str, Any] = dict(zip(vary, values, strict=True))
        name = ",".join(f"{k}={_word(v)}" for k, v in chosen.items()) or "point"
        if "env" in chosen:
            chosen["env"] = [chosen["env"]]
        points[name] = load_config(source, preset=preset, **{**fixed, **chosen})
    return points


def _word(value: str) -> str:
    """A value as it stands in a folder's name: a number the same however it was written."""
    try:
        return f"{float(value):.12g}"
    except ValueError:
        return re.sub(r"[^\w.=,+-]", "-", value)


def sweep(points: Points, out: pathlib.Path, launch: Launch = ONE_AT_A_TIME) -> int:
    """Trains what is missing of `points` (see `train_points`) and says which are best under the cost limit."""
    code = train_points(points, out, launch)
    if code == 0:
        launch.say("\nbest first: by reward within the cost limit, then by cost beyond it\n")
        launch.say(table.render(sorted(table.rows([out / name for name in points]), key=lambda row: row.rank)))
    return code


def reproduce(name: str, budget: str, out: pathlib.Path, form: str = "text", launch: Launch = ONE_AT_A_TIME) -> int:
    """Trains what is missing of a table of the paper, its methods on its tasks, and prints it beside the paper's.

    Args:
      name: a table in paper.toml; budget: one of its budgets; form: of the table, see `table.FORMATS`.

    Raises:
      UsageError: an unknown table or budget, or a task that cannot run here.
    """
    paper = table.paper()
    for what, word, known in (("table", name, paper["tables"]), ("budget", budget, paper["budgets"])):
        if word not in known:
            raise UsageError(f"unknown {what} '{word}'{did_you_mean(word, known)}")
    wanted, settings = paper["tables"][name], paper["budgets"][budget]
    absent = [task for task in wanted["tasks"] if task not in names()]
    if absent:
        raise UsageError(f"{name} needs the task '{absent[0]}', which this version of pmt-jax does not have")
    plans = {task: _plan(task, wanted.get("methods", list(METHODS)), settings) for task in wanted["tasks"]}
    for points in plans.values():
        make_setup(next(iter(points.values())))  # an engine that is missing shows now, not after hours
    programs = [program for task, points in plans.items() for program in _programs(points, out / task, launch.say)]
    code = _train(programs, launch)
    if code:
        return code
    rows = table.rows([out / task / point for task, points in plans.items() for point in points])
    launch.say(f"\n{wanted['title']}, budget '{budget}'\n")
    launch.say(table.render(rows, form, wanted["baseline"]))
    return 0


def _plan(task: str, methods: Sequence[str], budget: Mapping[str, str]) -> Points:
    """A budget's settings of a task: its `source` in configs/ for that task, or its `preset` over the task's own."""
    source = budget.get("source", "{task}").format(task=task)
    return grid(source, {"method": methods}, budget.get("preset", "default"))


def train_points(points: Points, out: pathlib.Path, launch: Launch = ONE_AT_A_TIME) -> int:
    """Trains what is missing of `points`, each into its own folder under `out`.

    Finished points are skipped. Points that were interrupted continue from their last checkpoint, bit for bit.

    Returns:
      The exit code of `experiment.train`: 0 when all points are finished.

    Raises:
      UsageError: `out` holds a point of the same name with other settings.
    """
    return _train(_programs(points, out, launch.say), launch)


@dataclasses.dataclass(frozen=True)
class _Program:
    """Points that train together: their hidden folder, and the folder that gets theirs."""

    folder: pathlib.Path
    points: Points
    out: pathlib.Path

    def title(self, number: int, count: int) -> str:
        """What is said of it, the `number`-th of `count`."""
        seeds = next(iter(self.points.values())).seeds
        return f"program {number} of {count}: {len(self.points)} point(s) x {seeds} seed(s) side by side"


def _programs(points: Points, out: pathlib.Path, say: Say) -> list[_Program]:
    """What is missing of `points`."""
    missing = {name: config for name, config in points.items() if not _finished(out / name, config)}
    if len(missing) < len(points):
        say(f"{len(points) - len(missing)} of {len(points)} points are finished already")
    return [_Program(folder, group, out) for folder, group in _groups(points, missing, out)]


def _train(programs: Sequence[_Program], launch: Launch) -> int:
    """Trains programs one after the other, or several at a time in processes of their own."""
    cache, say, count, at_once = launch
    for program in programs:
        _write_points(program)
    titled = [(program.title(number, len(programs)), program) for number, program in enumerate(programs, 1)]
    if at_once > 1:
        for title, program in titled:
            say(f"{title}, {program.out.name}: {', '.join(program.points)}")
        spread = workers.gpus() if count is None else ()  # a number of devices means those, for every program
        return workers.run([workers.command(p.folder, p.out, cache, count) for p in programs], at_once, say, spread)
    for title, program in titled:
        say(title)
        code = train_program(program.folder, program.out, cache, say, count)
        if code:
            return code
    return 0


def _write_points(program: _Program) -> None:
    try:
        (program.folder / "points").mkdir(parents=True, exist_ok=True)
        for name, config in program.points.items():
            (program.folder / "points" / f"{name}.toml").write_text(to_toml(config))
    except OSError as error:
        raise UsageError(f"cannot write into {program.out}: {error.strerror}; choose another --out") from None


def _finished(folder: pathlib.Path, config: Config) -> bool:
    if not (folder / "config.toml").is_file():
        return False
    changes = differences(load_config(folder / "config.toml"), config)
    changed = ", ".join(f"{name}: {change}" for name, change in changes.items())
    if changed:
        raise UsageError(f"{folder} was made with other settings ({changed}); choose another --out")
    return True


def _groups(points: Points, missing: Points, out: pathlib.Path) -> Iterator[tuple[pathlib.Path, Points]]:
    """What trains together and where: groups begun earlier that are still wanted as they are, then new ones."""
    left = dict(missing)
    begun = sorted(out.glob(".group-*"), key=lambda p: int(p.name.split("-")[1]))
    for folder in begun:
        group = _points(folder)
        if group and all(repr(points.get(name)) == repr(config) for name, config in group.items()):
            left = {name: config for name, config in left.items() if name not in group}
            yield folder, group
    last = max((int(p.name.split("-")[1]) for p in begun), default=0)
    alike: dict[str, Points] = {}
    for name, config in sorted(left.items()):
        traced = {f: getattr(Config, f) for f in (*HYPER_FIELDS, "seed")}
        alike.setdefault(repr(dataclasses.replace(config, **traced)), {})[name] = config
    for number, group in enumerate(alike.values(), last + 1):
        yield out / f".group-{number}", group


def _points(folder: pathlib.Path) -> Points:
    """The points of a program's hidden folder."""
    files = sorted((folder / "points").glob("*.toml"), key=lambda file: file.stem)
    return {file.stem: load_config(file) for file in files}


def train_program(folder: pathlib.Path, out: pathlib.Path, cache: bool, say: Say, count: int | None) -> int:
    """Trains the points of a hidden `folder` side by side, or goes on with it; then each gets its folder in `out`."""
    group = _points(folder)
    configs = list(group.values())
    seeds, setup = configs[0].seeds, make_setup(configs[0])
    settings = [dataclasses.replace(setup, config=config).hyper for config in configs]
    own = jax.tree.map(lambda *each: jnp.repeat(jnp.stack(each), seeds), *settings)
    seed = jnp.concatenate([jnp.arange(config.seed, config.seed + seeds) for config in configs])
    trials = Trials(
        own if len(group) > 1 else settings[0], seed
    )  # settings that are shared keep the last bits of a run
    common = configs[0].replace(seeds=len(configs) * seeds, seed=0)
    begun = (folder / "run" / "config.toml").is_file()
    code = trainer.train(common, folder / "run", resume=begun, cache=cache, say=say, trials=trials, count=count)
    if code == 0:
        _cut(folder, group, out)
    return code


def _cut(folder: pathlib.Path, group: Points, out: pathlib.Path) -> None:
    """Cuts a finished group's run into one folder a point; each appears whole or not at all."""
    setup, step, saved = load_saved(folder / "run")
    rows = read_rows(folder / "run" / "metrics.jsonl")
    for number, (name, config) in enumerate(group.items()):
        if (out / name).exists():
            continue
        first = number * config.seeds  # of its trials, whose rows know a rounded limit
        limit = dataclasses.replace(setup, config=config).cost_limit
        mine = [
            row | {"seed": row["seed"] - first + config.seed, "cost_limit": limit}
            for row in rows
            if 0 <= row["seed"] - first < config.seeds
        ]
        part = folder / "points" / name
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        (part / "config.toml").write_text(to_toml(config))
        (part / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in mine))
        shutil.copy(folder / "run" / "versions.json", part)
        checkpoints = Checkpoints(part)
        checkpoints.save(step, jax.tree.map(lambda x: x[first : first + config.seeds], saved))  # noqa: B023
        checkpoints.close()
        part.rename(out / name)
    shutil.rmtree(folder)
