"""Shared by all tests: one persistent compile cache, CPU, and nothing else that a test could come to rely on."""

from __future__ import annotations

import importlib.metadata
import os
import pathlib
import platform

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's complaints about programs it takes from the cache

import jax
import pytest

# Tests compile far longer than they run: with the least of optimisation programs compile in a quarter of the time.
# Without fused multiply-adds, which XLA places as it happens to fuse, programs that compute the same agree bit for bit.
# XLA ends a process that names a flag it does not know, and the first two come and go with its versions.
_QUICK = {"0.9": "--xla_cpu_use_fusion_emitters=false", "0.12": "--xla_cpu_opt_preset=fast_compile"}
_MINOR = importlib.metadata.version("jaxlib").rpartition(".")[0]
_NO_FMA = "--xla_cpu_max_isa=AVX" if platform.machine() in ("x86_64", "AMD64") else ""
_FLAGS = ("--xla_backend_optimization_level=0", _QUICK.get(_MINOR, ""), _NO_FMA, os.environ.get("XLA_FLAGS", ""))
os.environ["XLA_FLAGS"] = " ".join(_FLAGS)

CACHE = pathlib.Path(__file__).parent.parent / ".cache" / "jax"
jax.config.update("jax_compilation_cache_dir", str(CACHE))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


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
