"""Ctrl-C before there is anything to save: exit code 130 at once, and no traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

# Ctrl-C arrives while `module` is imported. JAX's own imports would turn an exception into something else.
INTERRUPTED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt as interrupt:
                {then}
sys.meta_path.insert(0, Interrupt())
from pmt_jax.cli import main
sys.exit(main(["train", "lane"]))
"""


@pytest.mark.parametrize(
    ("module", "then"), [("pmt_jax.cli.commands", "raise"), ("jax", "raise RecursionError"), ("numpy", "pass")]
)
def test_during_imports(module: str, then: str, tmp_path):
    command = [sys.executable, "-c", INTERRUPTED.format(module=module, then=then)]
    path = os.pathsep.join(os.path.abspath(folder) for folder in sys.path if folder)
    done = subprocess.run(
        command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stderr, done.stdout) == (130, "", "")


def test_the_handler_goes_with_the_command(cli):
    before = signal.getsignal(signal.SIGINT)
    assert cli("train", "lane", "--steps", "1")[0] == 2
    assert signal.getsignal(signal.SIGINT) is before
