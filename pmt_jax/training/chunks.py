"""Chunks: how many updates one call of the compiled program makes, and the row that one or several of them fill.

A chunk ends with the row, or earlier so that signals are obeyed soon. Its length depends on the clock. Rows and states
do not depend on it: an update is the same in every chunk, and a row is made of the metrics of its updates.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from ..config.settings import Config

SECONDS = 3.0  # of a chunk; the next is seldom three times as slow, so a signal waits for less than 10 s
MOST = 1000  # updates of a chunk: the program has room for the metrics of so many


def most(config: Config) -> int:
    """The largest number of updates that one call of the program makes."""
    return min(config.log_interval, MOST)


def row_end(config: Config, done: int) -> int:
    """Updates after which the row ends that the update after `done` belongs to: a multiple of log_interval, or all."""
    return min((done // config.log_interval + 1) * config.log_interval, config.num_updates)


def plan(config: Config, done: int, seconds: float | None) -> int:
    """How many updates the next chunk makes: up to the end of the row, if that takes no longer than `SECONDS`.

    Args:
      done: updates made so far.
      seconds: that an update took in the last chunk; None before the first, which is one update.
    """
    if seconds is None:
        return 1
    in_time = int(min(SECONDS / max(seconds, 1e-9), MOST))
    return max(1, min(row_end(config, done) - done, most(config), in_time))


@dataclasses.dataclass(frozen=True)
class OpenRow:
    """The metrics of the updates since the last row.

    Attributes:
      updates: how many.
      metrics: {name: [seeds, updates]}, or [seeds] of what is known of the newest state only.
    """

    updates: int = 0
    metrics: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def then(self, updates: int, metrics: Mapping[str, np.ndarray]) -> OpenRow:
        """With the first `updates` of the metrics of one more chunk."""
        newest = {name: x[:, :updates] if x.ndim > 1 else x for name, x in metrics.items()}
        both = {
            name: np.concatenate([self.metrics[name], x], axis=1) if x.ndim > 1 and name in self.metrics else x
            for name, x in newest.items()
        }
        return OpenRow(self.updates + updates, both)

    @property
    def hopeless(self) -> np.ndarray:
        """[seeds] bool: whose row will say that the seed broke, so that no update of the rest can matter."""
        return ~self.metrics["finite"].astype(bool) | self.metrics["cost_out_of_range"].any(axis=1)

    @classmethod
    def of(cls, metrics: Mapping[str, np.ndarray]) -> OpenRow:
        """The row that was open when `metrics` were saved."""
        return cls(max((x.shape[1] for x in metrics.values() if x.ndim > 1), default=0), dict(metrics))
