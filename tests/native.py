"""What compiled physics needs on the machine that runs the tests."""

from __future__ import annotations

import pytest

from envs.physics.fused import cpu

compiled = pytest.mark.skipif(cpu.obstacle() is not None, reason="no C++ compiler here")
