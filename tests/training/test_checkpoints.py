"""What a checkpoint belongs to, which one is read, and that a run that continues loses nothing that was whole."""

from __future__ import annotations

import errno
import json
import pathlib
import re
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from pmt_jax import load_policy, make_setup
from pmt_jax.config.load import load_config
from pmt_jax.errors import UsageError
from pmt_jax.learning.setup import Trials
from pmt_jax.training import checkpoint
from pmt_jax.training.history import missing_rows, row_steps
from pmt_jax.training.provenance import Provenance
from runs import ARGUMENTS, STEPS, assert_same_run, rows

RESUME = ("train", *ARGUMENTS, "--steps", STEPS, "--resume", "--out")


def damage(step: pathlib.Path) -> None:
    largest = max((p for p in step.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    data = bytearray(largest.read_bytes())
    data[len(data) // 2] ^= 1
    largest.write_bytes(data)


INCOMPLETE = {
    "made but not filled": lambda step: (shutil.rmtree(step), step.mkdir()),
    "a folder is missing": lambda step: shutil.rmtree(step / "default"),
    "data is missing": lambda step: shutil.rmtree(step / "default" / "d"),
    "the manifest is missing": lambda step: (step / "default" / "manifest.ocdbt").unlink(),
    "the metadata is cut": lambda step: (step / "default" / "_METADATA").write_text('{"tree'),
    "the metadata is another's": lambda step: (step / "default" / "_METADATA").write_text("[]"),
    "a file instead": lambda step: (shutil.rmtree(step), step.write_text("")),
    "a link to nothing": lambda step: (shutil.rmtree(step), step.symlink_to(step.parent / "nothing")),
    "a flipped bit": damage,
}


QUICK = ("the metadata is cut", "a flipped bit")


@pytest.mark.parametrize("how", [x if x in QUICK else pytest.param(x, marks=pytest.mark.full) for x in INCOMPLETE])
def test_a_newest_checkpoint_that_is_not_whole_hides_no_other(how: str, whole: pathlib.Path, copy: pathlib.Path, cli):
    INCOMPLETE[how](copy / "checkpoints" / str(STEPS))
    said = f"the checkpoint after {STEPS:,} steps in {copy / 'checkpoints'} cannot be read ("
    with pytest.warns(UserWarning, match=re.escape(said)):
        load_policy(copy)
    code, text, err = cli(*RESUME, copy)
    assert code == 0 and not err and said in text and "resuming after 1,400 steps" in text
    assert {p.name for p in (copy / "checkpoints").iterdir()} == {"1400", str(STEPS)}
    assert [p.name for p in (copy / checkpoint.DAMAGED).iterdir()] == [str(STEPS)]
    assert_same_run(copy, whole)


def test_what_is_set_aside_twice_overwrites_nothing(copy: pathlib.Path):
    checkpoints = checkpoint.Checkpoints(copy)
    for content in ("first", "second"):
        (copy / "checkpoints" / "2000").mkdir()
        (copy / "checkpoints" / "2000" / "file").write_text(content)
        checkpoints.set_aside([2000])
    found = {p.name: (p / "file").read_text() for p in (copy / checkpoint.DAMAGED).iterdir()}
    assert found == {"2000": "first", "2000-2": "second"}


@pytest.mark.parametrize(
    "number",
    [
        errno.EIO,
        *(pytest.param(x, marks=pytest.mark.full) for x in (errno.EMFILE, errno.ENOSPC, errno.EACCES, errno.ESTALE)),
    ],
)
def test_a_checkpoint_that_the_disk_does_not_give_now_is_not_passed_over(
    number: int, whole: pathlib.Path, copy: pathlib.Path, cli, monkeypatch
):
    newest, read = copy / "checkpoints" / str(STEPS), pathlib.Path.read_bytes

    def fail(path: pathlib.Path) -> bytes:
        if path.is_relative_to(newest):
            raise OSError(number, "the disk says no", str(path))
        return read(path)

    before = {path: read(path) for path in copy.rglob("*") if path.is_file()}
    monkeypatch.setattr(pathlib.Path, "read_bytes", fail)
    code, _, err = cli(*RESUME, copy)
    assert code == 2 and "cannot be read (the disk says no); it may be whole" in err and err.count("\n") == 1
    code, text, _ = cli("eval", copy, "--episodes", 1)
    assert code == 0 and "cannot be read (the disk says no)" in text and "after 1,400 steps" in text
    monkeypatch.undo()
    assert {path: read(path) for path in copy.rglob("*") if path.is_file()} == before
    code, text, _ = cli(*RESUME, copy)
    assert code == 0 and "resuming after 1,600 steps" in text
    assert_same_run(copy, whole)


def edit(folder: pathlib.Path, name: str, value: str) -> str:
    """Edits config.toml by hand; returns what it said before."""
    file = folder / "config.toml"
    before = file.read_text()
    file.write_text(re.sub(rf"^{name} = .*(\n(?=[ \]]).*)*$", f"{name} = {value}", before, flags=re.MULTILINE))
    assert file.read_text() != before
    return before


@pytest.mark.parametrize(
    ("name", "value", "change"),
    [
        ("seed", "5", "0 -> 5"),
        ("rollout_length", "50", "25 -> 50"),
        ("method", '"mixed"', "'f4sg' -> 'mixed'"),
        ("cost_limit", "99.0", "nan -> 99.0"),
        ("clip", "0.1", "0.2 -> 0.1"),
        ("hidden", "[8, 8]", "(8,) -> (8, 8)"),
    ],
)
def test_settings_edited_by_hand_are_named(name: str, value: str, change: str, copy: pathlib.Path, cli):
    edit(copy, name, value)
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    for words in (("eval", copy), ("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache")):
        code, _, err = cli(*words)
        assert code == 2 and f"\n  {name}: {change}" in err and "config.toml" in err and "Traceback" not in err
    assert {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()} == before


@pytest.mark.full
@pytest.mark.parametrize("words", [("export", "-o"), ("render", "-o"), ("train", "--init"), ("report", "-o")])
def test_every_way_to_load_names_them(words: tuple[str, str], copy: pathlib.Path, tmp_path: pathlib.Path, cli):
    edit(copy, "cost_limit", "99.0")
    command, flag = words
    if command == "train":
        code, _, err = cli("train", *ARGUMENTS, "--steps", STEPS, "--init", copy, "--out", tmp_path / "new")
        assert not (tmp_path / "new").exists()
    else:
        code, _, err = cli(command, copy, flag, tmp_path / "new.html")
    if command == "report":  # which says it on the page, in place of what is missing
        assert code == 0 and "cost_limit: nan -&gt; 99.0" in (tmp_path / "new.html").read_text()
    else:
        assert code == 2 and "\n  cost_limit: nan -> 99.0" in err


@pytest.mark.full
def test_an_edited_setting_is_a_change_that_is_recorded(copy: pathlib.Path, cli):
    edit(copy, "clip", "0.1")
    words = ("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache", "--steps", STEPS + 200)
    code, text, _ = cli(*words, "--change")
    assert code == 0 and f"from step {STEPS:,} on: clip 0.2 -> 0.1" in text
    recorded = json.loads((copy / "changes.jsonl").read_text())
    assert recorded == {"step": STEPS, "changed": {"clip": "0.2 -> 0.1"}}
    assert load_config(copy / "config.toml").clip == 0.1
    edit(copy, "seed", "5")
    code, _, err = cli(*words, "--change")
    assert code == 2 and "--change cannot change seed" in err and "\n  seed: 0 -> 5" in err


def test_the_settings_that_the_run_had_mend_an_edited_file(whole: pathlib.Path, copy: pathlib.Path, cli):
    before = edit(copy, "clip", "0.1")
    shutil.rmtree(copy / "checkpoints" / str(STEPS))
    code, text, err = cli(*RESUME, copy)
    assert code == 0 and not err and "was edited since the checkpoint" in text and "clip: 0.2 -> 0.1" in text
    assert (copy / "config.toml").read_text() == before and not (copy / "changes.jsonl").exists()
    assert_same_run(copy, whole)


@pytest.mark.full
def test_a_change_before_the_next_checkpoint_is_no_edit(copy: pathlib.Path, cli, monkeypatch):
    """Killed right after it began to train on: the checkpoint has the old settings, config.toml the new."""
    saves = checkpoint.Checkpoints.save
    monkeypatch.setattr(checkpoint.Checkpoints, "save", lambda *_: None)
    words = ("train", copy / "config.toml", "--out", copy, "--resume", "--no-cache", "--steps", STEPS + 200)
    assert cli(*words, "--change", "--clip", 0.1)[0] == 0
    monkeypatch.setattr(checkpoint.Checkpoints, "save", saves)
    assert cli("eval", copy, "--episodes", 1)[0] == 0
    recorded = (copy / "changes.jsonl").read_text()
    code, text, _ = cli(*words)
    assert code == 0 and f"resuming after {STEPS:,} steps" in text
    assert (copy / "changes.jsonl").read_text() == recorded and load_config(copy / "config.toml").clip == 0.1
    damage(copy / "checkpoints" / str(STEPS + 200))  # back to before the change, which then happens again
    assert cli(*words)[0] == 0 and (copy / "changes.jsonl").read_text() == recorded
    assert cli("eval", copy, "--episodes", 1)[0] == 0


@pytest.mark.full
def test_a_checkpoint_of_another_run_or_step(whole: pathlib.Path, copy: pathlib.Path, tmp_path: pathlib.Path, cli):
    other = tmp_path / "other"
    later = str(STEPS + 200)
    assert cli("train", *ARGUMENTS, "--seed", 7, "--steps", later, "--out", other)[0] == 0
    shutil.copytree(other / "checkpoints" / later, copy / "checkpoints" / later)
    for words in (("eval", copy), (*RESUME, copy)):
        code, _, err = cli(*words)
        assert code == 2 and "seed: 7 -> 0" in err
    shutil.rmtree(copy / "checkpoints" / later)
    (copy / "checkpoints" / str(STEPS)).rename(copy / "checkpoints" / "99999")
    for words in (("eval", copy), (*RESUME, copy)):
        code, _, err = cli(*words)
        assert code == 2 and "99999 holds the checkpoint after 1,600 steps; give it its name back, 1600" in err
    assert {p.name for p in (copy / "checkpoints").iterdir()} == {"1400", "99999"}


def test_a_checkpoint_that_does_not_say_what_it_belongs_to(copy: pathlib.Path, cli, monkeypatch):
    saved = checkpoint.newest(copy, print)
    shutil.rmtree(copy / "checkpoints")
    checkpoints = checkpoint.Checkpoints(copy)
    checkpoints.write_table(STEPS, saved.packed)
    checkpoints.close()
    for words in (("eval", copy, "--episodes", 1), (*RESUME, copy)):
        code, text, _ = cli(*words)
        assert code == 0 and "does not say which run it belongs to" in text


def test_the_trials_of_a_sweep_belong_to_its_checkpoint():
    setup = make_setup(load_config("lane", "mappo_l", num_envs=4, seeds=2))
    hyper = setup.hyper
    trials = [Trials(hyper, jnp.array(seeds), jnp.arange(2)) for seeds in ([0, 1], [0, 2])]
    ours, theirs = (Provenance.of(type(setup)(setup.config, *_rest(setup), trials=x)) for x in trials)
    assert ours.differences(theirs) == {"seed of the trials": "[0, 1] -> [0, 2]"} and not ours.differences(ours)
    step, back = Provenance.from_bytes(ours.to_bytes(400))
    assert step == 400 and not back.differences(ours) and back.trials["seed"] == [0, 1]
    assert not ours.differences(Provenance(setup.config))


def _rest(setup) -> tuple:
    return setup.method, setup.vector, setup.nets


def test_a_file_of_ones_own_is_the_same_task_elsewhere(tmp_path: pathlib.Path):
    here, there, other = (
        Provenance(load_config("lane").replace(task=str(tmp_path / name)))
        for name in ("a/env.py:Mine", "b/env.py:Mine", "a/env.py:Yours")
    )
    assert not here.differences(there) and here.differences(other).keys() == {"task"}


LOST = {
    "a seed": (lambda row: row["seed"] == 1, "8 of 16 rows up to step 1,600: 8 of seed 1 (between steps 200 and"),
    "a middle part": (lambda row: row["step"] in (600, 800), "4 of 16 rows up to step 1,600: 2 of seed 0 (between"),
    "one": (
        lambda row: (row["step"], row["seed"]) == (200, 0),
        "1 of 16 rows up to step 1,600: 1 of seed 0 (step 200)",
    ),
    "the last": (lambda row: row["step"] > 1000, "6 of 16 rows up to step 1,600: 3 of seed 0 (between steps 1,200"),
}


@pytest.mark.parametrize("what", LOST)
def test_rows_that_are_missing_anywhere_are_named(what: str, copy: pathlib.Path, cli):
    gone, said = LOST[what]
    kept = [row for row in rows(copy) if not gone(row)]
    (copy / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in kept))
    code, text, _ = cli(*RESUME, copy)
    assert code == 0 and f"{copy / 'metrics.jsonl'} lacks {said}" in text and rows(copy) == kept
    code, _, err = cli("table", copy)
    assert code == 0 and f"{copy} lacks {said}" in err


def test_nothing_is_missing_from_a_whole_run_or_while_rows_are_written(whole: pathlib.Path, copy: pathlib.Path, cli):
    assert cli("table", whole)[2] == ""
    (copy / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows(copy)[:-5]))
    shutil.rmtree(copy / "checkpoints")
    assert rows(copy)[-1] == rows(whole)[-6] and rows(copy)[-1]["seed"] == 0
    assert cli("table", copy)[2] == ""


def test_rows_are_expected_where_changes_put_them():
    config = load_config("lane", num_envs=4, rollout_length=25, log_interval=5, seeds=2)
    changes = [
        {"step": 600, "changed": {"log_interval": "2 -> 1", "clip": "0.2 -> 0.1"}},
        {"step": 800, "changed": {"log_interval": "1 -> 5"}},
    ]
    steps = [200, 400, 600, 700, 800, 1000, 1500, 2000]
    assert list(row_steps(config, changes, 2000)) == steps and list(row_steps(config, changes, 650)) == [200, 400, 600]
    found = [{"seed": seed, "step": step} for seed in (0, 1) for step in steps]
    assert missing_rows(config, changes, found, 2000) is None
    assert missing_rows(config, changes, found[:-1], 2000) == "1 of 16 rows up to step 2,000: 1 of seed 1 (step 2,000)"
    foreign = missing_rows(config, changes, [row | {"seed": 7} for row in found[:8]], 2000)
    assert foreign and "8 of seed 0" in foreign and "of other seeds: 7" in foreign


@pytest.mark.parametrize("line", ['{"step": 3}', '{"step": "3", "changed": {}}', '{"step": 3, "changed": {"clip": 1}}'])
def test_a_record_of_changes_that_is_none(line: str, copy: pathlib.Path, cli):
    (copy / "changes.jsonl").write_text(line + "\n")
    for words in (("eval", copy), ("table", copy), (*RESUME, copy)):
        code, _, err = cli(*words)
        assert code == 2 and "changes.jsonl: a line is not of the form" in err and err.count("\n") == 1


@pytest.mark.full
def test_a_report_says_once_and_plainly_what_it_passes_over(copy: pathlib.Path, tmp_path: pathlib.Path, cli):
    damage(copy / "checkpoints" / str(STEPS))
    code, text, err = cli("report", copy, "-o", tmp_path / "report.html", "--episodes", 1)
    assert code == 0 and "UserWarning" not in text + err and "checkpoint.py" not in text + err
    assert err.startswith(f"pmt: the checkpoint after {STEPS:,} steps in")
    assert all(line.startswith("pmt: the checkpoint after") for line in err.splitlines())


def test_what_is_written_is_what_is_read():
    config = load_config("lane", "f4sg", cost_limit=2.5, seeds=3, seed=4)
    provenance = Provenance(config)
    written = provenance.to_bytes(1234)
    assert json.loads(np.asarray(written).tobytes())["seeds"] == [4, 5, 6]
    assert Provenance.from_bytes(written) == (1234, provenance)
    unknown = json.loads(written.tobytes()) | {"settings": 'task = "lane"\nnever = 1\n'}
    with pytest.raises(UsageError, match="unknown setting 'never'"):
        Provenance.from_bytes(np.frombuffer(json.dumps(unknown).encode(), np.uint8))
