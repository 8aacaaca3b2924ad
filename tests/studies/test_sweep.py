"""Sweeps and the paper's tables: points are runs, and nothing finished is lost."""

from __future__ import annotations

import json
import os
import pathlib
import re
import shutil
import signal
import warnings

import numpy as np
import pytest
import tomli_w

from pmt_jax import load_config
from pmt_jax.errors import UsageError
from pmt_jax.studies import reproduce, run_log, sweep, table
from pmt_jax.studies.points import Part, make_points
from pmt_jax.training import checkpoint
from pmt_jax.training.loggers import Jsonl
from pmt_jax.training.run_folder import load_saved

TINY = ("--num-envs", 4, "--rollout-length", 25, "--log-interval", 2, "--hidden", 8, "--minibatches", 1)
TINY += ("--epochs", 1, "--method", "happo", "--seeds", 2, "--steps", 600)
COMMAND = ("sweep", "lane", *TINY, "--set", "critic_lr=0.001,1e38", "--no-cache", "--out")
NAMES = ["critic_lr=0.001", "critic_lr=1e+38"]


def rows(folder: pathlib.Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def without_seconds(log: list[dict]) -> list[dict]:
    return [{name: x for name, x in row.items() if name != "seconds"} for row in log]


def state(folder: pathlib.Path) -> dict[str, np.ndarray]:
    return checkpoint.newest(folder, warnings.warn).packed


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """Two points of two seeds, one of which diverges."""
    from pmt_jax.cli import main

    out = tmp_path_factory.mktemp("sweep") / "out"
    assert main([str(a) for a in (*COMMAND, out)]) == 0
    return out


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """The first of these points as a run of its own."""
    from pmt_jax.cli import main

    out = tmp_path_factory.mktemp("alone") / "out"
    assert main([str(a) for a in ("train", "lane", *TINY, "--critic-lr", 0.001, "--no-cache", "--out", out)]) == 0
    return out


def test_points_are_run_folders_and_nothing_else_is_left(swept: pathlib.Path):
    assert sorted(p.name for p in swept.iterdir()) == NAMES
    for name in NAMES:
        files = {p.name for p in (swept / name).iterdir()}
        evaluated = {"evaluation.jsonl"} if name == NAMES[0] else set()  # the other diverged
        assert files == {"config.toml", "metrics.jsonl", "versions.json", "checkpoints"} | evaluated
        assert load_config(swept / name / "config.toml").critic_lr == float(name.split("=")[1])
        assert [(row["step"], row["seed"]) for row in rows(swept / name)[:3]] == [(200, 0), (200, 1), (400, 0)]


@pytest.mark.full
def test_a_point_is_the_same_run_alone_to_rounding(swept: pathlib.Path, alone: pathlib.Path):
    """XLA fuses differently where settings have a lane axis, so the last bits differ (3e-7 after 20 updates)."""
    expected, point = state(alone), state(swept / NAMES[0])
    assert expected.keys() == point.keys()
    for path in expected:
        np.testing.assert_allclose(point[path], expected[path], rtol=1e-4, atol=1e-5, err_msg=path)
    assert (alone / "config.toml").read_text() == (swept / NAMES[0] / "config.toml").read_text()


def test_a_point_that_diverges_stops_no_other(swept: pathlib.Path):
    assert rows(swept / NAMES[1])[-1]["critic/loss"] is None
    assert all(row["critic/loss"] is not None for row in rows(swept / NAMES[0]))


def test_the_same_command_again_trains_nothing_and_shows_the_points_best_first(swept: pathlib.Path, cli):
    before = (swept / NAMES[0] / "metrics.jsonl").stat()
    code, out, _ = cli(*COMMAND, swept)
    assert code == 0 and "2 of 2 points are finished already" in out and "program" not in out
    assert out.index("happo critic_lr=0.001") < out.index("happo critic_lr=1e+38")
    assert (swept / NAMES[0] / "metrics.jsonl").stat() == before
    code, _, err = cli(*COMMAND, swept, "--clip", 0.1)
    assert code == 2 and "was made with other settings (clip: 0.2 -> 0.1)" in err


def test_interrupted_and_resumed_is_uninterrupted(swept: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch):
    write = Jsonl.write

    def interrupt(logger: Jsonl, log: list[dict]) -> None:
        write(logger, log)
        os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Jsonl, "write", interrupt)
        code, out, _ = cli(*COMMAND, tmp_path)
    assert code == 130 and "Continue with: the same command" in out
    assert [p.name for p in tmp_path.iterdir()] == [".group-1"]
    notes: list[str] = []
    begun = run_log.read_all([tmp_path], notes.append)
    assert notes == [f"not ended: 2 point(s) of {tmp_path}, read at step 200"]
    assert [log.folder for log in begun] == [tmp_path / name for name in NAMES]
    for log, name in zip(begun, NAMES, strict=True):
        ended = run_log.read(swept / name)
        assert ended and (log.identity, log.seeds, log.versions) == (ended.identity, ended.seeds, ended.versions)
        for metric in set(log.metrics) - {"seconds"}:
            np.testing.assert_array_equal(log.metrics[metric], ended.until(200).metrics[metric])
    assert cli("table", tmp_path)[0] == 0
    file = tmp_path / ".group-1" / "points" / f"{NAMES[0]}.toml"
    right = file.read_text()
    file.write_text(re.sub("^gamma = .*", "gamma = 7", right, flags=re.MULTILINE))
    code, _, err = cli("table", tmp_path)
    assert code == 2 and f"{file}: gamma must lie in [0, 1], not 7" in err
    file.write_text(right)
    code, out, _ = cli(*COMMAND, tmp_path)
    assert code == 0 and "resuming after 200 steps" in out
    for name in NAMES:
        assert without_seconds(rows(tmp_path / name)) == without_seconds(rows(swept / name))
        once, twice = state(swept / name), state(tmp_path / name)
        assert all(np.array_equal(once[path], twice[path], equal_nan=True) for path in once)
    assert sorted(p.name for p in tmp_path.iterdir()) == NAMES


def test_an_empty_folder_in_a_points_place_takes_it_and_other_files_do_not(
    swept: pathlib.Path, tmp_path: pathlib.Path, cli
):
    (tmp_path / NAMES[0]).mkdir()
    assert cli(*COMMAND, tmp_path)[0] == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == NAMES
    assert without_seconds(rows(tmp_path / NAMES[0])) == without_seconds(rows(swept / NAMES[0]))
    (tmp_path / NAMES[0] / "config.toml").unlink()
    code, _, err = cli(*COMMAND, tmp_path)
    assert code == 2 and f"{tmp_path / NAMES[0]} holds no run but other files" in err


def test_what_is_left_of_a_finished_program_is_not_trained_again(swept: pathlib.Path, tmp_path: pathlib.Path, cli):
    shutil.copytree(swept, tmp_path / "s")
    for name in NAMES:
        (tmp_path / "s" / ".group-1" / "points").mkdir(parents=True, exist_ok=True)
        shutil.copy(tmp_path / "s" / name / "config.toml", tmp_path / "s" / ".group-1" / "points" / f"{name}.toml")
    code, out, _ = cli(*COMMAND, tmp_path / "s")
    assert code == 0 and "2 of 2 points are finished already" in out and "program" not in out


class Killed(BaseException):
    """Stands for kill -9: nothing of the program answers it."""


def test_killed_while_the_points_are_written(swept: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch):
    rename = pathlib.Path.rename

    def die(path: pathlib.Path, target: pathlib.Path) -> pathlib.Path:
        if target.name == NAMES[1]:
            raise Killed
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(pathlib.Path, "rename", die)
        with pytest.raises(Killed):
            cli(*COMMAND, tmp_path)
    assert (tmp_path / NAMES[0]).is_dir() and not (tmp_path / NAMES[1]).exists()
    code, out, _ = cli(*COMMAND, tmp_path)
    assert code == 0 and "resuming after 600 steps" in out
    assert without_seconds(rows(tmp_path / NAMES[1])) == without_seconds(rows(swept / NAMES[1]))


@pytest.mark.full
def test_points_of_one_program_keep_to_their_own_limits(tmp_path: pathlib.Path, cli):
    """What a row says, what the multiplier answers to, and which policy is the best so far."""
    small = ("--num-envs", 8, "--rollout-length", 25, "--log-interval", 2, "--hidden", 8, "--steps", 4000)
    limits = ("--set", "cost_limit=0.2,50", "--lambda-lr", 1)
    assert cli("sweep", "lane", *small, *limits, "--method", "mappo_l", "--no-cache", "--out", tmp_path)[0] == 0
    strict, loose = (tmp_path / f"cost_limit={limit}" for limit in ("0.2", "50"))
    assert {row["cost_limit"] for row in rows(strict)} == {0.2} and {row["cost_limit"] for row in rows(loose)} == {50}
    assert rows(strict)[-1]["lambda"] > rows(loose)[-1]["lambda"]
    for point, limit in ((strict, 0.2), (loose, 50)):
        within = [row["episode_reward"] for row in rows(point) if row["episode_cost"] <= limit]
        np.testing.assert_allclose(load_saved(point)[2]["best"].reward, [max(within)], rtol=1e-6)


def test_what_is_traced_shares_a_program_and_what_is_static_does_not(tmp_path: pathlib.Path):
    vary = {"method": ["happo", "f4sg"], "lambda_lr": ["0.1", "0.30"], "cost_limit": ["1", "2"], "seed": ["0", "5"]}
    points = make_points([Part("lane", vary)])
    assert len(points) == 16 and "method=f4sg,lambda_lr=0.3,cost_limit=2,seed=5" in points
    groups = [list(group.values()) for _, group in sweep.grouped(points, points, tmp_path)]
    assert [len(group) for group in groups] == [8, 8]
    assert all(len({c.method for c in group}) == 1 for group in groups)


# ---------------------------------------------------------------------------------------------------------------------
# The paper's tables


@pytest.mark.full
def test_reproduce_runs_what_is_missing_and_prints_it(alone: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch):
    tiny = {"seeds": 2, "num_envs": 4, "rollout_length": 25, "minibatches": 1, "hidden": [8], "epochs": 1}
    tiny |= {"log_interval": 2, "critic_lr": 0.001}  # the run alone, whose program is in the compile cache
    plan = {"title": "Table 0", "tasks": ["lane"], "methods": ["happo"], "baseline": "happo"}
    sizes = tmp_path / "sizes.toml"
    sizes.write_text(tomli_w.dumps({"extends": "lane", "steps": 600, **tiny}))
    paper = {"tables": {"table0": plan}, "budgets": {"smoke": {"source": str(sizes)}}, "tasks": {}}
    monkeypatch.setattr(table, "paper", lambda: paper)
    command = ("reproduce", "table0", "--out", tmp_path, "--no-cache")
    code, out, _ = cli(*command)
    assert code == 0 and "Table 0, budget 'smoke'" in out
    assert load_config(tmp_path / "lane" / "method=happo" / "config.toml").steps == 600
    point = state(tmp_path / "lane" / "method=happo")  # has its program to itself, hence bit for bit
    assert all(np.array_equal(x, point[path]) for path, x in state(alone).items())
    code, again, _ = cli(*command)
    assert code == 0 and "1 of 1 points are finished already" in again
    assert again[again.index("Table 0") :] == out[out.index("Table 0") :]


def test_the_papers_plans_can_be_made():
    paper = table.paper()
    for wanted in paper["tables"].values():
        assert wanted["baseline"] in wanted.get("methods", ["mappo_l"])
        for budget in {**paper["budgets"], **wanted.get("budgets", {})}.values():
            for task in set(wanted["tasks"]) & set(paper["tasks"]):
                assert len(reproduce.plan(task, ["f4sg", "mixed"], budget)) == 2


def test_reproduce_says_what_is_not_there(cli, monkeypatch, tmp_path: pathlib.Path):
    assert "unknown table 'table4'; did you mean 'table" in cli("reproduce", "table4")[2]
    assert "unknown budget 'large'" in cli("reproduce", "table1", "--budget", "large")[2]
    monkeypatch.setattr(reproduce, "names", lambda: ["lane"])
    code, _, err = cli("reproduce", "table2", "--out", tmp_path / "x")
    assert code == 2 and "table2 needs the task 'hand_over_2x6', which this version of pmt-jax does not have" in err

    def refuse(config: object) -> None:
        raise UsageError("no engine here")

    monkeypatch.setattr(reproduce, "names", lambda: ["ant_2x4", "ant_4x2"])
    monkeypatch.setattr(sweep, "make_setup", refuse)
    assert "no engine here" in cli("reproduce", "table1", "--out", tmp_path / "x")[2]
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_reproduce_a_whole_table_at_the_smoke_budget(tmp_path: pathlib.Path, cli):
    code, out, _ = cli("reproduce", "table3", "--out", tmp_path)
    assert code == 0 and out.count("voltage_33") > 7 and out.count("voltage_141") > 7
