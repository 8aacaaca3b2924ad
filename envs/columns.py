"""How tables name a task's metrics; imports nothing of ours, so that tables need neither JAX nor MuJoCo."""

from __future__ import annotations

import math
from typing import NamedTuple


class Column(NamedTuple):
    """A metric of a task's `info` as a column of tables.

    Attributes:
      name: the column's head.
      definition: what the metric means and in which unit, the rest of a sentence that begins with the name.
      low, high: no value lies beyond; intervals are cut there.
    """

    name: str
    definition: str
    low: float = -math.inf
    high: float = math.inf
