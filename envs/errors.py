"""What the environments say when the caller made a mistake; imports nothing heavy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class TaskError(ValueError):
    """A mistake of the caller's, told in one sentence: what was wrong, what was expected, what to do."""


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """The nearest of `choices` as '; did you mean ...?', or the whole list where none is near."""
    choices = list(choices)
    near = difflib.get_close_matches(word, choices, n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(choices) or 'none'}"


def one_of(what: str, value: str, choices: Iterable[str]) -> str:
    """`value`, or a TaskError that names the nearest choice."""
    choices = list(choices)
    if value not in choices:
        raise TaskError(f"unknown {what} '{value}'{did_you_mean(value, choices)}")
    return value
