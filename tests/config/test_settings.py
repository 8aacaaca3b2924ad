"""Settings: where they come from, what is refused and how."""

from __future__ import annotations

import dataclasses
import pathlib
import subprocess
import sys
import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
from paths import ROOT
from pmt_jax import METHODS, load_config
from pmt_jax.config import load
from pmt_jax.config.fields import GROUPS
from pmt_jax.config.load import to_toml
from pmt_jax.config.settings import Config
from pmt_jax.errors import UsageError


@pytest.mark.parametrize("task", envs.names())
@pytest.mark.parametrize("method", METHODS)
def test_every_task_has_a_configuration_for_every_method(task: str, method: str):
    config = load_config(task, method=method)
    assert (config.task, config.method) == (task, method)


def test_every_field_is_described():
    fields = dataclasses.fields(Config)
    assert all(field.metadata["help"] for field in fields)
    assert {field.metadata["group"] for field in fields} == set(GROUPS)


def test_a_method_that_a_file_names_takes_its_table_of_the_file_below(tmp_path: pathlib.Path):
    """And the options of a method's table lie over those that all methods share, one by one."""
    (tmp_path / "base.toml").write_text(
        'extends = "lane"\n[env]\nnum_agents = 3\n[method.f4sg]\nemotion_l2 = 7.0\n[method.f4sg.env]\nother = 2\n'
    )
    (tmp_path / "top.toml").write_text('extends = "base.toml"\nmethod = "f4sg"\n')
    config = load_config(tmp_path / "top.toml")
    assert (config.method, config.emotion_l2, dict(config.env)) == ("f4sg", 7.0, {"num_agents": 3, "other": 2})
    assert load_config(tmp_path / "top.toml", method="happo").emotion_l2 == 1.0
    (tmp_path / "over.toml").write_text('extends = "top.toml"\n[method.f4sg]\nclip = 0.1\n')
    config = load_config(tmp_path / "over.toml")
    assert (config.method, config.emotion_l2, config.clip) == ("f4sg", 7.0, 0.1)
    (tmp_path / "several.toml").write_text('extends = "base.toml"\nmethod = ["f4sg", "happo"]\n')
    with pytest.raises(UsageError, match="'method' must be a name"):
        load_config(tmp_path / "several.toml")


def test_precedence_is_defaults_file_method_table_overrides(tmp_path: pathlib.Path):
    path = tmp_path / "mine.toml"
    path.write_text('task = "lane"\nactor_lr = 1e-2\nclip = 0.3\n[method.happo]\nclip = 0.4\nepochs = 2\n')
    config = load_config(path, method="happo", epochs=3)
    assert (config.actor_lr, config.clip, config.epochs, config.critic_lr) == (1e-2, 0.4, 3, Config.critic_lr)
    assert load_config(path, method="mappo").clip == 0.3


@settings(max_examples=50, deadline=None)
@given(
    actor_lr=st.floats(0, 1),
    seeds=st.integers(1, 9),
    hidden=st.lists(st.integers(1, 512), min_size=1, max_size=4),
    layer_norm=st.booleans(),
    env=st.dictionaries(
        st.from_regex(r"[a-z]{1,8}", fullmatch=True),
        st.one_of(st.integers(-5, 5), st.booleans(), st.from_regex(r'[a-z"\\ ]{1,9}', fullmatch=True)),
    ),
)
def test_toml_round_trip(tmp_path_factory: pytest.TempPathFactory, **changes: object):
    changes["env"] = tuple(changes["env"].items())
    config = load_config("lane", **changes)
    path = tmp_path_factory.mktemp("toml") / "config.toml"
    path.write_text(to_toml(config))
    assert repr(load_config(path)) == repr(config)  # repr, because an open cost limit is nan


def test_words_of_a_command_line_become_typed():
    config = load_config("lane", steps="1e6", hidden="64,32", layer_norm="true", env=["num_agents=1"], clip=".1")
    assert (config.steps, config.hidden, config.layer_norm, config.clip) == (1_000_000, (64, 32), True, 0.1)
    assert config.env == (("num_agents", 1),)


@pytest.mark.parametrize("value", [2, 2.0, "2", [2], (2.0,), ["2"]])
def test_a_list_of_one_limit_is_that_limit(value: object):
    assert load_config("lane", cost_limit=value).cost_limit == 2.0


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"num_env": 3}, "unknown setting 'num_env'; did you mean 'num_envs'?"),
        ({"method": "mapo"}, "unknown method 'mapo'; did you mean 'mappo'?"),
        ({"preset": "smok"}, "unknown preset 'smok'; did you mean 'smoke'?"),
        ({"preset": 3}, "unknown preset '3'; known: default, smoke"),
        ({"preset": None}, "unknown preset 'None'"),
        ({"preset": ["smoke"]}, "unknown preset '['smoke']'"),
        ({"cost_limit": []}, "cost_limit = [] does not fit: expected a number, or one for each cost"),
        ({"cost_limit": [[1]]}, "cost_limit = [[1]] does not fit"),
        ({"method": 3}, "method = 3 does not fit: expected a word, as one of mappo, happo"),
        ({"method": ["mappo"]}, "method = ['mappo'] does not fit"),
        ({"steps": "many"}, "steps = 'many' does not fit: expected a whole number"),
        ({"steps": 1.5e4 + 0.5}, "expected a whole number"),
        ({"steps": -1}, "steps must be at least 1, not -1"),
        ({"steps": 10}, "less than one batch"),
        ({"minibatches": 7}, "cannot be cut into 7 equal minibatches"),
        ({"activation": "sine"}, "expected relu | tanh | elu"),
        ({"layer_norm": "maybe"}, "expected true or false"),
        ({"gamma": 1.5}, r"gamma must lie in [0, 1], not 1.5"),
        ({"actor_lr": -1}, "actor_lr must be a number that is not negative"),
        ({"actor_lr": float("nan")}, "actor_lr must be a number that is not negative"),
        ({"kl_max": 0}, "kl_max must be a number of nats above 0, or inf"),
        ({"lr_end": 0}, "lr_end must be a share above 0 and at most 1, not 0"),
        ({"lr_end": 1.5}, "lr_end must be a share above 0 and at most 1, not 1.5"),
        ({"cost_limit": -2}, "cost_limit must be a cost per episode of at least 0"),
        ({"hidden": ()}, "hidden must name at least one layer"),
        ({"seed": -1}, "seed must lie between"),
        ({"physics": "mujocco"}, "expected auto | fused | mjx | warp | mujoco"),
    ],
)
def test_bad_values_get_a_sentence(changes: dict[str, object], says: str):
    with pytest.raises(UsageError) as error:
        load_config("lane", **changes)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("task = ", "is not valid TOML"),
        ('task = "lane"\nmethods = 3', "unknown setting 'methods'; did you mean 'method'?"),
        ("[method.happpo]\nclip = 1", "unknown method 'happpo'; did you mean 'happo'?"),
        ('task = "lane"\n[method.f4sg]\nclpi = 1', "unknown setting 'clpi'; did you mean 'clip'?"),
        ('task = "lane"\n[method.happo]\nclip = "wide"', "clip = 'wide' does not fit: expected a number"),
        ("method = 3", "'method' must be a name, or [method.NAME] tables"),
    ],
)
def test_bad_files_get_a_sentence(tmp_path: pathlib.Path, text: str, says: str):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(UsageError) as error:
        load_config(path)
    assert says in str(error.value)


def test_settings_cannot_be_changed_in_place():
    with pytest.raises(dataclasses.FrozenInstanceError):
        load_config("lane").clip = 0.5  # pyright: ignore


def test_configuration_files_hold_no_code_and_no_other_task():
    names = {name for name in load.names() if not name.startswith("paper/")}
    assert names == set(envs.names())
    assert {name.removeprefix("paper/") for name in set(load.names()) - names} <= names
    assert all(p.suffix == ".toml" for p in load.CONFIG_DIR.rglob("*") if p.is_file())


def test_reading_settings_imports_neither_jax_nor_mujoco():
    code = "import pmt_jax, sys; pmt_jax.load_config('lane'); assert not {'jax', 'mujoco'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


# ---------------------------------------------------------------------------------------------------------------------
# Files of settings: what extends what, presets, and what of them is packaged


def write(folder: pathlib.Path, **files: str) -> pathlib.Path:
    """Writes NAME.toml for every keyword; returns the first one's path."""
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text)
    return folder / f"{next(iter(files))}.toml"


def test_a_file_extends_a_name_and_a_path(tmp_path: pathlib.Path):
    top = write(
        tmp_path,
        top='extends = "middle.toml"\nclip = 0.4\n[env]\nnum_agents = 3\n[method.happo]\nepochs = 7\n',
        middle='extends = "lane"\nclip = 0.3\nepochs = 6\n[method.happo]\nactor_lr = 0.5\n',
    )
    config = load_config(top, method="happo")
    assert (config.task, config.clip, config.epochs, config.actor_lr) == ("lane", 0.4, 7, 0.5)
    assert (config.env, config.lambda_lr) == ((("num_agents", 3),), load_config("lane").lambda_lr)
    assert load_config(top, method="mappo").epochs == 6


def test_a_file_called_like_a_task_is_not_the_task(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("lane").write_text('extends = "switch"\nclip = 0.4')  # and the package's switch extends its own lane
    assert (load_config("./lane").task, load_config("./lane").clip) == ("switch", 0.4)
    assert load_config("lane").task == "lane"


@pytest.mark.parametrize(
    ("base", "says"),
    [
        ('"top.toml"', "extends 'top.toml', which extends it in turn"),
        ('"around.toml"', "extends 'top.toml', which extends it in turn"),
        ('"lan"', "extends 'lan', which is not there; did you mean 'lane'?"),
        ('["lane"]', "'extends' must be one name"),
        ('"broken.toml"', "broken.toml is not valid TOML"),
    ],
)
def test_what_cannot_be_extended_gets_a_sentence(base: str, says: str, tmp_path: pathlib.Path):
    top = write(tmp_path, top=f"extends = {base}", around='extends = "top.toml"', broken="x = ")
    with pytest.raises(UsageError, match=r"^[^\n]*$") as error:
        load_config(top)
    assert says in str(error.value)


def test_a_preset_lies_over_the_file_and_under_the_flags(tmp_path: pathlib.Path):
    file = write(tmp_path, mine='extends = "lane"\ngae_lambda = 0.5\n[method.f4sg]\nfear_time = "next"\n')
    config = load_config(file, method="f4sg", preset="letter", lambda_kp=0.25)
    assert (config.gae_lambda, config.fear_time, config.lambda_kp) == (1.0, "current", 0.25)


def test_the_command_lines_options_join_those_of_the_file():
    assert load_config("ant_2x4", env=["threads=2"]).env == (("observation", "raw"), ("threads", 2))
    assert load_config("ant_2x4", env=["observation=zscore"]).env == (("observation", "zscore"),)


def test_the_papers_settings_extend_the_tasks_own():
    paper, own = load_config("paper/ant_2x4", method="r4sg"), load_config("ant_2x4", method="r4sg")
    assert (paper.task, paper.seeds, paper.steps, paper.env) == ("ant_2x4", 20, 10_000_000, own.env)


def test_every_file_and_every_preset_describes_itself():
    assert all(load.about(name) for name in load.names()) and all(load.presets().values())


def test_all_files_are_packaged():
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    packaged = {path for pattern in patterns["pmt_jax.configs"] for path in load.CONFIG_DIR.glob(pattern)}
    assert packaged == {path for path in load.CONFIG_DIR.rglob("*") if path.is_file()}
