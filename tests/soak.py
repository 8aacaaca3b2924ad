"""Runs that are killed at random moments and resumed until they are done."""

from __future__ import annotations

import contextlib
import os
import pathlib
import random
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

from runs import ARGUMENTS, environment

KINDS = (signal.SIGKILL, "closed pipe", "full disk", signal.SIGTERM, signal.SIGHUP, signal.SIGINT)

SAVES_EVERY_ROW = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)  # ignored where tests run in the background
from pmt_jax.cli import run
from pmt_jax.training import loop
loop.CHECKPOINT_SECONDS = 0.0
signal.signal(signal.SIGINT, signal.default_int_handler)
run(sys.argv[1:])
"""


def start(out: pathlib.Path, steps: int) -> subprocess.Popen[str]:
    """The run in `out`, or what is left of it."""
    resume = ["--resume"] if (out / "config.toml").is_file() else []
    words = ("train", *ARGUMENTS, "--steps", steps, "--out", out, *resume)
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", SAVES_EVERY_ROW, *map(str, words)]
    return subprocess.Popen(command, env=environment(), stdout=pipe, stderr=pipe, text=True)


def newest(out: pathlib.Path) -> int:
    """The step of the newest finished checkpoint; 0 where there is none."""
    folder = out / "checkpoints"
    return max((int(p.name) for p in folder.iterdir() if p.name.isdigit()), default=0) if folder.is_dir() else 0


@contextlib.contextmanager
def full(disk: pathlib.Path) -> Iterator[None]:
    """Not a byte is free on `disk`."""
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        for size in (1 << 16, 1 << 12, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(b"x" * size)
    try:
        yield
    finally:
        filler.unlink()


class Session:
    """One start of a run, up to its end by itself or by us; `text` is what it printed."""

    def __init__(self, out: pathlib.Path, steps: int) -> None:
        self.out, self.before, self.text = out, newest(out), ""
        self.process = start(out, steps)
        self._compiled = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout
        with contextlib.suppress(ValueError, OSError):  # closed by us
            for line in self.process.stdout:
                self.text += line
                if line.startswith("compiled in"):
                    self._compiled.set()
        self._compiled.set()

    def wait_until_it_trains(self) -> None:
        self._compiled.wait(400)

    def end(self, kind: int | str, disk: pathlib.Path) -> None:
        """Ends it, or disturbs it and waits for its end; checks that nothing finished is lost."""
        with full(disk) if kind == "full disk" else contextlib.nullcontext():
            if kind == "closed pipe":
                assert self.process.stdout
                os.close(os.dup2(os.open(os.devnull, os.O_RDONLY), self.process.stdout.fileno()))
            elif isinstance(kind, int):
                self.process.send_signal(kind)
            code = self.process.wait(400)  # on a loaded machine
        assert self.process.stderr
        err = self.process.stderr.read()
        allowed = {0, 1, 2} if kind == "full disk" else {0} if isinstance(kind, str) else {0, -kind, 128 + kind}
        assert code in allowed, (kind, code, self.text, err)
        began = "pmt: " in self.text
        assert not began or "Traceback" not in err, (kind, err)
        assert newest(self.out) >= self.before, (kind, self.text)
        resumed = re.findall(r"resuming after ([\d,]+) steps", self.text)
        assert all(int(step.replace(",", "")) == self.before for step in resumed), (kind, self.before, self.text)


def soak(out: pathlib.Path, steps: int, disk: pathlib.Path, kinds: list[int | str], chance: random.Random) -> int:
    """Trains a run of `steps` in `out`, which lies on `disk`, with an end of each of `kinds` in turn, then to its end.

    Returns:
      how many of these ends it met; fewer than there are `kinds` where it was done before.
    """
    for met, kind in enumerate(kinds):
        session = Session(out, steps)
        if chance.random() < 0.8:
            session.wait_until_it_trains()
            time.sleep(chance.uniform(0, 0.6))
        else:
            time.sleep(chance.uniform(0, 4))
        session.end(kind, disk)
        if newest(out) == steps:
            return met + 1
    session = Session(out, steps)
    assert session.process.wait(300) == 0, session.text
    return len(kinds)
