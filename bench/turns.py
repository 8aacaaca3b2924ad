"""Programs that take turns, so that whatever else the machine does hits all alike."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax


@dataclasses.dataclass
class Contestant:
    """A compiled piece of training, the state it has come to, and the seconds of each of its turns.

    Attributes:
      update: state -> the state after it, and metrics; compile_seconds: what tracing and compiling it took.
    """

    state: Any
    update: Callable[[Any], tuple[Any, Any]]
    compile_seconds: float
    seconds: list[float] = dataclasses.field(default_factory=list, init=False)

    def turn(self) -> None:
        """Goes on from where it stopped, and notes the time it took; the first turns warm up."""
        begin = time.perf_counter()
        self.state, _ = jax.block_until_ready(self.update(self.state))
        self.seconds.append(time.perf_counter() - begin)
