"""Python code that is tried in a process of its own, because it may kill it or leave it unusable."""

from __future__ import annotations

import os
import subprocess
import sys

NO_ANSWER = "does not answer within 60 s"


def run_python(code: str, **environment: str) -> str | None:
    """Runs Python code in a process of its own; the last line of its error, None if it had none."""
    command = [sys.executable, "-c", code]
    try:
        done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return NO_ANSWER
    return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1] if done.returncode else None
