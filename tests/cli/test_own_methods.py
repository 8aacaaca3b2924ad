"""A method in a Python file of one's own: run folders, tables, resume, sweeps, trust and mistakes, as for tasks."""

from __future__ import annotations

import pathlib
import re
import shutil

import pytest

from pmt_jax import METHODS, load_config
from pmt_jax.config import methods
from pmt_jax.errors import UsageError

FILE = """
import jax.numpy as jnp
from pmt_jax import Method

def harm(batch):
    return 2 * batch.cost

doubled = Method(order="sequential", constraint="lagrangian", cost_signal=harm)
plain = Method(order="sequential", constraint="lagrangian")
"""
TINY = ("--num-envs", 4, "--rollout-length", 25, "--log-interval", 2, "--hidden", 8, "--minibatches", 1)
TINY += ("--epochs", 1, "--steps", 400, "--no-cache")
TINY += ("--lambda-lr", 0)  # so that longer runs have the same program


@pytest.fixture
def file(tmp_path: pathlib.Path) -> pathlib.Path:
    path = tmp_path / "mine.py"
    path.write_text(FILE)
    return path


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A run of `doubled`, in the folder of its file."""
    from pmt_jax.cli import main

    folder = tmp_path_factory.mktemp("own")
    (folder / "mine.py").write_text(FILE)
    words = ("train", "lane", "--method", f"{folder / 'mine.py'}:doubled", *TINY, "--out", folder / "run")
    assert main([str(word) for word in words]) == 0
    return folder


@pytest.mark.full
def test_a_run_table_eval_and_resume(trained: pathlib.Path, cli, monkeypatch: pytest.MonkeyPatch):
    run = trained / "run"
    config = load_config(run / "config.toml")
    assert config.method == f"{trained / 'mine.py'}:doubled"  # it means the same from every folder
    monkeypatch.chdir("/")
    code, text, _ = cli("table", run)
    assert code == 0 and re.search(r"^lane +doubled ", text, re.MULTILINE)
    assert cli("eval", run, "--episodes", 2)[0] == 0
    code, text, _ = cli("train", run / "config.toml", "--steps", 600, "--out", run, "--resume")
    assert code == 0 and "resuming after 400 steps" in text and "doubled on lane" in text


@pytest.mark.full
def test_a_run_goes_on_where_its_file_has_moved(trained: pathlib.Path, tmp_path: pathlib.Path, cli):
    """The file is the same method in another folder; config.toml says where."""
    folder = shutil.copytree(trained, tmp_path / "moved")
    words = ("train", "lane", "--method", f"{folder / 'mine.py'}:doubled", *TINY, "--steps", 600)
    code, text, err = cli(*words, "--out", folder / "run", "--resume")
    assert code == 0 and "resuming after" in text, err
    config = folder / "run" / "config.toml"
    config.write_text(config.read_text().replace(str(trained), str(folder)))
    assert cli("eval", folder / "run", "--episodes", 2, "--trust")[0] == 0
    other = folder / "other.py"
    other.write_text(FILE)
    code, _, err = cli(*words[:3], f"{other}:doubled", *words[4:], "--out", folder / "run", "--resume")
    assert code == 2 and "method: " in err


def test_a_plain_row_in_a_file_is_the_row_of_the_table(file: pathlib.Path):
    assert methods.find(f"{file}:plain") == METHODS["mappo_l"]


@pytest.mark.full
def test_points_of_a_sweep(file: pathlib.Path, tmp_path: pathlib.Path, cli):
    out = tmp_path / "sweep"
    values = f"method={file}:doubled,mappo_l"
    code, text, err = cli("sweep", "lane", *TINY, "--set", values, "--out", out)
    assert code == 0, err
    assert re.search(r"^lane +doubled", text, re.MULTILINE) and re.search(r"^lane +mappo_l", text, re.MULTILINE)
    assert len([x for x in out.rglob("config.toml")]) == 2


def test_somebody_elses_method_is_executed_only_if_trusted(
    file: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch: pytest.MonkeyPatch
):
    """Named by a run or a file of settings, it has to be known; named on the command line, it becomes so."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    marker = tmp_path / "executed"
    file.write_text(f"open({str(marker)!r}, 'w').close()\n{FILE}")
    settings = tmp_path / "given.toml"
    settings.write_text(f'task = "lane"\nmethod = "{file}:doubled"\n')
    code, _, err = cli("train", settings, *TINY, "--out", tmp_path / "a")
    assert code == 2 and "whose code would be executed" in err and str(file) in err and not marker.exists()
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.toml").write_text(settings.read_text())
    (run / "metrics.jsonl").write_text("")
    (run / "checkpoints").mkdir()
    for command in (("eval", run), ("render", run), ("export", run, "-o", tmp_path / "e"), ("report", run)):
        cli(*command)
        assert not marker.exists(), command
    code, _, err = cli("train", settings, *TINY, "--out", tmp_path / "a", "--resume", "--trust")
    assert code == 2 and "no run to resume" in err and marker.exists()  # it was executed, and then there was no run


@pytest.mark.parametrize(
    ("content", "name", "said"),
    [
        (FILE, "", "2 of them (doubled, plain); choose one, as"),
        (FILE, ":double", "no Method called 'double'; did you mean 'doubled'"),
        (FILE, ":harm", "no Method called 'harm'"),
        ("x = 1", "", "0 of them (none)"),
        ("import nowhere", ":x", "cannot be imported: ModuleNotFoundError"),
        ("def (", ":x", "cannot be imported: SyntaxError"),
        (FILE.replace('"sequential"', '"random"'), ":plain", "order must be simultaneous or sequential, not 'random'"),
        (FILE.replace('"lagrangian"', '"hard"'), ":plain", "constraint must be none or lagrangian or trust_region"),
        (
            FILE.replace("cost_signal=harm", 'cost_signal="harm"'),
            ":doubled",
            "cost_signal must be cost, fear or a func",
        ),
        (
            FILE.replace("cost_signal=harm", 'surrogate="cliped"'),
            ":doubled",
            "surrogate must be clipped or first_order",
        ),
        (FILE.replace("cost_signal=harm", 'critic="states"'), ":doubled", "critic must be state or observation"),
        (
            FILE.replace("cost_signal=harm", 'share_actor="no"'),
            ":doubled",
            "share_actor must be True or False, not 'no'",
        ),
        (
            FILE.replace("cost_signal=harm", "share_actor=True"),
            ":doubled",
            "share_actor needs order simultaneous, for one actor has no turns to take",
        ),
        (None, ":x", "there is no file"),
    ],
)
def test_mistakes_are_one_sentence(
    content: str | None, name: str, said: str, file: pathlib.Path, tmp_path: pathlib.Path, cli
):
    file.unlink() if content is None else file.write_text(content)
    code, _, err = cli("train", "lane", "--method", f"{file}{name}", *TINY, "--out", tmp_path / "run")
    assert code == 2 and said in err and len(err.splitlines()) == 1, err
    assert "methods.py, line" not in err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        ("batch.costs", "cost_signal harm fails: AttributeError: 'Batch' object has no attribute 'costs'"),
        ("batch.cost.reshape(7, 7)", "cost_signal harm fails: TypeError: cannot reshape array"),
        ("batch.cost[..., 0]", "must return an array [T, B, N, K], here (25, 4, 2, 1), not (25, 4, 2)"),
    ],
)
def test_a_signal_that_fails_is_one_sentence(returned: str, said: str, file: pathlib.Path, tmp_path: pathlib.Path, cli):
    file.write_text(FILE.replace("2 * batch.cost", returned))
    code, _, err = cli("train", "lane", "--method", f"{file}:doubled", *TINY, "--out", tmp_path / "run")
    assert code == 2 and said in err and "Traceback" not in err, err
    assert "(mine.py, line 6)" in err or "must return" in err


def test_unknown_words_are_still_refused():
    with pytest.raises(UsageError, match="did you mean 'f4sg'"):
        load_config("lane", method="f4sgg")
    assert (
        methods.label("/a/b-c.py") == "b_c" and methods.label("x.py:Name") == "Name" and methods.label("f4sg") == "f4sg"
    )


def test_a_home_that_the_shell_left_is_expanded(whole: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch):
    """bash expands `--out ~/x` but not `--out=~/x`, which made a folder named `~`."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    home = tmp_path / "home"
    home.mkdir()
    assert cli("table", whole, "-o=~/table.md")[0] == 0 and (home / "table.md").is_file()
    for flags in (("--out=~/x", "--resume"), ("--init=~/x",)):
        code, _, err = cli("train", "lane", "--method", "f4sg", *TINY, "--out", tmp_path / "run", *flags)
        assert code == 2 and str(home / "x") in err, err
    assert cli("train", "lane", *TINY, "--profile=~/trace", "--out=~/x", "--resume")[0] == 2
    assert (home / "trace").is_dir() and not (tmp_path / "~").exists()
    code, _, err = cli("table", whole, "-o=~nobody_at_all/x")
    assert code == 2 and "begins with a home that is unknown" in err
