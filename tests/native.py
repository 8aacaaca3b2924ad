"""What compiled code needs on the machine that runs the tests."""

from __future__ import annotations

import pytest

from envs import native

compiled = pytest.mark.skipif(native.obstacle("fused") is not None, reason="no C++ compiler here")
