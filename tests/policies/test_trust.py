"""A run folder from somebody else executes no code unless it is trusted."""

from __future__ import annotations

import pathlib

import pytest

from pmt_jax import load_config, load_policy
from pmt_jax.config.load import to_toml
from pmt_jax.errors import UsageError

EXECUTED = """
import pathlib
pathlib.Path(__file__).with_suffix(".executed").touch()
"""


@pytest.fixture
def place(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """A working folder with a run in it, and a folder beside it."""
    (tmp_path / "work" / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path


def run_of(place: pathlib.Path, file: pathlib.Path) -> None:
    """The run is of a task in `file`, which says when it is executed, and does not keep the contract."""
    file.write_text(EXECUTED)
    (place / "work" / "run" / "config.toml").write_text(to_toml(load_config("lane").replace(task=f"{file}:Env")))


@pytest.mark.parametrize("file", ["elsewhere/env.py", "work/run/env.py"])
@pytest.mark.parametrize(
    "command", [("eval",), ("export", "-o", "out"), ("render", "-o", "x.html"), ("report", "-o", "x.html")]
)
def test_a_file_from_elsewhere_is_not_executed(command: tuple[str, ...], file: str, place: pathlib.Path, cli):
    run_of(place, place / file)
    code, _, err = cli(command[0], "run", *command[1:])
    assert code == 2 and f"run is a run of {place / file}" in err and "add --trust" in err and err.count("\n") == 1
    assert not (place / file).with_suffix(".executed").exists()


def test_it_is_executed_where_it_is_trusted_or_in_the_working_folder(place: pathlib.Path, cli):
    file = place / "elsewhere" / "env.py"
    run_of(place, file)
    assert "has no class or function 'Env'" in cli("eval", "run", "--trust")[2]
    assert file.with_suffix(".executed").exists()
    with pytest.raises(UsageError, match="trust=True"):
        load_policy("run")
    with pytest.raises(UsageError, match="has no class or function 'Env'"):
        load_policy("run", trust=True)
    run_of(place, place / "work" / "env.py")
    assert "has no class or function 'Env'" in cli("eval", "run")[2]


def test_an_export_appears_whole(place: pathlib.Path):
    from pmt_jax.files import writing_folder

    out = place / "policy"
    with pytest.raises(KeyboardInterrupt), writing_folder(out) as partial:
        (partial / "one").touch()
        raise KeyboardInterrupt
    assert not out.exists() and sorted(p.name for p in place.iterdir()) == ["elsewhere", "work"]
    with writing_folder(out) as partial:
        (partial / "one").write_text("1")
    (out / "mine").touch()
    with writing_folder(out) as partial:
        (partial / "one").write_text("2")
    assert (out / "one").read_text() == "2" and sorted(p.name for p in out.iterdir()) == ["mine", "one"]
    with pytest.raises(UsageError, match="cannot write into .*mine: Not a directory"), writing_folder(out / "mine"):
        pass
