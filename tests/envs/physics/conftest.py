"""Shared by the tests of physics."""

from __future__ import annotations

import pytest

from envs import native


@pytest.fixture(autouse=True, scope="package")
def quick_compiler(request: pytest.FixtureRequest):
    """With less optimisation `fused` compiles in half the time; `-m full` has all of it."""
    with pytest.MonkeyPatch.context() as patch:
        if "not full" in request.config.getoption("markexpr"):
            patch.setattr(native, "FLAGS", ["-O1" if flag == "-O3" else flag for flag in native.FLAGS])
        yield
