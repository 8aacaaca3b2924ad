"""Many settings at once: what is traced differs within one program, what is static gets a program each.

A finished point is a run folder like any other. Points of one program train together as the trials of one hidden run,
`.group-N`, which checkpoints and resumes as every run does and is cut into the points' folders when it is done.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
import shutil
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..config.load import load_config, to_toml
from ..config.settings import HYPER_FIELDS, Config
from ..errors import UsageError
from ..files import writing
from ..learning.setup import Trials, make_setup
from ..policies import warm_start
from ..training import final, lock, trainer
from ..training.checkpoint import Checkpoints
from ..training.provenance import Provenance, differences
from ..training.run_folder import Rescue, Say, load_saved
from . import jobs, program_folder, table
from .points import Part, Points, drawn
from .rows import rows
from .run_log import read_all


class Launch(NamedTuple):
    """How programs are trained.

    Attributes:
      cache: keep compiled programs on disk.
      say: prints a line.
      devices: how many, as for `trainer.train`.
      jobs: programs that train at a time, each in a process of its own where it is more than one.
    """

    cache: bool = True
    say: Say = print
    devices: int | None = None
    jobs: int = 1


ONE_AT_A_TIME = Launch()


def sweep(parts: Sequence[Part], points: Points, out: pathlib.Path, launch: Launch = ONE_AT_A_TIME) -> int:
    """Trains what is missing of the `points` of `parts` and says which meet the limit best.

    Each point has its own folder in `out`, and draws.json holds what was drawn at random. Finished points are skipped;
    points that were interrupted continue from their last checkpoint, bit for bit.

    Returns:
      The exit code of `trainer.train`: 0 when all points are finished.

    Raises:
      UsageError: as `prepare`.
    """
    with lock.acquire(out):
        wanted = prepare(parts, points, out, launch.say)
        code = train_programs(wanted, launch)
    if code == 0:
        say_best(points, out, launch.say)
    return code


def prepare(parts: Sequence[Part], points: Points, out: pathlib.Path, say: Say) -> list[Program]:
    """What is missing of the `points` of `parts`, once it is known that it can be trained; writes draws.json.

    Raises:
      UsageError: `out` holds a point of the same name with other settings, or a task cannot run here.
    """
    wanted = missing_programs(points, out, say)
    if values := drawn(parts, points):
        seeds = ", ".join(str(part.seed) for part in parts if part.ranges)
        say(f"drawn with seed {seeds}: {out / 'draws.json'}")
        with writing(out / "draws.json", "--out") as partial:
            partial.write_text(json.dumps(values, indent=1) + "\n")
    configs = [config for program in wanted for config in program.points.values()]
    if len({_needs(config) for config in configs}) > 1:  # a single one shows when its program is made
        check_tasks(configs)
    return wanted


def say_best(points: Points, out: pathlib.Path, say: Say) -> None:
    """Prints the table of all points, which are finished."""
    say("\nbest first: by reward within the cost limit, then by cost beyond it\n")
    found = rows(read_all([out / name for name in points]), say)
    say(table.render(sorted(found, key=lambda row: (row.task, row.rank))))


def check_tasks(configs: Iterable[Config]) -> None:
    """Makes each task as it is asked for, so that a missing engine or option shows now and not after other programs.

    Raises:
      UsageError: a task cannot run here as one of the configurations asks for.
    """
    for config in {_needs(config): config for config in configs}.values():
        make_setup(config)


def _needs(config: Config) -> str:
    """Equal for configurations whose tasks can be made, or cannot, alike."""
    multiplier = bool(config.lambda_init), bool(config.lambda_max)
    return repr((config.task, config.env, config.physics, config.method, config.cost_limit, multiplier))


@dataclasses.dataclass(frozen=True)
class Program:
    """Points that train together: their hidden folder, and the folder that gets theirs."""

    folder: pathlib.Path
    points: Points
    out: pathlib.Path

    @property
    def is_finished(self) -> bool:
        """Whether all its points have their folders."""
        return all((self.out / name / "config.toml").is_file() for name in self.points)

    @property
    def number(self) -> int:
        """That of its folder, from 1."""
        return int(self.folder.name.split("-")[1])

    def title(self, number: int, count: int) -> str:
        """What is said of it, the `number`-th of `count`."""
        seeds = next(iter(self.points.values())).seeds
        return f"program {number} of {count}: {len(self.points)} point(s) x {seeds} seed(s) side by side"


def missing_programs(points: Points, out: pathlib.Path, say: Say) -> list[Program]:
    """What is missing of `points`.

    Raises:
      UsageError: `out` is a run's folder, or holds a point of the same name with other settings.
    """
    if (out / "config.toml").is_file():
        raise UsageError(f"{out} holds a run, not a sweep; choose another --out")
    missing = {name: config for name, config in points.items() if not _finished(out / name, config)}
    if len(missing) < len(points):
        say(f"{len(points) - len(missing)} of {len(points)} points are finished already")
    return [Program(folder, group, out) for folder, group in grouped(points, missing, out)]


def train_programs(programs: Sequence[Program], launch: Launch = ONE_AT_A_TIME) -> int:
    """Trains programs one after the other, or several at a time in processes of their own; returns the exit code."""
    cache, say, devices, at_a_time = launch
    for program in programs:
        write_points(program)
    titled = [(program.title(number, len(programs)), program) for number, program in enumerate(programs, 1)]
    if at_a_time > 1:
        for title, program in titled:
            say(f"{title}, {program.out.name}: {', '.join(program.points)}")
        spread = jobs.gpus() if devices is None else ()  # a number of devices means those, for every program
        return jobs.run([jobs.command(p.folder, p.out, cache, devices) for p in programs], at_a_time, say, spread)
    for title, program in titled:
        if not lock.is_held(program.out):
            say(f"stopped: {program.out} was deleted, renamed or replaced meanwhile; what follows is not trained")
            return 1
        say(title)
        code = train_program(program.folder, program.out, cache, say, devices)
        if code:
            return code
    return 0


def write_points(program: Program) -> None:
    """Writes the settings of each of the points into the folder of its program.

    Raises:
      UsageError: the folder cannot be written to.
    """
    try:
        (program.folder / "points").mkdir(parents=True, exist_ok=True)
        for name, config in program.points.items():
            (program.folder / "points" / f"{name}.toml").write_text(to_toml(config))
    except OSError as error:
        raise UsageError(f"cannot write into {program.out}: {error.strerror}; choose another --out") from None


def _finished(folder: pathlib.Path, config: Config) -> bool:
    if not (folder / "config.toml").is_file():
        if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
            raise UsageError(f"{folder} holds no run but other files; remove them or choose another --out")
        return False
    if changed := _changed(load_config(folder / "config.toml"), config):
        raise UsageError(f"{folder} was made with other settings ({changed}); choose another --out")
    return True


def _changed(made: Config, wanted: Config) -> str:
    """The settings that differ, "clip: 0.1 -> 0.2, ..."."""
    return ", ".join(f"{name}: {change}" for name, change in differences(made, wanted).items())


def grouped(points: Points, missing: Points, out: pathlib.Path) -> Iterator[tuple[pathlib.Path, Points]]:
    """What trains together and where: groups begun earlier that are still wanted as they are, then new ones.

    Raises:
      UsageError: one that was begun has a missing point of the same name with other settings.
    """
    left = dict(missing)
    begun = sorted(out.glob(".group-*"), key=lambda p: int(p.name.split("-")[1]))
    for folder in begun:
        group = program_folder.points(folder)
        for name in group.keys() & left.keys():
            if changed := _changed(group[name], left[name]):
                raise UsageError(
                    f"{folder} has begun '{name}' with other settings ({changed}); choose another --out, or delete it"
                )
        wanted = all(repr(points.get(name)) == repr(config) for name, config in group.items())
        if wanted and any(name in left for name in group):
            left = {name: config for name, config in left.items() if name not in group}
            yield folder, group
    last = max((int(p.name.split("-")[1]) for p in begun), default=0)
    alike: dict[str, Points] = {}
    for name, config in sorted(left.items()):
        traced = {f: getattr(Config, f) for f in (*HYPER_FIELDS, "seed")}
        alike.setdefault(repr(dataclasses.replace(config, **traced)), {})[name] = config
    for number, group in enumerate(alike.values(), last + 1):
        yield out / f".group-{number}", group


def train_program(folder: pathlib.Path, out: pathlib.Path, cache: bool, say: Say, devices: int | None) -> int:
    """Trains the points of a hidden `folder` side by side, or continues it; then each gets its folder in `out`.

    Raises:
      InUse: another process trains them.
      UsageError: the folder is gone.
    """
    with lock.acquire(folder):
        group = program_folder.points(folder)
        if not group:
            raise UsageError(f"{folder} holds no points to train; it was deleted or replaced meanwhile")
        return _train_group(folder, group, out, cache, say, devices)


def _train_group(
    folder: pathlib.Path, group: Points, out: pathlib.Path, cache: bool, say: Say, devices: int | None
) -> int:
    configs = list(group.values())
    seeds, setup = configs[0].seeds, make_setup(configs[0])
    settings = [dataclasses.replace(setup, config=config).hyper for config in configs]
    own = jax.tree.map(lambda *each: jnp.repeat(jnp.stack(each), seeds, axis=0), *settings)
    index = jnp.tile(jnp.arange(seeds), len(configs))
    seed = index + jnp.repeat(jnp.array([config.seed for config in configs]), seeds)
    # Settings that are shared keep the last bits of a run.
    trials = Trials(own if len(group) > 1 else settings[0], seed, index)
    common = configs[0].replace(seeds=len(configs) * seeds, seed=0)
    begun = (folder / "run" / "config.toml").is_file()
    files = {str(file.relative_to(out)): file.read_text() for file in program_folder.point_files(folder)}
    how = {
        "cache": cache,
        "say": say,
        "devices": devices,
        "warm_start": warm_start.prepare,
        "rescue": Rescue(out, files),
    }
    code = trainer.train(common, folder / "run", resume=begun, trials=trials, **how)
    return code or _finish(folder, group, out, say)


def _finish(folder: pathlib.Path, group: Points, out: pathlib.Path, say: Say) -> int:
    """Cuts a finished group, if its folder is still there; returns the exit code."""
    if not lock.is_held(folder):
        say(f"stopped: {folder} was deleted, renamed or replaced; its points get no folders in {out}")
        return 1
    cut_points(folder, group, out)
    return 0


def _of_point(rows: list[dict[str, Any]], config: Config, first: int, limits: dict[str, float]) -> list[dict[str, Any]]:
    """The lines of evaluation.jsonl of a point whose trials begin with the `first`, as of a run of its own."""
    own = [row for row in rows if row["seed"] in range(first, first + config.seeds)]
    return [row | {"seed": config.seed + row["seed"] - first} | limits for row in own]


def cut_points(folder: pathlib.Path, group: Points, out: pathlib.Path) -> None:
    """Cuts a finished group's run into one folder a point; each appears whole or not at all."""
    setup, step, saved = load_saved(folder / "run")
    rows = program_folder.rows(folder, group)
    evaluation = final.read(folder / "run", step)
    for number, (name, config) in enumerate(group.items()):
        if (out / name / "config.toml").is_file():
            continue
        first = number * config.seeds  # of its trials
        limits = dataclasses.replace(setup, config=config).limits  # the task's own, too, not rounded
        own = [row | limits.columns for row in rows[name]]
        part = folder / "points" / name
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        (part / "config.toml").write_text(to_toml(config))
        (part / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in own))
        final.write(part, _of_point(evaluation, config, first, limits.columns))
        shutil.copy(folder / "run" / "versions.json", part)
        checkpoints = Checkpoints(part)
        mine = jax.tree.map(lambda x: x[first : first + config.seeds], saved)  # noqa: B023
        checkpoints.save(step, mine, Provenance(config))
        checkpoints.close()
        part.rename(out / name)
    done = folder.with_name(folder.name.replace("group", "done"))  # so that no part of it is taken for a group
    shutil.rmtree(done, ignore_errors=True)
    folder.rename(done)
    shutil.rmtree(done, ignore_errors=True)
