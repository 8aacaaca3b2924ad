"""What the command line tells before anything runs: help, the list of tasks, and how results are printed."""

from __future__ import annotations

import ast
import dataclasses
import math
import re
import subprocess
import sys
import tomllib
from importlib import metadata

import pytest

from envs.physics import contract
from paths import ROOT
from pmt_jax import tasks
from pmt_jax.cli import commands, doctor, policies
from pmt_jax.config.fields import GROUPS
from pmt_jax.config.settings import Config
from pmt_jax.render import gl


def test_help_and_lists_need_no_jax():
    code = "import sys; from pmt_jax.cli import main\n"
    code += "for argv in (['--help'], ['train', 'lane', '--help'], ['envs']): assert main(argv) == 0\n"
    code += "assert not {'jax', 'mujoco', 'numpy'} & set(sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "train" in result.stdout and "eval" in result.stdout


def test_help_of_train_has_groups_and_explains_presets(cli, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = cli("train", "--help", "all")
    assert code == 0
    at = [out.index(f"\n{group}:\n") for group in GROUPS]
    assert at == sorted(at) and out.index("--method") < out.index("--num-envs") < out.index("--lambda-lr")
    words = " ".join(out.split())
    assert "how far costs of twice the limit in every update" in words
    assert "bit for bit, but not on the engine warp, which auto takes" in words  # as docs/howto/train.md says
    assert "smoke: tiny networks" in words and "reference: what the published baselines' code does" in words


def test_help_names_every_engine(cli, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    for words in (("train", "--help"), ("eval", "--help")):
        text = cli(*words)[1]
        assert all(f" {engine}" in text for engine in ("auto", *contract.ENGINES))


def test_help_shows_what_most_people_set_and_where_the_rest_is(cli):
    """Twelve settings and no heading above nothing; all of them with `all`, before a task or after it."""
    named = {"method", "steps", "seeds", "seed", "num-envs", "rollout-length", "hidden", "actor-lr"}
    named |= {"cost-limit", "cost-margin", "physics", "env"}
    every = {field.name.replace("_", "-") for field in dataclasses.fields(Config)} - {"task"}
    for words, shown in (
        (("--help",), named),
        (("lane", "-h"), named),
        (("--help", "all"), every),
        (("--help", "all", "lane"), every),
        (("lane", "--seed", 1, "--help", "all"), every),
    ):
        code, out, err = cli("train", *words)
        assert code == 0 and not err
        assert set(re.findall(r"^  --([a-z0-9-]+)", out, re.MULTILINE)) & every == shown
        assert ("more settings: --help all" in out) == (shown == named)
        assert not re.search(r"^\S.*:\n(  \w.*\n)?\n?(?=^\S)", out.partition("options:")[2], re.MULTILINE)


def test_help_after_a_task_shows_its_own_defaults(cli):
    def default(setting: str, *argv: str) -> str:
        words = " ".join(cli("train", *argv)[1].split())
        return words[words.index(f"--{setting} ") :].split("default ")[1].split("]")[0]

    assert default("actor-lr", "--help") == "0.0003"
    assert default("actor-lr", "ant_2x4", "--help") == default("actor-lr", "--help", "ant_2x4") == "0.0007"
    assert default("env", "ant_2x4", "-h") == "observation=raw"
    assert default("hidden", "ant_2x4", "--preset", "smoke", "--help") == "16"
    assert cli("train", "ant2x4", "--help")[0] == 2


def test_every_command_has_help(cli):
    for name in commands.make_parser()[1]:
        code, out, _ = cli(name, "--help")
        assert code == 0 and out.startswith(f"usage: pmt {name}")


def test_envs_lists_and_describes(cli):
    _, out, _ = cli("envs")
    assert "lane " in out and "2 agents of 2 actions, 25 steps, limit 1" in out
    code, out, _ = cli("envs", "lane")
    assert code == 0
    for words in (
        "2, with 2 action entries each",
        "limit 1 an episode",
        "25 control steps",
        "plain JAX",
        "num_agents=2",
    ):
        assert words in out
    assert "unknown task 'lan'; did you mean 'lane'?" in cli("envs", "lan")[2]
    swimmer = cli("envs", "velocity_swimmer_2x1")[1]  # what its configuration asks for, and no fixed option
    assert "observation=raw" in swimmer and "threshold: " in swimmer and "variant" not in swimmer


def test_one_episode_has_no_interval_and_long_names_keep_columns(capsys):
    name = "info/a_name_that_is_longer_than_most_of_the_others"
    limits = {"cost_limit": 3.5, "cost_limit/0": 1.0, "cost_limit/1": 2.5}
    policies.say_row({"seed": 0, "step": 1000, **limits, "reward": (1.0, math.nan), name: (2.0, 0.5)})
    head, reward, longest = capsys.readouterr().out.splitlines()
    assert head == "seed 0 after 1,000 steps (cost limit 1 + 2.5 an episode)"
    assert reward.endswith("1.0000") and longest.endswith("2.0000 +- 0.5000")
    assert reward.index("1.0000") == longest.index("2.0000")


# ---------------------------------------------------------------------------------------------------------------------
# `pmt doctor`: what of the machine can be used


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
