"""What compiled code needs on the machine that runs the tests."""

from __future__ import annotations

import pytest

from envs import native

compiled = pytest.mark.skipif(native.obstacle("fused") is not None, reason="no C++ compiler here")


@pytest.fixture(autouse=True, scope="package")
def quick_compiler(request: pytest.FixtureRequest):
    """With less optimisation `fused` compiles in half the time; `-m full` has all of it. For conftests to import."""
    with pytest.MonkeyPatch.context() as patch:
        if "not full" in request.config.getoption("markexpr"):
            patch.setattr(native, "_FLAGS", ["-O1" if flag == "-O3" else flag for flag in native._FLAGS])
        yield
