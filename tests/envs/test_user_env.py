"""A task of the user's own, given as a Python file: trained, resumed, evaluated, or refused in one sentence."""

from __future__ import annotations

import json
import pathlib
import pickle
import sys

import pytest

import envs
from envs.base import EnvSpec
from paths import ROOT
from pmt_jax import load_config

EXAMPLE = ROOT / "docs" / "examples" / "my_env.py"
TINY = (
    "--method",
    "happo",
    "--num-envs",
    4,
    "--rollout-length",
    25,
    "--log-interval",
    2,
    "--hidden",
    8,
    "--minibatches",
    1,
)


def test_the_example_is_short():
    assert len(EXAMPLE.read_text().splitlines()) <= 60


def test_reading_a_file_leaves_nothing_beside_it(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)  # as on most machines
    file = tmp_path / "mine.py"
    file.write_text(EXAMPLE.read_text())
    assert envs.make(str(file)).spec.num_agents > 0
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.full
def test_train_resume_and_evaluate_the_example(tmp_path: pathlib.Path, cli, monkeypatch):
    out = tmp_path / "run"
    monkeypatch.chdir(EXAMPLE.parent)
    assert cli("train", EXAMPLE.name, *TINY, "--steps", 200, "--out", out, "--no-cache")[0] == 0
    assert load_config(out / "config.toml").task == str(EXAMPLE)  # found again from anywhere
    monkeypatch.chdir(tmp_path)
    command = ("train", out / "config.toml", "--out", out, "--resume", "--steps", 400, "--no-cache")
    assert cli(*command)[0] == 0
    rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [(row["step"], row["task"]) for row in rows] == [(200, "pole"), (400, "pole")]
    assert "info/tilt" in rows[-1]
    code, text, _ = cli("eval", out, "--episodes", 4, "--trust")
    assert code == 0 and "info/tilt" in text


@pytest.mark.full
def test_training_stops_where_the_physics_lost_contacts(tmp_path: pathlib.Path, cli):
    """As `warp` says it did where its buffers were too small; here from the fourth control step on."""
    (tmp_path / "lossy.py").write_text(
        "import dataclasses\nfrom envs.toys import Lane\n\nclass Lossy(Lane):\n    def __init__(self):\n"
        "        super().__init__()\n"
        "        self.declares = dataclasses.replace(self.declares, overflow='physics_overflow')\n"
        "    def restore(self, **raw):\n        return self._said(super().restore(**raw))\n"
        "    def step(self, state, action):\n        return self._said(super().step(state, action))\n"
        "    def _said(self, state):\n        lost = (state.carry.time >= 4).astype('float32')\n"
        "        return dataclasses.replace(state, info={**state.info, 'physics_overflow': lost})\n"
    )
    source, out = tmp_path / "lossy.py:Lossy", tmp_path / "run"
    code, text, _ = cli("train", source, *TINY, "--rollout-length", 3, "--log-interval", 1, "--steps", 36, "--out", out)
    assert code == 1 and "stopped: the warp engine had no room for all contacts" in text and "up to step 24" in text
    rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [row["info/physics_overflow"] for row in rows] == [0.0, 1.0]  # what broke the run is on record


GOOD = EXAMPLE.read_text()


@pytest.mark.parametrize(
    ("text", "name", "says"),
    [
        (None, "", "there is no environment file"),
        ("import nothing_of_that_name", "", "cannot be imported: ModuleNotFoundError: No module named 'nothing_of"),
        ("x = (", "", "cannot be imported: SyntaxError: '(' was never closed (env.py, line 1)\n"),
        ("x = 1", "", "should hold one class with reset and step (see envs/base.py), but holds none"),
        (GOOD + "\n\nclass Other(Pole):\n    pass\n", "", "holds several (Pole, Other); choose one, as env.py:Pole"),
        (GOOD, ":Pol", "has no class or function 'Pol'; did you mean 'Pole'?"),
        (GOOD.replace('engine = "xla"', "pass"), "", "it has no engine"),
        (GOOD.replace('"xla"', '"mujco"'), "", "unknown engine 'mujco'; did you mean 'mujoco'?"),
        (GOOD.replace('"xla"', '"gpu"'), "", "unknown engine 'gpu'; known: xla, fused, mjx, mujoco, warp"),
        (GOOD.replace('"xla"', '"mujoco"'), "", "it has engine = 'mujoco', but no step calls an engine; a task that"),
        (GOOD.replace("obs_dim=3", "obs_dim=4"), "", "reset gives obs of shape (2, 3), but its spec says (2, 4)"),
        (GOOD.replace("> 2.0, ", ", "), "", "terminated must be a bool, not float32"),
        (
            GOOD.replace("carry=ends", "carry=ends if isinstance(cost, float) else ends[:1]"),
            "",
            "step must keep what reset made, but .carry was",
        ),
        (
            GOOD.replace("return State(", "return dict("),
            "",
            "reset must return a State of envs/base.py, but its dict has no obs",
        ),
        (
            GOOD.replace("np.ones((NUM_AGENTS, 1)", "np.ones((NUM_AGENTS, 2)"),
            "",
            "spec.action_mask must hold 0 and 1 in",
        ),
        (
            GOOD.replace("cost_limit=2.0", "cost_limit='2'"),
            "",
            "spec.cost_limit must be a number of at least 0, or a tuple of 1 of them, not '2'",
        ),
        (
            GOOD.replace("cost_limit=2.0", "cost_limit=-2"),
            "",
            "spec.cost_limit must be a number of at least 0, or a tuple of 1 of them, not -2",
        ),
        (GOOD.replace("horizon=50", "horizon=0"), "", "spec.horizon must be a whole number of at least 1, not 0"),
        (GOOD.replace("horizon=50", "horizon=-3"), "", "a whole number of at least 1, not -3 (env.py, line "),
        (GOOD.replace('name="pole"', 'name="../pole"'), "", "spec.name names folders: letters, digits"),
        (
            GOOD.replace('"tilt": jnp.abs(ends[0] - ends[1])', '"tilt": ends'),
            "",
            "info holds scalars, but 'tilt' has shape",
        ),
        (GOOD.replace("cost=0.0", "cost=1.5"), "", "costs must be within [0, 1], but the first steps give 1.5"),
        (GOOD.replace("cost=tilt > 0.3", "cost=-1.0"), "", "costs must be within [0, 1], but the first steps give -1"),
        (GOOD.replace("reward=speed", "reward=speed / 0"), "", "reward is not finite after step 1"),
        (
            GOOD.replace("carry=ends", "carry=(ends, jnp.full(2, jnp.inf))").replace("state.carry", "state.carry[0]"),
            "",
            "carry[1] is not finite after reset",
        ),
        (GOOD.replace("reward, jnp.float32", "reward, int"), "", "reward must be floating, not int32; add .astype("),
        (GOOD.replace("cost, jnp.float32", "cost, bool"), "", "cost must be floating, not bool; add .astype(float)"),
        (
            GOOD.replace("ends**2", "endz**2"),
            ":Pole",
            "step fails: NameError: name 'endz' is not defined (env.py, line ",
        ),
    ],
)
def test_files_that_cannot_be_used(text: str | None, name: str, says: str, tmp_path: pathlib.Path, cli):
    file = tmp_path / "env.py"
    if text is not None:
        file.write_text(text)
    code, out, err = cli("train", f"{file}{name}", "--out", tmp_path / "run")
    assert code == 2 and says in err and err.count("\n") == 1 and not out
    assert not (tmp_path / "run").exists()


def test_a_factory_takes_options(tmp_path: pathlib.Path):
    file = tmp_path / "env.py"
    file.write_text(GOOD + "\n\ndef wide(engine='xla'):\n    env = Pole()\n    env.engine = engine\n    return env\n")
    assert envs.make(f"{file}:wide", engine="mjx").engine == "mjx"
    with pytest.raises(envs.TaskError, match="has no option 'engin'; did you mean 'engine'"):
        envs.make(f"{file}:wide", engin="mjx")
    file.write_text(
        GOOD + "\n\ndef scaled(scale=1.0, **options):\n    env = Pole()\n    env.given = options\n    return env\n"
    )
    assert envs.task_options(f"{file}:scaled") == {"scale": 1.0}
    assert envs.make(f"{file}:scaled", colour=3, physics="mjx").given == {"colour": 3, "physics": "mjx"}


def test_files_of_one_name_are_two_modules(tmp_path: pathlib.Path):
    made = []
    for folder in ("first", "second"):
        file = tmp_path / folder / "pole.py"
        file.parent.mkdir()
        file.write_text(GOOD)
        made.append(envs.make(str(file)))
    for env in made:
        assert isinstance(pickle.loads(pickle.dumps(env)), type(env))


def test_a_mask_may_be_a_list():
    spec = EnvSpec("mine", 2, 3, 1, 3, 1, 10, [[1.0], [1.0]], 1.0)  # pyright: ignore[reportArgumentType]
    assert spec.action_mask.shape == (2, 1)
