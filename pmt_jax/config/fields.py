"""What a setting is: its type, default, group, meaning and bounds, and how a word becomes a value of that type."""

from __future__ import annotations

import dataclasses
import functools
import tomllib
import typing
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

FLOAT32_MAX = 3.4e38  # traced numbers are float32, in which anything larger is infinite
INT32_MAX = 2**31 - 1

GROUPS = {
    "common": "what is trained, and for how long",
    "sizes": "environments, batches and networks; a change compiles a new program",
    "learning": "policies and critics",
    "constraint": "the cost limit, its multiplier (Lagrangian methods) and its trust region (MACPO)",
    "emotion": "fear (F4SG, Mixed) and regret (R4SG, Mixed)",
    "physics": "how the task is simulated, and its own options",
    "output": "what is written, and how often",
}


class Bound(NamedTuple):
    """What a setting's value must satisfy.

    Attributes:
      words: the end of the sentence `NAME must ...`.
      holds: whether a value satisfies it; a nan must not.
    """

    words: str
    holds: Callable[[Any], bool]


AT_LEAST_ONE = Bound("be at least 1", lambda x: x >= 1)
COUNT = Bound("be at least 1 and fit 32 bits", lambda x: 1 <= x <= INT32_MAX)
SHARE = Bound("lie in [0, 1]", lambda x: 0 <= x <= 1)
POSITIVE = Bound("be a number above 0", lambda x: 0 < x <= FLOAT32_MAX)
NOT_NEGATIVE = Bound("be a number that is not negative and fits 32 bits", lambda x: 0 <= x <= FLOAT32_MAX)
POSITIVE_OR_INF = Bound("be a number above 0, or inf", lambda x: x > 0)
STEPS_OR_INF = Bound("be a number of steps above 0, or inf", lambda x: x > 0)
NOT_NEGATIVE_OR_INF = Bound("be a number that is not negative, or inf", lambda x: x >= 0)


def _setting(group: str, default: Any, text: str, bound: Bound | None = None) -> Any:
    """A field of a settings dataclass; its metadata is the only description of it.

    Args:
      group: a key of GROUPS.
      default: the value if no file and no flag names it.
      text: what it means, for `--help` and the documents.
      bound: what its value must satisfy, beyond its type.
    """
    return dataclasses.field(default=default, metadata={"group": group, "help": text, "bound": bound})


common, sizes, learning, constraint, emotion, simulation, output = (
    functools.partial(_setting, group) for group in GROUPS
)


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
        several = isinstance(parts, list | tuple) and len(parts) > 1
        return tuple(to_type(float, part) for part in parts) if several else to_type(float, value)
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
