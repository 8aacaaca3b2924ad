"""The points of a sweep, each a run's settings: all combinations of values, or random draws; files hold several parts.

extends = "ant_2x4"        # settings above the first [[sweep]] hold for all points
seeds = 20

[[sweep]]                  # any settings of this part's points, and what it varies
method = ["mappo_l", "f4sg"]
set.cost_seen = [1, 0.1]

[[sweep]]
random = 16                # draws; `draw_seed` seeds them
set.lambda_lr = "log:0.01:1"
"""

from __future__ import annotations

import collections
import itertools
import math
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..config import load
from ..config.load import convert, load_config
from ..config.settings import FIELDS, Config
from ..errors import UsageError
from ..tasks import did_you_mean

Points = dict[str, Config]  # by the name of the point's folder
Source = str | pathlib.Path | dict[str, Any]  # as for `load_config`

PART = {"set": {}, "random": 0, "draw_seed": 0}  # what a [[sweep]] holds besides settings, and without them


class Range(NamedTuple):
    """Where a setting's values are drawn from, evenly, or evenly in their logarithm."""

    low: float
    high: float
    log: bool

    def draw(self, rng: np.random.Generator, whole: bool) -> float:
        """A value of six digits, or a whole number."""
        value = math.exp(rng.uniform(*np.log((self.low, self.high)))) if self.log else rng.uniform(self.low, self.high)
        return round(value) if whole else float(f"{value:.6g}")


class Part(NamedTuple):
    """What varies around the settings of a source.

    Attributes:
      source: as for `load_config`.
      values: {setting: values}, of which all combinations are points.
      ranges: {setting: range}, drawn together, `draws` times from `seed`; each draw is combined with all values.
    """

    source: Source
    values: Mapping[str, Sequence[Any]] = {}
    ranges: Mapping[str, Range] = {}
    draws: int = 0
    seed: int = 0


def make_points(parts: Sequence[Part], preset: str = "default", **fixed: Any) -> Points:
    """Every point by name: `emotion_l2=0,lambda_lr=2`, after `draw=3` if drawn, after `task=lane` if there are several.

    Args:
      preset, fixed: as for `load_config`, for all points. Options in a fixed `env` are laid next to those that vary.

    Raises:
      UsageError: an unknown setting, a value that does not fit, ranges without draws, a setting that varies and is
        fixed, two points of one name, or two whose seeds overlap.
    """
    named = [point for part in parts for point in _points(part, preset, fixed)]
    several = len({config.task for _, config in named}) > 1
    points: Points = {}
    for words, config in named:
        name = ",".join([f"task={_word(config.task)}"] * several + words) or "point"
        if repr(points.get(name, config)) != repr(config):
            raise UsageError(f"two points have the name '{name}': add the setting in which they differ to `set`")
        points[name] = config
    _check_seeds(points)
    return points


def _check_seeds(points: Points) -> None:
    """Raises UsageError if two points that differ in their seeds alone have one in common."""
    alike: dict[str, list[tuple[int, str]]] = {}
    for name, config in points.items():
        alike.setdefault(repr(config.replace(seed=0, seeds=1)), []).append((config.seed, name))
    for found in alike.values():
        for (seed, name), (after, other) in itertools.pairwise(sorted(found)):
            if seed <= after < seed + points[name].seeds:
                raise UsageError(
                    f"points '{name}' and '{other}' would both train seed {after}: with seeds = {points[name].seeds} "
                    "their first seeds must be as far apart, or ask for fewer seeds"
                )


def _points(part: Part, preset: str, fixed: Mapping[str, Any]) -> list[tuple[list[str], Config]]:
    """The points of a part, each with the words of its name."""
    _check(part, fixed)
    rng = np.random.default_rng(part.seed)
    draws = [{k: r.draw(rng, FIELDS[k] is int) for k, r in part.ranges.items()} for _ in range(part.draws)]
    found = []
    values = {name: list(map(_table, x)) if name == "env" else x for name, x in part.values.items()}
    for number, draw in enumerate(draws or [{}]):
        for chosen in itertools.product(*values.values()):
            varied = dict(zip(values, chosen, strict=True))
            words = [f"draw={number}"] * bool(draws) + [f"{k}={_word(v)}" for k, v in varied.items()]
            if "env" in varied:
                varied["env"] = _beside(varied["env"], _table(fixed.get("env", ())))
            found.append((words, load_config(part.source, preset=preset, **{**fixed, **varied, **draw})))
    return found


def _table(env: Any) -> dict[str, Any]:
    """A task's options {name: value}, from a table or from NAME=VALUE,NAME=VALUE."""
    return dict(convert("env", _split(env) if isinstance(env, str) else env))


def _beside(varied: dict[str, Any], fixed: dict[str, Any]) -> dict[str, Any]:
    for name in varied.keys() & fixed.keys():
        raise UsageError(f"the option {name} varies and is given by itself; leave one of the two out")
    return fixed | varied


def _check(part: Part, fixed: Mapping[str, Any]) -> None:
    for name in (*part.values, *part.ranges):
        if name in fixed and name != "env":
            raise UsageError(f"{name} varies and is given by itself; leave one of the two out")
        if name not in FIELDS:
            raise UsageError(f"unknown setting '{name}'{did_you_mean(name, FIELDS)}")
        if name in part.values and not part.values[name]:
            raise UsageError(f"{name} varies over an empty list; give it at least one value")
        words = [_word(x) for x in part.values.get(name, ())]
        if twice := [word for word, count in collections.Counter(words).items() if count > 1]:
            lists = f"; one list of them goes into brackets: {name}=[{','.join(words)}]" if name == "hidden" else ""
            raise UsageError(f"{name} has the value {twice[0]} twice; name each once{lists}")
        if name == "task":
            raise UsageError("--set has one task; sweep each with its own --out, or give each a [[sweep]] in a file")
    for name in part.ranges:
        if FIELDS[name] not in (int, float):
            raise UsageError(f"'{name}' is not a number and has no range to draw from; list its values")
    if part.ranges and not part.draws:
        raise UsageError(f"{next(iter(part.ranges))} has a range: add --random N, the number of values to draw")
    if part.draws and not part.ranges:
        raise UsageError("random draws need a range, like --set lambda_lr=log:0.01:1")


def _word(value: Any) -> str:
    """A value in the form that a folder's name has: a number the same however it was written."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return ",".join(f"{name}={_word(x)}" for name, x in value.items())
    if isinstance(value, list | tuple):
        return ("+" if any(isinstance(x, list | tuple) for x in value) else ",").join(map(_word, value))
    try:
        return f"{float(value):.12g}"
    except (ValueError, TypeError):
        return re.sub(r"[^\w.=,+-]", "-", str(value))


def drawn(parts: Sequence[Part], points: Points) -> dict[str, Any]:
    """What was drawn for each point, from where and with which seed; empty if nothing was."""
    names = {name for part in parts for name in part.ranges}
    ranges = [{"seed": part.seed, **{k: r._asdict() for k, r in part.ranges.items()}} for part in parts if part.ranges]
    values = {name: {k: getattr(config, k) for k in sorted(names)} for name, config in points.items()}
    return {"ranges": ranges, "draws": {k: v for k, v in values.items() if "draw=" in k}} if ranges else {}


# ---------------------------------------------------------------------------------------------------------------------
# Parts from words and files


def from_words(source: Source, words: Sequence[str], draws: int = 0, seed: int = 0) -> Part:
    """The part of `--set NAME=VALUE,...` and `--set NAME=LOW:HIGH`, or `NAME=log:LOW:HIGH`.

    Raises:
      UsageError: a word of another form.
    """
    values, ranges = {}, {}
    for word in words:
        name, _, text = word.partition("=")
        if not text.strip(",") or text.count("[") != text.count("]"):
            raise UsageError(f"--set takes NAME=VALUE,VALUE,..., or with --random NAME=LOW:HIGH, not '{word}'")
        name = name.replace("-", "_")
        if name in values or name in ranges:
            raise UsageError(f"--set names {name} twice: give all its values at once, {name}=VALUE,VALUE")
        if found := _range(text):
            ranges[name] = found
        else:
            values[name] = [part[1:-1] if part[0] + part[-1] == "[]" else part for part in _split(text)]
    return Part(source, values, ranges, draws, seed)


def _split(text: str) -> list[str]:
    """The parts between commas that are in no brackets."""
    depths = itertools.accumulate((letter == "[") - (letter == "]") for letter in text)
    cut = "".join("\0" if letter == "," and not depth else letter for letter, depth in zip(text, depths, strict=True))
    return [part for part in cut.split("\0") if part]


def _range(text: Any) -> Range | None:
    """LOW:HIGH or log:LOW:HIGH; None if it is neither."""
    number = r"[+-]?[\d.]+(?:e[+-]?\d+)?"
    match = re.fullmatch(rf"(log:)?({number}):({number})", text) if isinstance(text, str) else None
    if match is None:
        return None
    try:
        low, high = float(match[2]), float(match[3])
    except ValueError:
        return None
    if not low < high or not math.isfinite(high - low) or (match[1] and low <= 0):
        raise UsageError(f"a range is LOW:HIGH with LOW below HIGH, both above 0 after log:, not '{text}'")
    return Range(low, high, bool(match[1]))


def has_parts(source: str) -> bool:
    """Whether `source` is a TOML file with a sweep."""
    return source.endswith(".toml") and "sweep" in load.read(source)


def from_file(file: str | pathlib.Path) -> list[Part]:
    """The parts in the [[sweep]] tables, or in a single [sweep] table, of a TOML file.

    Raises:
      UsageError: no such file or table, or one of another form.
    """
    shared = load.read(file)
    tables = shared.pop("sweep", [])
    tables = [tables] if isinstance(tables, dict) else tables
    if not (isinstance(tables, list) and tables and all(isinstance(table, dict) for table in tables)):
        raise UsageError(f"{file} has no [[sweep]] table; add one, or --set NAME=VALUE,VALUE")
    return [_part(file, shared, dict(table)) for table in tables]


def _part(file: str | pathlib.Path, shared: dict[str, Any], table: dict[str, Any]) -> Part:
    base = load.read(load.extended(file, table.pop("extends"))) if "extends" in table else {}
    if base and "task" in shared:
        raise UsageError(f"{file}: a [[sweep]] extends another file only where the file above it names no task")
    merged = load.over(load.over(base, shared), {k: v for k, v in table.items() if k not in PART})
    varied, draws, seed = (table.get(name, default) for name, default in PART.items())
    if not isinstance(varied, dict):
        raise UsageError(f"{file}: set must be a table of settings, like set.lambda_lr = [0.1, 0.3]")
    for name, least in (("random", 1), ("draw_seed", 0)):
        number = table.get(name, least)
        if isinstance(number, bool) or not isinstance(number, int) or number < least:
            raise UsageError(f"{file}: {name} must be a whole number of at least {least}, not {number!r}")
    method, merged["method"] = load.named(merged)
    if method is not None:  # one or several
        varied = {"method": method, **varied}
    ranges = {k: found for k, v in varied.items() if (found := _range(v))}
    values = {k: v if isinstance(v, list) else [v] for k, v in varied.items() if k not in ranges}
    return Part(merged, values, ranges, draws, seed)
