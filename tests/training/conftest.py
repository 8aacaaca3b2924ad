"""One trained run for all tests of training."""

from __future__ import annotations

import pathlib
import shutil
import subprocess

import pytest
from runs import ARGUMENTS, STEPS

from pmt_jax.training import trainer


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A run of two seeds that nothing befell, with the checkpoints of its last two chunks."""
    from pmt_jax.cli import main

    out = tmp_path_factory.mktemp("runs") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "CHECKPOINT_SECONDS", 0.0)
        assert main([str(a) for a in ("train", *ARGUMENTS, "--steps", STEPS, "--out", out)]) == 0
    return out


@pytest.fixture
def copy(whole: pathlib.Path, tmp_path: pathlib.Path) -> pathlib.Path:
    """A copy of that run, to be damaged."""
    return pathlib.Path(shutil.copytree(whole, tmp_path / "copy"))


@pytest.fixture
def small_disk(tmp_path: pathlib.Path):
    """A file system of 160 kB, room for two checkpoints, and a function that mounts it anew with other options."""
    place = tmp_path / "disk"
    place.mkdir()

    def mount(options: str) -> bool:
        command = ["mount", "-t", "tmpfs", "-o", options, "none", str(place)]
        return subprocess.run(command, capture_output=True).returncode == 0

    if not shutil.which("mount") or not mount("size=160k"):
        pytest.skip("may not mount a file system here")
    yield place, lambda options: mount(f"remount,{options}")
    subprocess.run(["umount", "-l", str(place)], check=True)
