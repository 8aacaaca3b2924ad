"""Safety-Gymnasium's multi-agent velocity tasks. Importing this imports neither JAX nor MuJoCo."""

from __future__ import annotations

from typing import NamedTuple

from ..columns import Column

Partition = tuple[tuple[int, ...], ...]


class Variant(NamedTuple):
    """A task.

    Attributes:
      robot: one of ROBOTS.
      threshold: m/s, a faster step costs.
      partition: the actuators of each agent, in the order of the agent's action entries.
    """

    robot: str
    threshold: float
    partition: Partition


_HALVES = ((0, 1, 2), (3, 4, 5))
VARIANTS = {
    "ant_2x4": Variant("ant", 2.522, ((2, 3, 4, 5), (6, 7, 0, 1))),
    "ant_4x2": Variant("ant", 2.418, ((2, 3), (4, 5), (6, 7), (0, 1))),
    "half_cheetah_2x3": Variant("half_cheetah", 3.227, _HALVES),
    "half_cheetah_6x1": Variant("half_cheetah", 2.932, ((0,), (1,), (2,), (3,), (4,), (5,))),
    "hopper_3x1": Variant("hopper", 0.9613, ((0,), (1,), (2,))),
    "walker2d_2x3": Variant("walker2d", 1.641, ((2, 1, 0), (5, 4, 3))),
    "swimmer_2x1": Variant("swimmer", 0.04891, ((0,), (1,))),
    "humanoid_9_8": Variant("humanoid", 0.58, ((2, 0, 1, 11, 12, 13, 14, 15, 16), (3, 5, 4, 6, 7, 9, 8, 10))),
}

COLUMNS = {
    "speed": Column("speed", "in m/s, as the cost measures it, mean over steps"),
    "fallen": Column("fallen", "share of steps that ended their episode by the robot's rule of health", 0, 1),
}
