"""Errors of the environments, one sentence each, and checks that raise them; imports nothing heavy."""

from __future__ import annotations

import difflib
import functools
import inspect
import math
import numbers
import types
import typing
from collections.abc import Callable, Iterable
from typing import Any


class TaskError(ValueError):
    """A mistake of the caller's, in one sentence: what was wrong, what was expected, what to do."""


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """The nearest of `choices`, whatever its case, as '; did you mean ...?', or the whole list if none is near."""
    choices = list(choices)
    folded = {choice.casefold(): choice for choice in choices}
    near = difflib.get_close_matches(word.casefold(), folded, n=1, cutoff=0.5)
    return f"; did you mean '{folded[near[0]]}'?" if near else f"; known: {', '.join(choices) or 'none'}"


def one_of(what: str, value: str, choices: Iterable[str]) -> str:
    """`value`, or a TaskError that names the nearest choice."""
    choices = list(choices)
    if value not in choices:
        raise TaskError(f"unknown {what} '{value}'{did_you_mean(value, choices)}")
    return value


def at_least(what: str, value: float, least: float) -> Any:
    """`value`, or a TaskError that names the least value."""
    if not value >= least:  # nan is not
        raise TaskError(f"{what} must be at least {least:g}, not {value}")
    return value


def typed(init: Callable[..., None]) -> Callable[..., None]:
    """Decorates a constructor: an argument whose type is not the annotated one is a TaskError of one sentence.

    A whole number fits `float`, and `True` fits neither `int` nor `float`; a `float` must be finite.
    """

    @functools.wraps(init)
    def checked(*args: Any, **kwargs: Any) -> None:
        hints = typing.get_type_hints(init)
        for name, value in inspect.signature(init).bind(*args, **kwargs).arguments.items():
            if name in hints and not any(_fits(value, kind) for kind in _kinds(hints[name])):
                wanted = " or ".join(_WORDS.get(kind) or f"a {kind.__name__}" for kind in _kinds(hints[name]))
                raise TaskError(f"{name} must be {wanted}, not {value!r}")
        init(*args, **kwargs)

    return checked


_WORDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    tuple: "a tuple ([a, b] on a command line)",
    types.NoneType: "none",
}


def _kinds(hint: Any) -> list[type]:
    """The types that an annotation allows; of `tuple[str, ...]` the tuple."""
    members = typing.get_args(hint) if isinstance(hint, types.UnionType) else [hint]
    return [typing.get_origin(member) or member for member in members]


def _fits(value: Any, kind: type) -> bool:
    if isinstance(value, bool) and kind in (int, float):
        return False
    if kind is int:
        return isinstance(value, numbers.Integral)
    if kind is float:
        return isinstance(value, numbers.Real) and math.isfinite(value)
    return isinstance(value, kind)
