"""Runs that cannot fit, and where compiled programs are kept."""

from __future__ import annotations

import pathlib
from types import SimpleNamespace
from typing import Any

import jax
import pytest

from pmt_jax.training import compile, trainer
from runs import ARGUMENTS, STEPS


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (("--num-envs", "1e4"), "a batch of num_envs * rollout_length = 10000 * 25 steps needs at least"),
        (("--hidden", "10000,10000"), "networks with hidden = [10000, 10000] needs at least"),
        (("--seeds", "1e6"), "for 1000000 seed(s), but there are 0 GB here; ask for less"),
    ],
)
def test_what_cannot_fit_is_refused(flags, says, cli, monkeypatch, tmp_path: pathlib.Path):
    monkeypatch.setattr(compile, "device_memory", lambda: 10e6)
    code, _, err = cli("train", "lane", "--steps", "1e6", *flags, "--out", tmp_path / "x")
    assert code == 2 and says in err and err.count("\n") == 1
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    "message", ["RESOURCE_EXHAUSTED: Out of memory while trying to allocate 5.71GiB", "INTERNAL: x"]
)
def test_a_device_without_room_gets_a_sentence(message: str, cli, monkeypatch, tmp_path: pathlib.Path):
    """A GPU that other programs share may have no room left although the run alone would fit."""

    def full(*_: object, **__: object) -> None:
        raise jax.errors.JaxRuntimeError(message)

    monkeypatch.setattr(trainer.Trainer, "train", full)
    arguments = ("train", *ARGUMENTS, "--steps", STEPS, "--out", tmp_path / "x")
    if message.startswith("INTERNAL"):
        with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
            cli(*arguments)
        return
    code, _, err = cli(*arguments)
    assert code == 2 and err.count("\n") == 1
    assert err.startswith("pmt: Out of memory while trying to allocate 5.71GiB; other programs may share the device")


@pytest.mark.parametrize(
    ("backend", "flags", "options"),
    [
        ("cpu", "", None),
        ("gpu", "", {"xla_gpu_autotune_level": "0"}),
        ("gpu", "--xla_gpu_autotune_level=4", None),
    ],
)
def test_xla_tries_out_no_kernels_on_a_gpu(backend: str, flags: str, options: Any, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setenv("XLA_FLAGS", flags)
    assert compile.xla_options() == options
    assert jax.jit(lambda x: x + 1).lower(1).compile(options)(1) == 2  # the name is one that XLA knows


@pytest.mark.parametrize("chosen", ["", "relative", None])
def test_a_cache_home_that_does_not_count(chosen: str | None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(compile, "jax", SimpleNamespace(config=None))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if chosen is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", chosen)
    assert compile.cache_folder() == pathlib.Path.home() / ".cache" / "pmt-jax"
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert compile.cache_folder() == pathlib.Path("/somewhere/pmt-jax")
