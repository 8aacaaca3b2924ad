"""Which agent drives which actuators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .errors import TaskError

if TYPE_CHECKING:
    import jax


class Partition(NamedTuple):
    """The actuators of each agent, every actuator exactly once.

    Attributes:
      groups: for each agent its actuators, in the order of its action's entries.

    Example:
      >>> two = parse("0,2|1", count=3)
      >>> two.mask.tolist()
      [[1.0, 1.0], [1.0, 0.0]]
      >>> two.join(np.array([[5.0, 7.0], [6.0, 0.0]])).tolist()
      [5.0, 6.0, 7.0]
    """

    groups: tuple[tuple[int, ...], ...]

    @property
    def mask(self) -> np.ndarray:
        """[N, A] 1 where an agent has that action entry."""
        sizes = np.array([len(group) for group in self.groups])
        return (np.arange(sizes.max()) < sizes[:, None]).astype(np.float32)

    @property
    def even(self) -> bool:
        """Whether the agents' actions in a row are the actuators in order."""
        sizes = {len(group) for group in self.groups}
        return len(sizes) == 1 and sum(self.groups, ()) == tuple(range(sum(map(len, self.groups))))

    @property
    def name(self) -> str:
        """For the names of tasks: `2x4` if it is even, else the sizes, as `6_2`."""
        sizes = [len(group) for group in self.groups]
        return f"{len(sizes)}x{sizes[0]}" if self.even else "_".join(map(str, sizes))

    def join(self, action: jax.Array) -> jax.Array:
        """The actuators' inputs [nu] from the agents' actions [N, A]."""
        if self.even:
            return action.reshape(-1)
        places = sorted((actuator, i, k) for i, group in enumerate(self.groups) for k, actuator in enumerate(group))
        _, agents, entries = np.array(places).T
        return action[agents, entries]


def evenly(num_agents: int, count: int) -> Partition:
    """`count` actuators in order, as many for each agent."""
    each = count // num_agents
    return Partition(tuple(tuple(range(i * each, (i + 1) * each)) for i in range(num_agents)))


def parse(text: str | Sequence[Sequence[int]], count: int) -> Partition:
    """A partition of `count` actuators from text like `0,1|2,3`, agents apart by `|`, or from lists of numbers.

    Raises:
      TaskError: an actuator is missing, stands twice or does not exist.
    """
    wanted = f"each of the actuators 0 to {count - 1} once, agents apart by |, as 0,1|2,3"
    parts: Sequence[Any] = [part.split(",") for part in text.split("|")] if isinstance(text, str) else text
    try:
        groups = tuple(tuple(int(actuator) for actuator in part) for part in parts)
    except (TypeError, ValueError):
        raise TaskError(f"partition must name {wanted}, not {text!r}") from None
    if sorted(sum(groups, ())) != list(range(count)) or not all(groups):
        raise TaskError(f"partition must name {wanted}, not {text!r}")
    return Partition(groups)
