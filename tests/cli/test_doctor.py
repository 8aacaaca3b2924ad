"""`pmt doctor`: what of the machine can be used."""

from __future__ import annotations

import re
import tomllib

import pytest

from envs.physics import contract
from places import ROOT
from pmt_jax import tasks
from pmt_jax.cli import doctor
from pmt_jax.render import gl


def test_doctor(cli):
    code, out, _ = cli("doctor")
    assert code == 0 and out.endswith("pmt can train here\n")
    for words in ("engine mujoco", "physics = auto takes", "needs an NVIDIA GPU"):
        assert words in out
    for part in ("mujoco-mjx", "devices", "compile cache", "GL egl", "wandb"):
        assert re.search(rf"^(ok|no) +{part} ", out, re.MULTILINE)


def test_what_is_wrong(cli, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "_cache", lambda: doctor.Finding("ok", "compile cache", ""))
    monkeypatch.setattr(gl, "_PROBE", "raise SystemExit('no such library')")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    installed = tasks.installed_version
    monkeypatch.setattr(contract, "installed_version", lambda name: "4.0.0" if name == "mujoco" else installed(name))
    monkeypatch.setattr(tasks, "installed_version", lambda name: None if name == "optax" else installed(name))
    code, out, _ = cli("doctor")
    assert code == 1 and out.endswith("2 problem(s): see the lines marked bad\n")
    assert "found mujoco 4.0.0, mujoco-mjx 3.17" in out and re.search("^bad +optax +missing", out, re.MULTILINE)
    assert re.search("^no +GL (egl|cgl|glfw) +no such library", out, re.MULTILINE)


def test_optional_packages_are_those_of_the_extras():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for package, extra in doctor.EXTRAS.items():
        assert any(re.match(rf"{package}\b", line) for line in extras[extra]) or package == "warp-lang", package
