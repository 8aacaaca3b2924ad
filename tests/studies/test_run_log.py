"""Run folders are read as they stand, and what cannot be read gets a sentence."""

from __future__ import annotations

import math
import pathlib
import warnings

import numpy as np
import pytest

from by_hand import made, row, written
from pmt_jax.errors import UsageError
from pmt_jax.studies import run_log


def test_lines_that_no_run_writes(tmp_path: pathlib.Path):
    lines = [row(10, 0, 1.0), "[" * 10**5 + "\n", '{"step": ' + "9" * 5000 + "}\n"]
    assert run_log.read(written(tmp_path / "a", lines)).steps.tolist() == [10]
    with pytest.raises(UsageError, match="where a number or null belongs"):
        run_log.read(written(tmp_path / "b", [row(10, 0, 10**400)]))


def test_metrics_are_read_as_they_stand(tmp_path: pathlib.Path):
    lines = [row(10, 0, None), row(10, 1, 2.0), row(20, 0, 3.0), row(20, 1, 4.0), row(20, 1, 5.0), '{"step": 30, "se']
    log = run_log.read(written(tmp_path / "a", lines))
    assert log.steps.tolist() == [10, 20] and log.seeds == (0, 1)
    np.testing.assert_array_equal(log.metrics["episode_reward"], [[np.nan, 3], [2, 5]])
    log = run_log.read(written(tmp_path / "b", [row(step, 0, float(step)) for step in range(1, 1001)]))
    np.testing.assert_allclose(log.final("episode_reward"), [np.mean(range(901, 1001))])
    thin = log.thinned(100)
    assert len(thin.steps) == 100 and thin.steps[-1] == 1000
    np.testing.assert_allclose(thin.metrics["episode_reward"][0, :2], [5.5, 15.5])


def test_only_a_last_line_may_be_damaged_without_a_note(tmp_path: pathlib.Path, cli):
    """It is what a killed run leaves. Others change the scores."""
    good = [row(step, 0, 1.0) for step in range(1, 11)]
    for name, lines, damaged in (("cut", [*good, '{"st'], 0), ("bad", [good[0], "x\n", "[]\n", *good[1:]], 2)):
        code, _, err = cli("table", written(tmp_path / name, lines))
        assert code == 0 and ("2 damaged line(s)" in err and "line 2" in err if damaged else not err)
    assert "has no row" in cli("table", written(tmp_path / "none", ["x\n", "y\n"]))[2]


def test_a_run_can_be_read_as_if_it_had_ended_earlier(tmp_path: pathlib.Path):
    log = run_log.read(written(tmp_path / "a", [row(step, 0, float(step)) for step in range(1, 1001)]))
    early = log.until(500)
    assert early.steps[-1] == 500
    np.testing.assert_allclose(early.final("episode_reward"), [np.mean(range(451, 501))])
    np.testing.assert_array_equal(log.until(1000).metrics["episode_reward"], log.metrics["episode_reward"])
    with pytest.raises(UsageError, match="no metrics up to step 0: its first are of 1"):
        log.until(0)
    lines = [row(step, seed, 1.0, broken="nan" if seed == step > 1 else None) for step in (1, 2, 3) for seed in (2, 3)]
    log = run_log.read(written(tmp_path / "b", lines))
    for step, finals in ((1, [1, 1]), (2, [np.nan, 1]), (3, [np.nan, np.nan])):
        np.testing.assert_array_equal(log.until(step).final("episode_reward"), finals)


def test_the_final_metrics_of_a_seed_that_broke_are_unknown(tmp_path: pathlib.Path):
    both = [row(10, 0, 1.0, broken=None), row(10, 1, 1.0, broken="critic/loss is nan")]
    log = run_log.read(written(tmp_path / "a", both))
    assert log.broken == {1: 10}
    np.testing.assert_array_equal(log.final("episode_reward"), [1, np.nan])


def test_runs_that_differ_in_seeds_alone_are_one_group(tmp_path: pathlib.Path):
    config = 'task = "lane"\nlambda_lr = {}\nseed = {}\n'
    runs = []
    for name, rate, seed in (("a", 0.1, 0), ("b", 0.1, 1), ("c", 0.3, 0)):
        runs.append(run_log.read(written(tmp_path / name, [row(1, seed, 1.0)], config.format(rate, seed))))
    groups = run_log.groups(runs)
    assert [group.seeds for group in groups] == [(0, 1), (0,)]
    assert [group.label for group in groups] == ["mappo_l lambda_lr=0.1", "mappo_l lambda_lr=0.3"]


def test_settings_that_a_run_does_not_name_have_their_defaults(tmp_path: pathlib.Path):
    config = 'task = "lane"\nlambda_lr = 0.1\n'
    texts = (config, config + "lr_end = 1.0\nseed = 1\n", config + "lr_end = 0.5\n[env]\nnum_agents = 3\n")
    runs = [run_log.read(written(tmp_path / f"{i}", [row(10, i, 1.0)], text)) for i, text in enumerate(texts)]
    labels = [group.label for group in run_log.groups(runs)]
    assert labels == ["mappo_l env.num_agents=default lr_end=1", "mappo_l env.num_agents=3 lr_end=0.5"]


def test_a_run_that_was_trained_twice_counts_once(tmp_path: pathlib.Path):
    short, long = (
        run_log.read(written(tmp_path / f"{length}", [row(step, 0, 1.0) for step in range(1, length)]))
        for length in (3, 5)
    )
    with pytest.raises(UsageError, match="seed 0 counts twice"):
        run_log.groups([short, long])
    notes: list[str] = []
    (group,) = run_log.groups([short, long], notes.append)
    assert group.runs == (long,) and notes == [f"left out: {short.folder} has settings and seeds of {long.folder}"]


def test_folders_of_runs_are_searched_and_what_is_no_run_is_left_out(tmp_path: pathlib.Path):
    made(tmp_path / "sweep" / "a", "lane", "happo", {0: [1, 1]})
    made(tmp_path / "sweep" / ".group-1" / "run", "lane", "happo", {1: [1, 1]})
    (tmp_path / "empty").mkdir()
    (tmp_path / "curves.png").touch()
    written(tmp_path / "begun", [])
    notes: list[str] = []
    logs = run_log.read_all(sorted(tmp_path.iterdir()), notes.append)
    assert [log.folder for log in logs] == [tmp_path / "sweep" / "a"]
    assert [note.split()[2] for note in notes] == [str(tmp_path / name) for name in ("begun", "curves.png", "empty")]
    assert all(note.startswith("left out: ") for note in notes)


def test_runs_behind_links_are_found_once_and_unfinished_ones_named(tmp_path: pathlib.Path):
    scratch = tmp_path / "scratch"
    made(scratch / "a", "lane", "happo", {0: [1, 1]})
    runs = tmp_path / "runs"
    runs.mkdir()
    (runs / "linked").symlink_to(scratch)
    (runs / "linked" / "round").symlink_to(runs)  # a circle
    for name in ("config.toml", "metrics.jsonl"):
        (runs / name.split(".")[0]).mkdir()
        (runs / name.split(".")[0] / name).touch()
    notes: list[str] = []
    assert [log.folder for log in run_log.read_all([runs, scratch], notes.append)] == [runs / "linked" / "a"]
    assert {note.rsplit(" ", 1)[1] for note in notes} == {"metrics.jsonl", "config.toml"}


@pytest.mark.parametrize("command", ["table", "plot", "report"])
@pytest.mark.parametrize(
    ("line", "says"),
    [
        (row(10, 0, 1.0).replace("10", '"ten"'), 'has step = "ten", where a whole number belongs'),
        (row(10, 0, 1.0).replace('"lane"', "3"), "has task = 3, where a word belongs"),
        ('{"step": 3, "seed": 0}', "has task = null, where a word belongs"),
        (row(10, 0, 1.0, episode_cost="much"), 'has episode_cost = "much" at step 10, where a number or null belongs'),
        (row(10, 0, 1.0, episode_cost=[1, 2]), "has episode_cost = [1, 2] at step 10"),
        (row(10, True, 1.0), "has seed = true, where a whole number belongs"),
        (row(10**400, 0, 1.0), f"has step = {'1' + 39 * '0'}, where a whole number from 0 to 2**63 belongs"),
        (row(2**63, 0, 1.0), f"has step = {2**63}, where a whole number from 0 to 2**63 belongs"),
        (row(-1, 0, 1.0), "has step = -1, where a whole number from 0 to 2**63 belongs"),
        (row(10, 10**400, 1.0), "where a whole number from 0 to 2**63 belongs"),
        (row(10, 0, 1.0, cost_limit=10**400), "where a number from 0 to 2**63 belongs"),
        (row(10, 0, 1e308), "has episode_reward = 1e+308 at step 10, where a number of 32 bits or null belongs"),
        (row(10, 0, 1.0, episode_cost=-1e39), "has episode_cost = -1e+39 at step 10, where a number of 32 bits"),
        (row(10, 0, 1.0, seconds=10**400), "at step 10, where a number or null belongs"),
    ],
)
def test_rows_of_the_wrong_type_get_one_sentence(command: str, line: str, says: str, tmp_path: pathlib.Path, cli):
    folder = written(tmp_path / "a", [line])
    code, _, err = cli(command, folder)
    assert code == 2 and says in err and str(folder / "metrics.jsonl") in err and err.count("\n") == 1


@pytest.mark.parametrize("command", ["table", "plot", "compare"])
@pytest.mark.parametrize("number", [3.4e38, -3.4e38, 1e-45, 5e-324, math.inf, -math.inf, math.nan])
def test_the_largest_and_smallest_numbers_need_no_warnings(command: str, number: float, tmp_path: pathlib.Path, cli):
    """All that 32 bits hold, and what JSON makes of 1e309; a limit may be any number."""
    runs = []
    for name, limit in (("a", 1.0), ("b", 1e308)):
        lines = [
            row(10 * i, seed, number if seed else -number, episode_cost=number, cost_limit=limit, **{"lambda": number})
            for i in range(1, 21)
            for seed in (0, 1)
        ]
        runs.append(written(tmp_path / name, lines))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = ("-o", tmp_path / "x.svg") if command == "plot" else ()
        code, _, err = cli(command, *runs, *out)
    if command == "plot" and not math.isfinite(number):
        assert code == 2 and "nothing to draw of lane: no metric of its runs is a finite number" in err
    else:
        assert code == 0 and not err


@pytest.mark.parametrize("command", ["table", "plot", "report"])
def test_what_is_no_run_gets_one_sentence(command: str, tmp_path: pathlib.Path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "none is not a run folder: there is no such folder" in cli(command, "none")[2]
    assert ". holds no run: no folder in it has a config.toml and a metrics.jsonl" in cli(command, ".")[2]
    assert "hub:lane/f4sg is a pretrained policy, which has no metrics" in cli(command, "hub:lane/f4sg")[2]
    written(tmp_path / "begun", [])
    assert "begun has no metrics yet: its metrics.jsonl has no row" in cli(command, "begun")[2]
    (written(tmp_path / "latin", [row(10, 0, 1.0)]) / "config.toml").write_bytes(b'task = "\xe9"')
    code, _, err = cli(command, "latin")
    assert code == 2 and "is not valid TOML" in err and err.count("\n") == 1
