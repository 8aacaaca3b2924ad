"""Settings: where they come from, what is refused and how."""

from __future__ import annotations

import dataclasses
import pathlib
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
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
