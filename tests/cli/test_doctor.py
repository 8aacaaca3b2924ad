"""`pmt doctor`: what of the machine can be used."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib import metadata

import pytest

from envs.physics import contract
from paths import ROOT
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
    monkeypatch.setattr(doctor, "check_cache", lambda: doctor.Finding("ok", "compile cache", ""))
    monkeypatch.setattr(gl, "PROBE", "raise SystemExit('no such library')")
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


def test_what_is_imported_is_a_dependency_or_of_an_extra():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    stated = {name[0].lower() for line in project["dependencies"] if (name := re.match(r"[\w-]+", line))}
    assert {"pillow", "matplotlib"} <= stated
    trees = [ast.parse(file.read_text()) for folder in ("pmt_jax", "envs") for file in (ROOT / folder).rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    found = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    found |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level}
    foreign = {name.split(".")[0] for name in found} - set(sys.stdlib_module_names) - {"pmt_jax", "envs"}
    of = metadata.packages_distributions()
    of = {"warp": ["warp-lang"], **of}  # the only one that need not be here and is named otherwise
    packages = {name: {p.lower().replace("_", "-") for p in of.get(name, [name])} for name in foreign}
    extras = {name.lower() for name in doctor.EXTRAS} | {"pandapower", "pandas"}
    assert not [name for name, of in packages.items() if not of & (stated | extras)]
