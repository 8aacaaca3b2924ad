"""Files of settings: what extends what, presets, and what of them is packaged."""

from __future__ import annotations

import pathlib
import tomllib

import pytest

from paths import ROOT
from pmt_jax import load_config
from pmt_jax.config import load
from pmt_jax.errors import UsageError


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
