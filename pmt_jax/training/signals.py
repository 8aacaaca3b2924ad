"""Ctrl-C, SIGTERM and SIGHUP: noted instead of raised, because an exception could land inside the physics."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import types
from collections.abc import Callable, Iterator

from ..output import Say, dropped_if_closed

PATIENCE = 10.0  # seconds that a signal waits for the running chunk, which may be a single long update
CAUGHT = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SHOW_CURSOR = "\x1b[?25h"


@contextlib.contextmanager
def noted() -> Iterator[list[int]]:
    """Yields the list of the signals that have arrived.

    SIGHUP stays ignored under nohup. Outside of the main thread, where signals cannot be caught, none arrives.
    """
    received: list[int] = []

    def note(number: int, _: types.FrameType | None) -> None:
        received.append(number)

    wanted = [n for n in CAUGHT if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
    try:
        before = {number: signal.signal(number, note) for number in wanted}
    except ValueError:
        before = {}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Interrupts:
    """How a run handles signals: it ends at once, but after `save_first` it ends when the running chunk is saved.

    A chunk that takes longer than `PATIENCE` is given up: what was trained before it is saved.

    Python's handlers wait for C++ to return, from compiling or from a long chunk. A thread reads the signals at once.

    Attributes:
      received: the numbers of the signals that have arrived.
    """

    def __init__(self, say: Say, before_exit: Callable[[], object]) -> None:
        """`before_exit` is called before the process ends at once."""
        self.received: list[int] = []
        self._say, self._before_exit = say, before_exit
        self._rescue: Callable[[], str] | None = None
        self._stack = contextlib.ExitStack()

    def save_first(self, rescue: Callable[[], str]) -> None:
        """From now on a signal is only noted; a second Ctrl-C still ends the process at once.

        Args:
          rescue: called from another thread if the chunk does not end; saves what was trained before it and returns
            what to print, or "" to wait on.
        """
        self._rescue = rescue

    def __enter__(self) -> Interrupts:
        self.received = self._stack.enter_context(noted())
        read, write = socket.socketpair()
        write.setblocking(False)
        try:
            before = signal.set_wakeup_fd(write.fileno(), warn_on_full_buffer=False)
        except ValueError:  # not the main thread
            read.close()
            write.close()
            return self
        thread = threading.Thread(target=self._listen, args=(read,), daemon=True)
        thread.start()
        for undo in (read.close, thread.join, write.close, lambda: signal.set_wakeup_fd(before)):
            self._stack.callback(undo)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _listen(self, pipe: socket.socket) -> None:
        interrupted = False
        while data := pipe.recv(1):
            number = data[0]
            if number in CAUGHT:
                self.answer(number, at_once=self._rescue is None or (interrupted and number == signal.SIGINT))
            interrupted |= number == signal.SIGINT

    def answer(self, number: int, at_once: bool) -> None:
        """Lets training save and end, or ends this process `at_once`."""
        if not at_once:
            self._say("interrupted: saving after the running chunk; Ctrl-C again ends at once, without saving")
            timer = threading.Timer(PATIENCE, self._give_up, [number])
            timer.daemon = True
            self._stack.callback(timer.cancel)
            timer.start()
            return
        what = "what was not saved is lost" if self._rescue else "nothing new was trained yet"
        self._end(number, f"interrupted: {what}")

    def _give_up(self, number: int) -> None:
        assert self._rescue is not None  # without it a signal does not wait
        if sentence := self._rescue():
            self._end(number, sentence)

    def _end(self, number: int, sentence: str) -> None:
        self._say(sentence)
        self._before_exit()
        with dropped_if_closed():
            if sys.stdout.isatty():  # the live table has hidden the cursor
                sys.stdout.write(SHOW_CURSOR)
            sys.stdout.flush()
        os._exit(128 + number)
