"""Run folders and settings from somebody else execute no code unless it is known or trusted."""

from __future__ import annotations

import json
import pathlib

import pytest

from pmt_jax import load_config, load_policy, trust
from pmt_jax.config.load import to_toml
from pmt_jax.errors import UsageError
from pmt_jax.policies import publish

EXECUTED = """
import pathlib
pathlib.Path(__file__).with_suffix(".executed").touch()
"""
NOT_A_TASK = "has no class or function 'Env'"  # what is said once a file has been executed


@pytest.fixture
def place(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> pathlib.Path:
    """A working folder with a run in it, a folder next to it, and a user of whom nothing is known."""
    (tmp_path / "work" / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path


def name_it(settings: pathlib.Path, file: pathlib.Path | str, **more: object) -> None:
    """`settings` are those of a run on a task in `file`."""
    settings.write_text(to_toml(load_config("lane").replace(task=f"{file}:Env", **more)))


def run_of(place: pathlib.Path, file: pathlib.Path) -> pathlib.Path:
    """The run is of a task in `file`, which says when it is executed, and does not keep the contract."""
    file.write_text(EXECUTED)
    name_it(place / "work" / "run" / "config.toml", file)
    return file


def executed(place: pathlib.Path) -> list[pathlib.Path]:
    return list(place.rglob("*.executed"))


DOORS = {
    "eval": ("eval", "run"),
    "export": ("export", "run", "-o", "out"),
    "render": ("render", "run", "-o", "x.html"),
    "report": ("report", "run", "-o", "x.html"),
    "init": ("train", "lane", "--init", "run"),
    "resume": ("train", "run/config.toml", "--out", "run", "--resume"),
    "settings": ("train", "run/config.toml", "--out", "new"),
    "sweep": ("sweep", "run/config.toml", "--set", "clip=0.1,0.2", "--out", "swept"),
    "sweep_init": ("sweep", "lane", "--set", "clip=0.1,0.2", "--init", "run", "--out", "swept"),
    "sweep_file": ("sweep", "sweep.toml", "--out", "swept"),
}


@pytest.mark.parametrize("file", ["elsewhere/env.py", "work/run/env.py", "work/env.py", "work/pack/deep/env.py"])
@pytest.mark.parametrize("door", DOORS)
def test_a_file_that_a_run_or_a_file_of_settings_names_is_not_executed(door: str, file: str, place, cli):
    (place / file).parent.mkdir(parents=True, exist_ok=True)
    run_of(place, place / file)
    text = f'extends = "lane"\ntask = "{place / file}:Env"\n[[sweep]]\nset.clip = [0.1, 0.2]\n'
    (place / "work" / "sweep.toml").write_text(text)
    code, _, err = cli(*DOORS[door])
    assert code == 2 and f" {place / file}, whose code would be executed" in err and err.count("\n") == 1, err
    assert "add --trust" in err and not executed(place)
    row = {"step": 1, "seed": 0, "task": "env", "method": "mappo", "cost_limit": 1.0, "seconds": 1.0}
    (place / "work" / "run" / "metrics.jsonl").write_text(json.dumps(row))  # without which there is no report
    cli(*DOORS[door], "--trust")
    assert executed(place)


@pytest.mark.parametrize("command", [("train",), ("envs",), ("eval", "--policy", "zero")])
def test_a_file_is_known_once_it_was_named_itself_and_until_it_changes(command: tuple[str, ...], place, cli):
    file = run_of(place, place / "work" / "env.py")
    assert "add --trust" in cli("eval", "run")[2] and not executed(place)
    assert NOT_A_TASK in cli(command[0], "env.py:Env", *command[1:])[2]  # his own word
    assert NOT_A_TASK in cli("eval", "run")[2]
    copy = place / "elsewhere" / "other.py"  # by content, not by place
    run_of(place, copy)
    assert NOT_A_TASK in cli("export", "run", "-o", "out")[2]
    file.write_text(EXECUTED + "# and more")
    name_it(place / "work" / "run" / "config.toml", file)
    code, _, err = cli("eval", "run")
    assert code == 2 and f"run is a run of {file}" in err and "have not trained with it as it is now" in err
    assert NOT_A_TASK in cli("eval", "run", "--trust")[2]
    assert NOT_A_TASK in cli("eval", "run")[2]  # remembered


def test_in_python(place: pathlib.Path):
    run_of(place, place / "elsewhere" / "env.py")
    with pytest.raises(UsageError, match="trust=True"):
        load_policy("run")
    assert not executed(place)
    with pytest.raises(UsageError, match=NOT_A_TASK):
        load_policy("run", trust=True)
    with pytest.raises(UsageError, match=NOT_A_TASK):
        load_policy("run")
    with pytest.raises(UsageError, match="add --trust"):  # what publishes a run loads it, too
        publish.publish(copied(place), 1)


def copied(place: pathlib.Path) -> pathlib.Path:
    """Another run, of a file that is not known."""
    run_of(place, place / "work" / "run" / "env.py").write_text(EXECUTED + "# new")
    return pathlib.Path("run")


@pytest.mark.parametrize("link", ["file", "chain", "folder", "run", "folder_outside"])
def test_a_link_does_not_take_a_file_out_of_its_run_folder(link: str, place: pathlib.Path, cli, monkeypatch):
    """Even one whose content is known: decided by every name that the file has on the way."""
    work, run = place / "work", place / "work" / "run"
    helper = work / "helper.py"
    helper.write_text(EXECUTED)
    named = run / "h.py"
    if link == "folder_outside":
        (run / "sub").symlink_to(work)
        named = run / "sub" / "helper.py"
    elif link == "folder":
        (run / "sub").mkdir()
        (run / "sub" / "h.py").write_text(EXECUTED)
        (work / "out").symlink_to(run / "sub")
        named = work / "out" / "h.py"
    else:
        named.symlink_to("../helper.py")
    if link == "chain":
        (work / "first.py").symlink_to("run/h.py")
        named = work / "first.py"
    name_it(run / "config.toml", named)
    assert NOT_A_TASK in cli("envs", "helper.py:Env")[2]
    (work / "as").symlink_to("run")
    helper.with_suffix(".executed").unlink()
    code, _, err = cli("eval", "as" if link == "run" else "run")
    assert code == 2 and "it lies in the run folder" in err and not executed(place)
    again = cli("train", "run/config.toml", "--out", "new")
    assert again[0] == 2 and "it lies in the run folder" in again[2] and not executed(place)
    assert NOT_A_TASK in cli("eval", "run", "--trust")[2]


BESIDE = {
    "import helper": "helper.py",
    "import helper.part as x": "helper/part.py",
    "from helper import part": "helper/part.py",
    "from helper.part import x": "helper/__init__.py",
    "def f():\n    from helper import x": "helper/__init__.py",
    "import first": "helper.py",  # which first.py imports
    "exec(open('lib/helper.py').read())": "lib/helper.py",
}


@pytest.mark.parametrize("source", BESIDE)
def test_what_a_file_loads_from_beside_it_is_known_with_it(source: str, tmp_path: pathlib.Path):
    """The same file with another helper is another program."""
    task, helper = tmp_path / "env.py", tmp_path / BESIDE[source]
    (tmp_path / "first.py").write_text("import helper")
    helper.parent.mkdir(exist_ok=True)
    task.write_text(source)
    without = trust.digest(task)
    helper.write_text("x = 1")
    first = trust.digest(task)
    helper.write_text("x = 2")
    assert len({without, first, trust.digest(task)}) == 3
    (tmp_path / "unrelated.py").write_text("x = 1")
    helper.write_text("x = 1")
    assert trust.digest(task) == first


@pytest.mark.parametrize(
    "source", [b"x = (", b"\0", b"\xff", b"", b"from ..... import x", b"x = '" + b"a" * 5000 + b".py'", b"(" * 5000]
)
def test_any_file_has_a_digest(source: bytes, tmp_path: pathlib.Path):
    (tmp_path / "env.py").write_bytes(source)
    assert len(trust.digest(tmp_path / "env.py")) == 64


@pytest.mark.parametrize("state", ["file", "folder", "relative", "homeless"])
def test_where_nothing_can_be_remembered_a_file_is_trusted_each_time(state: str, place: pathlib.Path, cli, monkeypatch):
    """A home that cannot be written costs a flag and nothing else."""
    run_of(place, place / "elsewhere" / "env.py")
    if state == "file":
        (place / "state").write_text("")
    elif state == "folder":
        (place / "state" / "pmt-jax" / "trusted").mkdir(parents=True)
    else:  # by the XDG standard a relative path does not count
        monkeypatch.setenv("XDG_STATE_HOME", "relative")
        monkeypatch.setenv("HOME", str(place / "nowhere"))
        (place / "nowhere").write_text("")
    if state == "homeless":
        monkeypatch.setattr(pathlib.Path, "home", classmethod(lambda cls: (_ for _ in ()).throw(RuntimeError("none"))))
    for _ in range(2):
        assert "add --trust" in cli("eval", "run")[2]
        assert NOT_A_TASK in cli("eval", "run", "--trust")[2]
    assert not (place / "work" / "relative").exists()


def test_what_is_remembered_can_be_read_and_taken_back(place: pathlib.Path, cli):
    file = run_of(place, place / "work" / "env.py")
    cli("envs", "env.py:Env")
    cli("envs", "env.py")
    known = place / "state" / "pmt-jax" / "trusted"
    assert known.read_text() == f'{trust.digest(file)}  "{file}"\n'
    known.write_text("damaged \0 line\n")
    assert "add --trust" in cli("eval", "run")[2]


def test_an_export_appears_whole(place: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    from pmt_jax.files import writing_folder

    out = place / "policy"
    with pytest.raises(KeyboardInterrupt), writing_folder(out) as partial:
        (partial / "one").touch()
        raise KeyboardInterrupt
    assert not out.exists() and sorted(p.name for p in place.iterdir()) == ["elsewhere", "work"]
    with writing_folder(out) as partial:
        (partial / "one").write_text("1")
    (out / "mine").touch()
    empty = place / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    with writing_folder(pathlib.Path()) as partial:  # the folder that a shell is in
        (partial / "one").touch()
    assert pathlib.Path("one").is_file() and [p.name for p in empty.iterdir()] == ["one"]
    with writing_folder(out) as partial:
        (partial / "one").write_text("2")
    assert (out / "one").read_text() == "2" and sorted(p.name for p in out.iterdir()) == ["mine", "one"]
    with pytest.raises(UsageError, match="cannot write into .*mine: Not a directory"), writing_folder(out / "mine"):
        pass
