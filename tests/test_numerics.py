"""Every setting of JAX changes no number of a run, is refused in a sentence, or is recorded and compared on resume."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import jax
import pytest

from pmt_jax import load_config, make_train, numerics
from pmt_jax.cli import doctor, process
from pmt_jax.errors import UsageError
from runs import STEPS, TINY, environment

BAD = {
    "jax_enable_x64": True,
    "jax_disable_jit": True,
    "jax_no_tracing": True,
    "jax_no_execution": True,
    "jax_numpy_dtype_promotion": "strict",
    "jax_numpy_rank_promotion": "raise",
    "jax_use_simplified_jaxpr_constants": True,
    "jax_debug_nans": True,
    "jax_debug_infs": True,
    "jax_debug_key_reuse": True,
    "jax_transfer_guard": "disallow",
    "jax_transfer_guard_host_to_device": "disallow_explicit",
    "jax_transfer_guard_device_to_host": "disallow",
    "jax_transfer_guard_device_to_device": "disallow",
    "jax_error_checking_behavior_nan": "raise",
    "jax_error_checking_behavior_oob": "raise",
    "jax_error_checking_behavior_divide": "raise",
}
BAD = {name: value for name, value in BAD.items() if name in jax.config.values}  # some come and go with JAX's versions
COMMANDS = (
    ("train", "lane", "--steps", 8000),
    ("sweep", "lane", "--set", "clip=0.1,0.2", "--out", "swept"),
    ("reproduce", "table1"),
    ("eval", "hub:ant_2x4/mappo"),
    ("eval", "voltage_33", "--policy", "zero"),
    ("export", "hub:ant_2x4/mappo", "-o", "policy"),
    ("render", "hub:ant_2x4/mappo", "-o", "x.html"),
    ("report", "run", "-o", "x.html"),
    ("envs", "lane"),
)


@contextlib.contextmanager
def setting(name: str, value: Any) -> Iterator[None]:
    """JAX with another setting, as its variable would make it."""
    before = jax.config.values[name]
    jax.config.update(name, value)
    try:
        yield
    finally:
        jax.config.update(name, before)


def sentence(cli: Any, *command: object) -> str:
    """What a command that is refused says."""
    code, out, err = cli(*command)
    assert code == 2 and err.startswith("pmt: ") and err.count("\n") == 1, (command, code, err)
    assert "Traceback" not in out
    return err.removeprefix("pmt: ").strip()


@pytest.mark.parametrize("name", BAD)
def test_what_programs_cannot_run_with_is_refused_before_anything_is_compiled(
    name: str, tmp_path: pathlib.Path, cli, monkeypatch, quick_doctor
):
    monkeypatch.chdir(tmp_path)
    with setting(name, BAD[name]):
        said = sentence(cli, *COMMANDS[0])
        code, out, _ = cli("doctor")
        with pytest.raises(UsageError, match=name.upper()):
            make_train(load_config("lane"))
    assert said.startswith(f"with {name.upper()}=") and said.endswith("; unset it")
    assert ("--debug" in said) == (name in ("jax_debug_nans", "jax_debug_infs"))
    assert code == 1 and f"settings of JAX     {said}" in out and "1 problem(s)" in out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: " ".join(map(str, command[:2])))
def test_every_command_that_compiles_says_so(command: tuple[object, ...], tmp_path: pathlib.Path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with setting("jax_enable_x64", True):
        assert sentence(cli, *command).startswith("with JAX_ENABLE_X64=1 nothing can be trained or evaluated")
    monkeypatch.setattr(jax, "devices", lambda: (_ for _ in ()).throw(AssertionError()))
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    said = "JAX finds no device with JAX_PLATFORMS=cuda; unset JAX_PLATFORMS, or name a platform that is here"
    assert sentence(cli, *command) == said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("variable", "command", "says"),
    [
        ("JAX_PLATFORMS=bogus", "train lane", "JAX finds no device with JAX_PLATFORMS=bogus: Unable to initialize"),
        pytest.param(
            "JAX_ENABLE_X64=1",
            "eval hub:ant_2x4/mappo",
            "with JAX_ENABLE_X64=1 nothing can be trained or evaluated",
            marks=pytest.mark.full,
        ),
        pytest.param(
            "JAX_DEBUG_NANS=true",
            "train lane",
            "--debug stops training at the first number that is not finite",
            marks=pytest.mark.full,
        ),
        ("JAX_ENABLE_X64=maybe", "hub", "JAX cannot start: invalid truth value 'maybe'"),
        pytest.param(
            "JAX_NUMPY_DTYPE_PROMOTION=much", "train lane", "JAX cannot start: Invalid value", marks=pytest.mark.full
        ),
        ("XLA_FLAGS=--xla_no_such_flag", "train lane", "Unknown flag in XLA_FLAGS: --xla_no_such_flag; correct"),
        pytest.param(
            "XLA_FLAGS=no_such_file", "envs lane", 'Could not open file "no_such_file"', marks=pytest.mark.full
        ),
        pytest.param(
            "XLA_FLAGS=--xla_backend_optimization_level=x",
            "envs lane",
            "a value does not fit its flag; correct",
            marks=pytest.mark.full,
        ),
    ],
)
def test_variables_that_a_process_starts_with(variable: str, command: str, says: str, tmp_path: pathlib.Path):
    name, _, value = variable.partition("=")
    code = "import sys; from pmt_jax.cli import run; run(sys.argv[1:])"
    started = subprocess.run(
        [sys.executable, "-c", code, *command.split()],
        env=environment() | {name: value},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert started.returncode == 2 and says in started.stderr and started.stderr.count("\n") == 1, started.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("flags", [None, "--xla_no_such_flag"])
def test_doctor_says_what_xla_does_not_take(flags: str | None, cli, monkeypatch, quick_doctor):
    if flags:
        monkeypatch.setenv("XLA_FLAGS", flags)
    code, out, _ = cli("doctor")
    assert (code == 1) == ("bad settings of JAX     XLA does not take XLA_FLAGS" in out) == (flags is not None)


@pytest.mark.parametrize("error", [RuntimeError("No such platform.\nMore."), AssertionError()])
def test_doctor_says_that_there_is_no_device(error: Exception, cli, monkeypatch, quick_doctor):
    monkeypatch.setattr(jax, "devices", lambda: (_ for _ in ()).throw(error))
    monkeypatch.setattr(doctor, "check_engines", lambda: iter(()))
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    code, out, _ = cli("doctor")
    assert code == 1 and "devices             JAX finds no device with JAX_PLATFORMS=cuda" in out
    assert ("No such platform;" in out) == bool(str(error))


def test_a_system_without_locks_trains_nothing_and_doctor_says_so(cli, monkeypatch, quick_doctor, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "fcntl", None)
    said = process.system_obstacle()
    assert said and "fcntl" in said
    code, out, _ = cli("doctor")
    assert code == 1 and f"operating system    {said}" in out
    for command in COMMANDS[:3]:
        assert sentence(cli, *command) == said
    assert not list(tmp_path.iterdir())


@pytest.mark.full
def test_a_process_without_locks_starts_and_evaluates():
    """Nothing but training imports them."""
    code = (
        "import sys; sys.modules['fcntl'] = None; from pmt_jax.cli import run\n"
        "import pmt_jax.policies.evaluate, pmt_jax.policies.export, pmt_jax.render.film, pmt_jax.render.report\n"
        "run(['train', 'lane'])"
    )
    done = subprocess.run([sys.executable, "-c", code], env=environment(), capture_output=True, text=True)
    assert done.returncode == 2 and "fcntl" in done.stderr.splitlines()[-1]  # JAX may have warned of its cache before
    assert "Traceback" not in done.stderr


# ---------------------------------------------------------------------------------------------------------------------
# What is recorded


def test_the_settings_that_are_named_are_jax_s():
    """A name that JAX does not have would never be found."""
    known = jax.config.values.keys()
    assert known >= set(numerics.DRAWS) and numerics.REFUSED.keys() >= BAD.keys()
    if jax.__version__.startswith("0.9."):  # others lack some of them
        assert known >= {*numerics.RECORDED, *numerics.REFUSED} and numerics.REFUSED.keys() == BAD.keys()
    assert not [name for name in (*numerics.RECORDED, *numerics.DRAWS) if numerics.HARMLESS.fullmatch(name)]
    assert not set(numerics.RECORDED) & numerics.REFUSED.keys()


@pytest.mark.parametrize("name", sorted(jax.config.values))
def test_each_variable_is_of_one_kind(name: str, monkeypatch: pytest.MonkeyPatch):
    """None that is set goes by in silence: what is not known to be harmless is recorded as it is."""
    before = numerics.record()
    monkeypatch.setenv(name.upper(), "other")
    recorded = numerics.record()["variables"].get(name.upper()) == "other"
    kinds = [bool(numerics.HARMLESS.fullmatch(name)), name in numerics.RECORDED, recorded]
    if name in numerics.REFUSED:  # the values that are not refused change nothing
        assert not recorded
    else:
        assert sum(kinds) == 1
    assert numerics.record()["jax_settings"] == before["jax_settings"]


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("jax_default_prng_impl", "rbg"),
        ("jax_threefry_partitionable", False),
        ("jax_random_seed_offset", 3),
        ("jax_high_dynamic_range_gumbel", True),
    ],
)
def test_other_random_numbers_are_recorded_and_do_not_continue_a_run(name: str, other: Any, copy: pathlib.Path, cli):
    versions = json.loads((copy / "versions.json").read_text())
    with setting(name, other):
        assert numerics.record()["jax_settings"][name] == other != versions["jax_settings"][name]
        said = sentence(cli, "train", copy / "config.toml", "--out", copy, "--resume", "--steps", STEPS + 200)
    assert f"the run in {copy} draws its random numbers with {name.upper()}=" in said and "choose another --out" in said
    assert json.loads((copy / "versions.json").read_text()) == versions


@pytest.mark.parametrize("part", ["jax_settings", "variables"])
def test_other_programs_are_noted_when_a_run_continues(part: str, copy: pathlib.Path, cli):
    versions = json.loads((copy / "versions.json").read_text())
    changed = {"jax_settings": {"jax_optimization_level": "O1"}, "variables": {"XLA_FLAGS": "--xla_x=1", "OLD": "2"}}
    versions[part] |= changed[part]
    (copy / "versions.json").write_text(json.dumps(versions))
    shutil.rmtree(copy / "checkpoints" / str(STEPS))
    code, text, _ = cli("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache")
    assert code == 0 and "the run may not continue bit for bit" in text
    notes = {
        "jax_settings": ("jax_optimization_level O1 -> ",),
        "variables": (f"XLA_FLAGS --xla_x=1 -> {os.environ['XLA_FLAGS']}", "OLD 2 -> unset"),
    }
    assert all(note in text for note in notes[part])
    assert json.loads((copy / "versions.json").read_text())[part] == numerics.record()[part]


def test_a_run_of_an_earlier_version_continues(copy: pathlib.Path, cli):
    versions = json.loads((copy / "versions.json").read_text())
    old = {name: x for name, x in versions.items() if name not in numerics.record()}
    (copy / "versions.json").write_text(json.dumps(old))
    shutil.rmtree(copy / "checkpoints" / str(STEPS))
    code, text, _ = cli("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache")
    assert code == 0 and "changed since" not in text


@pytest.mark.full
def test_a_run_of_other_keys_is_evaluated_without_them(tmp_path: pathlib.Path, cli):
    out, kind = tmp_path / "run", "rbg"
    arguments = ("train", "lane", *TINY, "--hidden", 3, "--method", "mappo", "--no-cache", "--out", out)
    with setting("jax_default_prng_impl", kind):
        assert cli(*arguments, "--steps", 200)[0] == 0
        assert cli(*arguments, "--steps", 400, "--resume")[0] == 0
        code, text, _ = cli("eval", out, "--episodes", 2, "--deterministic")
        assert code == 0 and "episode_reward" in text
    assert json.loads((out / "versions.json").read_text())["jax_settings"]["jax_default_prng_impl"] == kind
    code, text, _ = cli("eval", out, "--episodes", 2)
    assert code == 0 and "seed 0 after 400 steps" in text
    assert cli("export", out, "-o", tmp_path / "policy")[0] == 0
    assert f"JAX_DEFAULT_PRNG_IMPL={kind}, not threefry2x32" in sentence(cli, *arguments, "--steps", 600, "--resume")
    (out / "versions.json").unlink()  # of an earlier version, which recorded nothing
    assert "set JAX_DEFAULT_PRNG_IMPL to what the run was trained with" in sentence(cli, "eval", out)
    assert "set JAX_DEFAULT_PRNG_IMPL" in sentence(cli, *arguments, "--steps", 600, "--resume")
