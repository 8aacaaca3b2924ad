"""Shared by all tests: one persistent compile cache, CPU, and nothing else that a test could come to rely on."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import functools
import gc
import importlib.metadata
import os
import pathlib
import platform
import shutil
import signal
import subprocess
from collections.abc import Callable
from typing import Any

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's complaints about programs it takes from the cache

import jax
import psutil
import pytest

# Tests compile far longer than they run: with the least of optimisation programs compile in a quarter of the time.
# Without fused multiply-adds, which XLA places as it happens to fuse, programs that compute the same agree bit for bit.
# A program in one part compiles with less work than one in 32 parts, which are for idle cores.
# XLA ends a process that names a flag it does not know, and those of _QUICK come and go with its versions.
_QUICK = {
    "0.9": "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1",
    "0.12": "--xla_cpu_opt_preset=fast_compile",
}
_MINOR = importlib.metadata.version("jaxlib").rpartition(".")[0]
_NO_FMA = "--xla_cpu_max_isa=AVX" if platform.machine() in ("x86_64", "AMD64") else ""
_FLAGS = ("--xla_backend_optimization_level=0", _QUICK.get(_MINOR, ""), _NO_FMA, os.environ.get("XLA_FLAGS", ""))
os.environ["XLA_FLAGS"] = " ".join(_FLAGS)

CACHE = pathlib.Path(__file__).parent.parent / ".cache" / "jax"
KEPT = {"jax_compilation_cache_dir": str(CACHE), "jax_persistent_cache_min_compile_time_secs": 0.1}
for name, setting in KEPT.items():
    jax.config.update(name, setting)
    os.environ[name.upper()] = str(setting)  # for processes that tests start


for number in (signal.SIGINT, signal.SIGHUP):  # ignored where tests run in the background or under nohup
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)


gc.set_threshold(100_000)  # as `pmt` has it: traces make many objects that stay
MOST_MEMORY = 2e9  # bytes of a process of the tests, beyond which it forgets what it compiled


def pytest_configure(config: pytest.Config) -> None:
    """With less optimisation C++ compiles in half the time; tests/envs/physics/test_fused.py has all of it."""
    compiler = next(filter(shutil.which, ("c++", "g++", "clang++")), None)
    if compiler:
        os.environ.setdefault("CXX", f"{compiler} -O1")  # for processes that tests start, too


@functools.cache
def context_of_programs(make: Callable[[], Any]) -> Any:
    return make()


@pytest.fixture(autouse=True, scope="session")
def programs_have_one_context():
    """JAX loads the dialects of MLIR anew for every program, which takes longer than to lower a small one."""
    try:
        from jax._src.interpreters import mlir

        make = mlir.make_ir_context
    except (ImportError, AttributeError):  # private, so JAX may move it; then tests take longer
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mlir, "make_ir_context", lambda: context_of_programs(make))
        yield


@pytest.fixture(autouse=True, scope="module")
def memory_is_bounded():
    """After a file JAX forgets what it has compiled if that is much, and the memory is freed; `runs` keeps its own."""
    yield
    if psutil.Process().memory_info().rss > MOST_MEMORY:
        jax.clear_caches()
        context_of_programs.cache_clear()
        gc.collect()
        with contextlib.suppress(AttributeError):  # of glibc
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(autouse=True, scope="module")
def tasks_step_in_c(request: pytest.FixtureRequest):
    """By default tasks take MuJoCo's own engine, for `fused` compiles seconds for each.

    `-m full` and tests of engines have the order that users have.
    """
    with pytest.MonkeyPatch.context() as patch:
        if "not full" in request.config.getoption("markexpr") and "physics" not in request.path.parts:
            from envs.physics import contract

            first = ("mujoco", *(name for name in contract._PREFERENCE if name != "mujoco"))
            patch.setattr(contract, "_PREFERENCE", first)
        yield


@pytest.fixture(autouse=True, scope="session")
def state_of_the_user(tmp_path_factory: pytest.TempPathFactory):
    """What `pmt` remembers for its user goes into a folder of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(autouse=True, scope="session")
def cache_of_the_user():
    """What is compiled for `fused` is kept where JAX's programs are: for all processes of the tests, and the next time.

    Its key has all that it is made of, so nothing stale is found.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(CACHE.parent))
        yield


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]):
    """Runs a command line in this process: (exit code, stdout, stderr)."""
    from pmt_jax.cli import main

    def run(*argv: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main([str(a) for a in argv])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def quick_doctor(monkeypatch: pytest.MonkeyPatch):
    """A doctor that starts no processes of its own."""
    from pmt_jax.cli import doctor

    monkeypatch.setattr(doctor, "check_rendering", lambda: iter(()))
    monkeypatch.setattr(doctor, "check_cache", lambda: doctor.Finding("ok", "compile cache", ""))


@pytest.fixture(scope="session", autouse=True)
def programs_are_shared():
    """Training and evaluations compile a program once a process (see `runs`)."""
    from pmt_jax.policies import evaluate
    from pmt_jax.training import compile, trainer
    from runs import compile_once, evaluate_once

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "compile_run", compile_once)
        for module in (compile, evaluate):
            patch.setattr(module, "evaluate_seeds", evaluate_once)
        yield


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The run of `runs.ARGUMENTS` that nothing befell, with the checkpoints of its last two chunks.

    The first process that asks for it trains it, all others wait. Nobody changes it.
    """
    from pmt_jax.cli import main
    from pmt_jax.training import loop
    from runs import ARGUMENTS, STEPS

    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    out, making = base / "whole", base / "whole-unfinished"
    with (base / "whole.lock").open("w") as lock, pytest.MonkeyPatch.context() as patch:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not out.exists():
            patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
            assert main([str(a) for a in ("train", *ARGUMENTS, "--steps", STEPS, "--out", making)]) == 0
            making.rename(out)
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
