"""How tables name a task's figures; imports nothing, so that tables need neither JAX nor MuJoCo."""

from __future__ import annotations

from typing import NamedTuple


class Column(NamedTuple):
    """A figure of a task's `info` as a column of tables.

    Attributes:
      name: the column's head.
      definition: what the figure means and in which unit, the rest of a sentence that begins with the name.
    """

    name: str
    definition: str
