"""However often a run is killed, what it had finished is kept, and in the end it is the run that nobody killed."""

from __future__ import annotations

import pathlib
import random
import shutil
import subprocess

import pytest

import soak
from runs import assert_same_run

LONG = 6000  # 30 rows, each with a checkpoint: two seconds


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    out = tmp_path_factory.mktemp("soak") / "unbroken"
    session = soak.Session(out, LONG)
    assert session.process.wait(300) == 0, session.text
    return out


@pytest.fixture
def disk(tmp_path: pathlib.Path):
    """A small file system that can be filled; a folder where that is not allowed."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "none", str(place)]
    mounted = bool(shutil.which("mount")) and subprocess.run(mount, capture_output=True).returncode == 0
    yield place, mounted
    if mounted:
        subprocess.run(["umount", "-l", str(place)], check=True)


def kill(unbroken: pathlib.Path, steps: int, disk: tuple[pathlib.Path, bool], times: int, seed: int) -> None:
    """Kills runs, one after the other, until `times` ends are met; each is then the unbroken one."""
    place, mounted = disk
    chance = random.Random(seed)
    kinds = [kind for kind in soak.KINDS if mounted or kind != "full disk"]
    met = 0
    while met < times:
        out = place / f"run{met}"
        planned = [kinds[(seed + met + i) % len(kinds)] for i in range(min(len(kinds), times - met))]
        met += soak.soak(out, steps, place, planned, chance)
        assert_same_run(out, unbroken)
        shutil.rmtree(out)


@pytest.mark.timeout(3600)  # on a loaded machine
@pytest.mark.parametrize(
    "seed", [pytest.param(i, marks=pytest.mark.slow if i else pytest.mark.full) for i in range(20)]
)
def test_killed_in_every_way(unbroken: pathlib.Path, disk: tuple[pathlib.Path, bool], seed: int):
    """First with one signal of those that a run answers alike (test_resume.py and test_signals.py have all)."""
    kill(unbroken, LONG, disk, times=10 if seed else 4, seed=seed)
