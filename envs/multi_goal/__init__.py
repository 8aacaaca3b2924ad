"""Safety-Gymnasium's MultiGoal tasks. Importing this imports neither JAX nor MuJoCo."""

from __future__ import annotations

from typing import NamedTuple

from ..columns import Column


class Level(NamedTuple):
    """What lies in the world of a level.

    Attributes:
      size: m, half the side of the square in which everything is placed.
      hazards, vases: how many.
      charges: the kinds of cost that a step may have.
    """

    size: float
    hazards: int
    vases: int
    charges: tuple[str, ...]


LEVELS = (
    Level(1.0, 0, 0, ()),
    Level(1.5, 8, 1, ("hazards", "robots")),
    Level(2.0, 10, 10, ("hazards", "vases", "robots")),
)
VARIANTS = {f"{robot}_{level}": (robot, level) for robot in ("point", "ant") for level in range(len(LEVELS))}

COLUMNS = {
    "reached": Column("reached", "goals reached per agent and step; 0.01 is 10 in an episode of 1000 steps", 0, 1),
    "hazards": Column("hazards", "share of steps in which an agent is in a hazard, mean over agents", 0, 1),
    "vases": Column("vases", "share of steps in which an agent touches a vase or one of its vases moves", 0, 1),
    "robots": Column("robots", "share of steps in which robots touch, as the cost counts it", 0, 1),
}
