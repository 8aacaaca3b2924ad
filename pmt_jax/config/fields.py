"""What a setting is: its type, default, group, meaning and bounds."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

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
