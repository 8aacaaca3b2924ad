"""What a peer reports while it trains: a line of JSON per update."""

from __future__ import annotations

import json
import math
import os
import pathlib
import time
from typing import Any

from .. import measure


class Report:
    """Writes a line of JSON per update; ends the process `seconds` after the first update, which compiles."""

    def __init__(self, out: pathlib.Path, seconds: float) -> None:
        self._out, self._seconds = out.open("w", buffering=1), seconds
        self._watch: measure.Watch | None = None

    def about(self, **facts: Any) -> None:
        """What the row says besides its figures."""
        self._out.write(json.dumps(facts) + "\n")

    def __call__(self, steps: int, reward: Any = None, cost: Any = None) -> None:
        """`steps` so far, over all environments; reward and cost of recent episodes, NaN or None if none ended."""
        self._watch = self._watch or measure.Watch()
        scores = {name: float(x) for name, x in (("reward", reward), ("cost", cost)) if x is not None}
        known = {name: x for name, x in scores.items() if math.isfinite(x)}
        self._out.write(json.dumps({"time": time.time(), "steps": steps, **known}) + "\n")
        if self._watch.wall >= self._seconds:
            self._out.write(json.dumps({"other_work_cpus": round(self._watch.others, 2)}) + "\n")
            os._exit(0)  # also out of a callback of a compiled loop
