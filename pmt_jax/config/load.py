"""Where settings come from: tables in configs/, files of the user's own, presets, keywords and words of a command line.

The settings of a task are what all methods share, then a `[method.NAME]` table of what differs. They may begin with
those of another: `extends = "NAME"`.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import pathlib
import re
import shlex
import tomllib
import typing
from typing import Any, Literal

import tomli_w

from ..errors import UsageError
from ..tasks import absolute, did_you_mean, is_file
from . import methods
from .settings import FIELDS, Config

_PACKAGE = pathlib.Path(__file__).parents[1]
CONFIG_DIR = _PACKAGE / "configs" if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent / "configs"

Table = dict[str, Any]
CHOSEN = ""  # among tables [method.NAME], in place of a name: which of them is meant


def load_config(
    source: str | pathlib.Path | dict[str, Any],
    method: str | None = None,
    preset: str = "default",
    **overrides: Any,
) -> Config:
    """Settings of a task: defaults, then the file, its [method.NAME] table, the preset, then `overrides`.

    A task's own options (`env`) are laid over each other one by one.

    Args:
      source: a name in `names()` (`lane`, `paper/ant_2x4`), the path of a TOML file (a run's own config.toml included),
        a Python file with an environment of your own (`my_env.py`, `my_env.py:Name`), or what such a file holds.
      method: a name in METHODS, or a Python file with a row of your own (`my_methods.py:dread`); the file's own choice
        if None.
      preset: a table of configs/presets.toml.
      **overrides: any field of Config.

    Raises:
      UsageError: no such file, an unknown field, or a value of the wrong type or range.

    Examples:
      >>> load_config("lane", method="happo", num_envs=8).num_envs
      8
    """
    table = source if isinstance(source, dict) else _read(source)
    source = "a [[sweep]]" if isinstance(source, dict) else source
    own, _ = named(table)
    if method is None:
        method = own if isinstance(own, str) else str(Config.method)
    method = methods.known(method)
    layers = [_for_method(source, table, method), _for_method(preset, read_preset(preset), method), overrides]
    values = {name: value for layer in layers for name, value in layer.items()}
    if "env" in values:
        values["env"] = [pair for layer in layers for pair in convert("env", layer.get("env", ()))]
    if "task" not in values:
        raise UsageError(f'{source} names no task; add extends = "TASK" with one that pmt envs lists')
    values["task"] = absolute(str(values["task"]))
    if (init := str(values.get("init", ""))) and not init.startswith("hub:"):
        values["init"] = str(pathlib.Path(init).expanduser().absolute())
    converted: dict[str, Any] = {name: convert(name, value) for name, value in values.items()}
    converted["method"] = method
    return Config(**converted)


def _read(source: str | pathlib.Path) -> dict[str, Any]:
    table = {"task": str(source)} if is_file(str(source)) else read(source)
    if "sweep" in table:
        raise UsageError(f"{source} describes a sweep of many runs: pmt sweep {source} --out DIR")
    return table


def _for_method(source: str | pathlib.Path, table: dict[str, Any], method: str) -> dict[str, Any]:
    """What a file says of one method: what all share, then the method's own table."""
    shared = {name: value for name, value in table.items() if name != "method"}
    own, tables = named(table)
    if not isinstance(own, str | None) or not all(isinstance(t, dict) for t in tables.values()):
        raise UsageError(f"{source}: 'method' must be a name, or [method.NAME] tables")
    for name, own in tables.items():  # those of other methods, too, or a typing error shows in one run of many
        methods.known(name)
        for field, value in own.items():
            convert(field, value)
    return _merged(shared, tables.get(method, {}))


def to_toml(config: Config) -> str:
    """The run's settings as a file that `load_config` reads back to an equal Config."""
    values = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    options = dict(values.pop("env"))
    return tomli_w.dumps(values | ({"env": options} if options else {}))


# ---------------------------------------------------------------------------------------------------------------------
# Files


@functools.cache
def _packaged() -> dict[str, Table]:
    """The configurations that come with the package, by name: tables of tasks.toml, and `paper/TASK` of paper.toml."""
    tasks = {name: {"task": name, **table} for name, table in _parse(CONFIG_DIR / "tasks.toml").items()}
    paper = _parse(CONFIG_DIR / "paper.toml").items()
    return tasks | {f"paper/{name}": {"extends": name, **table} for name, table in paper}


@functools.cache
def _presets() -> dict[str, Table]:
    return _parse(CONFIG_DIR / "presets.toml")


def names() -> list[str]:
    """The configurations that come with the package: `lane`, `paper/ant_2x4`, ..."""
    return sorted(_packaged())


def presets() -> dict[str, str]:
    """What can be laid over any configuration: {name: one sentence about it}."""
    return {name: str(table["about"]) for name, table in _presets().items()}


def about(name: str) -> str:
    """The sentence in which a configuration of the package describes itself; '' if there is none of that name."""
    return str(_packaged().get(name, {}).get("about", ""))


def read(source: str | pathlib.Path) -> Table:
    """Settings, laid over those that they `extend`.

    Args:
      source: one of `names()`, or the path of a TOML file.

    Raises:
      UsageError: no such file, or one that is not valid.
    """
    source = str(source)
    if source not in _packaged() and not source.endswith(".toml") and not os.path.isfile(source):
        _refuse(source)
    return _resolve(source, ())


def read_preset(name: str) -> Table:
    """The settings of a preset.

    Raises:
      UsageError: there is none of that name.
    """
    tables = _presets()
    if str(name) not in tables:
        raise UsageError(f"unknown preset '{name}'{did_you_mean(str(name), tables)}")
    return {key: value for key, value in tables[str(name)].items() if key != "about"}


def resume_command(out: str) -> str:
    """What continues the run in the folder `out`, to be typed into a shell."""
    return shlex.join(["pmt", "train", os.path.join(out, "config.toml"), "--out", out, "--resume"])


def _refuse(source: str) -> typing.NoReturn:
    if os.path.isfile(settings := os.path.join(source, "config.toml")):
        again = resume_command(source)
        raise UsageError(f"{source} is a run folder; its settings are {settings}, and this continues it: {again}")
    raise UsageError(f"unknown task '{source}'{did_you_mean(source, names())} (pmt envs lists all)")


def _resolve(source: str, below: tuple[str, ...]) -> Table:
    """The settings of a name or a file; `below` are the files that it was reached from by `extends`."""
    known = _packaged()
    table = dict(known[source]) if source in known else _parse(pathlib.Path(source))
    table.pop("about", None)
    base = table.pop("extends", None)
    if base is None:
        return table
    found = extended(source, base)
    chain = (*below, _identity(source))
    if _identity(found) in chain:
        raise UsageError(f"{source} extends '{base}', which extends it in turn")
    return over(_resolve(found, chain), table)


def extended(source: str | pathlib.Path, base: Any) -> str:
    """What the file `source` means by `extends = base`: a name in `names()`, or the path of a file next to it.

    Raises:
      UsageError: it is neither.
    """
    if not isinstance(base, str):
        raise UsageError(f"{source}: 'extends' must be one name that pmt envs lists or one path, not {base!r}")
    known = _packaged()
    found = base if base in known else os.path.join(os.path.dirname(source), base)
    if found not in known and not os.path.isfile(found):
        raise UsageError(f"{source} extends '{base}', which is not there{did_you_mean(base, known)}")
    return found


def _identity(source: str) -> str:
    """The same for each way to write a path; a name of the package is no path, even next to a file called so."""
    return source if source in _packaged() else os.path.realpath(source)


def over(base: Table, top: Table) -> Table:
    """`top` laid over `base`, tables within them key by key; a method named by one stays beside tables of the other."""
    named_by = [x for x in (base, top) if not isinstance(x.get("method", {}), dict)]
    if len(named_by) == 1 and "method" in base and "method" in top:
        base, top = (x | {"method": {CHOSEN: x["method"]}} if x in named_by else x for x in (base, top))
    return _merged(base, top)


def named(table: Table) -> tuple[Any, Table]:
    """The method that settings name, None if they do not, and their [method.NAME] tables."""
    method = table.get("method")
    if not isinstance(method, dict):
        return method, {}
    return method.get(CHOSEN), {name: own for name, own in method.items() if name != CHOSEN}


def _merged(base: Table, top: Table) -> Table:
    both = {key: _merged(base[key], top[key]) for key in base.keys() & top.keys() if _tables(base[key], top[key])}
    return {**base, **top, **both}


def _tables(*values: Any) -> bool:
    return all(isinstance(value, dict) for value in values)


def _parse(path: pathlib.Path) -> Table:
    try:
        return tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        if isinstance(error, tomllib.TOMLDecodeError) and _names_and_tables(path.read_text()):
            raise UsageError(
                f"{path}: method = NAME and [method.NAME] tables exclude each other; keep the tables and choose with "
                "--method, or move the one method's settings above all tables"
            ) from None
        raise UsageError(f"{path} is not valid TOML: {error}") from None
    except FileNotFoundError:
        raise UsageError(f"there is no configuration file {path}") from None
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"cannot read the configuration file {path}: {reason}") from None


def _names_and_tables(text: str) -> bool:
    """Whether a TOML file names one method above its tables, of which one is of a method."""
    above, _, _ = text.partition("\n[")
    return bool(re.search(r"^\s*method\s*=", above, re.MULTILINE) and re.search(r"^\[\s*method\.", text, re.MULTILINE))


# ---------------------------------------------------------------------------------------------------------------------
# Words as values


def convert(name: str, value: Any) -> Any:
    """`value` (from TOML, a keyword or a command line) as the type that field `name` has.

    Raises:
      UsageError: unknown field, or a value that does not fit.
    """
    if name not in FIELDS:
        raise UsageError(f"unknown setting '{name}'{did_you_mean(name, FIELDS)}")
    try:
        return to_type(FIELDS[name], value)
    except (ValueError, TypeError, OverflowError):
        raise UsageError(f"{name} = {value!r} does not fit: expected {expectation(FIELDS[name])}") from None


def to_type(kind: Any, value: Any) -> Any:
    """`value` (from TOML, a keyword or a command line) as `kind`.

    Raises:
      ValueError, TypeError, OverflowError: it does not fit.
    """
    parameters = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return value if value in parameters else _fail()
    if kind is bool:
        words = {"true": True, "false": False}
        return value if isinstance(value, bool) else words[value] if value in words else _fail()
    if kind is int:
        number = _fail() if isinstance(value, bool) else value if isinstance(value, int) else float(value)
        return int(number) if number == int(number) else _fail()
    if kind is float:
        return _fail() if isinstance(value, bool) else float(value)
    if kind is str:
        return value if isinstance(value, str) else _fail()
    if parameters == (int, ...):
        parts = value.split(",") if isinstance(value, str) else value
        return tuple(to_type(int, part) for part in parts)
    if float in parameters:  # a number, or one for each cost
        parts = value.split(",") if isinstance(value, str) else value
        each = [to_type(float, part) for part in (parts if isinstance(parts, list | tuple) else [parts])]
        return tuple(each) if len(each) > 1 else each[0] if each else _fail()
    return _options(value)


def _options(value: Any) -> tuple[tuple[str, Any], ...]:
    """A task's own options, from a table, from pairs or from words like `name=value`; the last of a name holds."""
    items = value.items() if isinstance(value, dict) else value
    pairs = [item.split("=", 1) if isinstance(item, str) else item for item in items]
    return tuple(sorted({str(name): _option(x) for name, x in pairs}.items()))


def _option(value: Any) -> Any:
    """An option's value as TOML would read it: numbers, booleans and lists are recognised, other words stay words."""
    if isinstance(value, list | tuple):
        return tuple(_option(part) for part in value)
    if not isinstance(value, str):
        return value if isinstance(value, int | float) else _fail()
    try:
        read = tomllib.loads(f"x = {value}")["x"]
    except tomllib.TOMLDecodeError:
        return value
    return _option(read) if isinstance(read, int | float | list) else read if isinstance(read, str) else value


def _fail() -> typing.NoReturn:
    raise ValueError


def expectation(kind: Any) -> str:
    """What a field of type `kind` takes, in words."""
    if typing.get_origin(kind) is Literal:
        return " | ".join(typing.get_args(kind))
    if kind in (int, float, bool, str):
        return {int: "a whole number", float: "a number", bool: "true or false", str: "a word"}[kind]
    if typing.get_args(kind) == (int, ...):
        return "whole numbers, as 128,128 (in a file [128, 128])"
    if float in typing.get_args(kind):
        return "a number, or one for each cost: 1,0.5"
    return "name=value"
