"""The process that trains one program of a sweep: `python -m pmt_jax.cli.job FOLDER OUT CACHE DEVICES`."""

from __future__ import annotations

import os
import pathlib
import signal
import sys
import threading

from ..output import say
from ..studies import sweep
from ..training import processes
from ..trust import trusting
from . import end
from .process import answer


def end_with_parent() -> None:
    """Standard input ends when whoever started this process is gone, even by kill -9: save and end then."""
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> int:
    """Trains the program of the arguments."""
    threading.Thread(target=end_with_parent, daemon=True).start()
    folder, out, cache, given = sys.argv[1:]

    def train() -> int:
        devices = int(given) if given else None
        processes.make_room(devices)
        with trusting():  # whoever started this process has checked what its settings name
            return sweep.train_program(pathlib.Path(folder), pathlib.Path(out), bool(int(cache)), say, devices)

    return answer("pmt", train)


if __name__ == "__main__":
    end(main())
