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
from pmt_jax.studies import points, reproduce, run_log, sweep, table
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
    limits = ("--set", "cost_limit=0.2,50", "--lambda-lr", 1, "--lambda-kp", 0.5, "--kl-max", "inf")
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


TWO_COSTS = """
import dataclasses
import jax.numpy as jnp
from envs.toys import Lane

class Two(Lane):
    def __init__(self):
        super().__init__()
        self.spec = dataclasses.replace(self.spec, name="two", num_costs=2, cost_limit=(2.0, 3.0))

    def _both(self, state):
        return dataclasses.replace(state, cost=jnp.concatenate([state.cost, 0 * state.cost], 1))

    def reset(self, key):
        return self._both(super().reset(key))

    def step(self, state, action):
        return self._both(super().step(dataclasses.replace(state, cost=state.cost[:, :1]), action))
"""


def test_points_keep_the_limits_of_several_costs(tmp_path: pathlib.Path, monkeypatch, cli):
    """Every lane has its own settings, a number for each cost, and its seed's place in its run."""
    asked = []
    monkeypatch.setattr(sweep.trainer, "train", lambda *_, **how: asked.append(how["trials"]) or 1)
    (tmp_path / "two.py").write_text(TWO_COSTS)
    words = ("--set", "clip=0.1,0.2", "--seeds", 3, "--num-envs", 4, "--minibatches", 1)
    cli("sweep", tmp_path / "two.py", *words, "--out", tmp_path / "out")
    (trials,) = asked
    np.testing.assert_array_equal(trials.hyper.cost_limit, [[2.0, 3.0]] * 6)
    np.testing.assert_allclose(trials.hyper.clip, np.repeat([0.1, 0.2], 3), rtol=1e-6)
    assert trials.index.tolist() == trials.seed.tolist() == [0, 1, 2] * 2


# ---------------------------------------------------------------------------------------------------------------------
# The paper's tables


@pytest.mark.full
def test_reproduce_runs_what_is_missing_and_prints_it(alone: pathlib.Path, tmp_path: pathlib.Path, cli, monkeypatch):
    tiny = {"seeds": 2, "num_envs": 4, "rollout_length": 25, "minibatches": 1, "hidden": [8], "epochs": 1}
    tiny |= {"log_interval": 2, "critic_lr": 0.001}  # the run alone, whose program is in the compile cache
    plan = {"title": "Table 0", "tasks": ["lane"], "methods": ["happo"], "baseline": "happo"}
    sizes = tmp_path / "sizes.toml"
    sizes.write_text(tomli_w.dumps({"extends": "lane", "steps": 600, **tiny, "seeds": 3}))
    paper = {"tables": {"table0": plan}, "budgets": {"smoke": {"source": str(sizes)}}, "tasks": {}}
    monkeypatch.setattr(table, "paper", lambda: paper)
    command = ("reproduce", "table0", "--seeds", "2", "--out", tmp_path, "--no-cache")
    code, out, _ = cli(*command)
    assert code == 0 and "Table 0, budget 'smoke'" in out
    assert load_config(tmp_path / "lane" / "method=happo" / "config.toml").steps == 600
    point = state(tmp_path / "lane" / "method=happo")  # has its program to itself, hence bit for bit
    assert all(np.array_equal(x, point[path]) for path, x in state(alone).items())
    code, again, _ = cli(*command)
    assert code == 0 and "1 of 1 points are finished already" in again
    assert again[again.index("Table 0") :] == out[out.index("Table 0") :]
    code, data, err = cli(*command, "--format", "json")
    assert code == 0 and len(json.loads(data)["rows"]) == 1 and "1 of 1 points are finished already" in err


def test_a_point_that_was_begun_with_other_settings_is_named(tmp_path: pathlib.Path):
    begun, wanted = ({"clip=0.1": load_config("lane", clip=0.1, steps=steps)} for steps in (2400, 3600))
    sweep.write_points(sweep.Program(tmp_path / ".group-1", begun, tmp_path))
    ((folder, group),) = sweep.grouped(begun, begun, tmp_path)
    assert folder == tmp_path / ".group-1" and group.keys() == begun.keys()
    with pytest.raises(UsageError, match=r"has begun 'clip=0.1' with other settings \(steps: 2400 -> 3600\); choose"):
        list(sweep.grouped(wanted, wanted, tmp_path))


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


# ---------------------------------------------------------------------------------------------------------------------
# What a sweep trains: combinations, draws, and files that list them


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--set", "lamda_lr=1"], "unknown setting 'lamda_lr'; did you mean 'lambda_lr'?"),
        (["--set", "clip"], "--set takes NAME=VALUE,VALUE,..., or with --random NAME=LOW:HIGH, not 'clip'"),
        (["--set", "clip=0.1,wide"], "clip = 'wide' does not fit: expected a number"),
        (["--set", "method=happo,hapo"], "unknown method 'hapo'; did you mean 'happo'?"),
        (["--set", "task=lane,noisy"], "--set has one task"),
        (["--set", "seeds=1,2"], "points 'seeds=1' and 'seeds=2' would both train seed 0"),
        (["--set", "clip=0.1,0.10"], "clip has the value 0.1 twice; name each once"),
        (
            ["--set", "hidden=64,64"],
            "hidden has the value 64 twice; name each once; one list of them goes into brackets",
        ),
        ([], "nothing varies: give --set NAME=VALUE,..., or a TOML file with a [[sweep]] table"),
        (["--set", "clip=0.1:0.2"], "clip has a range: add --random N, the number of values to draw"),
        (["--set", "clip=0.1,0.2", "--random", "3"], "random draws need a range"),
        (["--set", "clip=0.2:0.1", "--random", "3"], "a range is LOW:HIGH with LOW below HIGH"),
        (["--set", "clip=log:0:0.1", "--random", "3"], "both above 0 after log:, not 'log:0:0.1'"),
        (["--set", "layer_norm=0:1", "--random", "3"], "'layer_norm' is not a number and has no range to draw from"),
        (["--set", "clip=0.1:0.2", "--random", "x"], "--random must be a whole number"),
    ],
)
def test_mistakes_get_one_sentence(arguments: list[str], says: str, tmp_path: pathlib.Path, cli):
    code, _, err = cli("sweep", "lane", *arguments, "--out", tmp_path / "x")
    assert code == 2 and says in err and err.count("\n") == 1 and not (tmp_path / "x").exists()


def test_a_value_with_commas_stands_in_brackets(monkeypatch, cli):
    seen = {}
    monkeypatch.setattr(sweep, "sweep", lambda parts, points, *_: seen.update(points) or 0)
    assert cli("sweep", "lane", "--set", "hidden=[64,32],16", "--out", "x")[0] == 0
    assert {name: config.hidden for name, config in seen.items()} == {"hidden=64,32": (64, 32), "hidden=16": (16,)}


def test_draws_lie_in_their_ranges_and_repeat_with_their_seed():
    words = ["lambda_lr=log:0.001:10", "gamma=0.5:0.9", "epochs=2:6", "method=happo,f4sg"]
    found = points.make_points([points.from_words("lane", words, draws=200, seed=1)], seeds=3)
    assert len(found) == 400 and "draw=199,method=f4sg" in found
    assert {config.seeds for config in found.values()} == {3}
    rates, gammas, epochs = (
        np.array([getattr(c, f) for c in found.values()]) for f in ("lambda_lr", "gamma", "epochs")
    )
    assert rates.min() > 0.001 and rates.max() < 10 and 0.4 < np.mean(rates < 0.1) < 0.6  # half below the middle
    assert gammas.min() > 0.5 and gammas.max() < 0.9 and set(epochs) == {2, 3, 4, 5, 6}
    assert found["draw=7,method=happo"].lambda_lr == found["draw=7,method=f4sg"].lambda_lr  # a draw is shared
    fewer = points.make_points([points.from_words("lane", words, draws=5, seed=1)], seeds=3)
    assert all(repr(found[name]) == repr(config) for name, config in fewer.items())
    other = points.make_points([points.from_words("lane", words, draws=5, seed=2)], seeds=3)
    assert other["draw=0,method=happo"].gamma != found["draw=0,method=happo"].gamma


def test_draws_of_traced_settings_share_a_program_and_are_recorded(tmp_path: pathlib.Path, cli, monkeypatch):
    programs = []
    monkeypatch.setattr(sweep, "train_programs", lambda wanted, launch: programs.extend(wanted) or 1)
    words = ("--set", "actor_lr=log:1e-4:1e-2", "--random", 3, "--draw-seed", 5)
    code, out, _ = cli("sweep", "lane", *words, "--out", tmp_path)
    (program,) = programs
    assert code == 1 and f"drawn with seed 5: {tmp_path / 'draws.json'}" in out
    record = json.loads((tmp_path / "draws.json").read_text())
    assert record["ranges"] == [{"seed": 5, "actor_lr": {"low": 1e-4, "high": 1e-2, "log": True}}]
    assert record["draws"] == {name: {"actor_lr": config.actor_lr} for name, config in program.points.items()}
    assert list(record["draws"]) == ["draw=0", "draw=1", "draw=2"]


FILE = """
seeds = 5
steps = 4800
[[sweep]]
extends = "lane"
num_envs = 64
method = ["mappo_l", "f4sg"]
set.lambda_lr = [0.5, 1]
[[sweep]]
extends = "noisy"
steps = 9600
method = "f4sg"
random = 2
draw_seed = 3
set.emotion_l2 = "log:0.01:1"
"""


def test_a_file_lists_parts(tmp_path: pathlib.Path, monkeypatch, cli):
    file, seen = tmp_path / "study.toml", {}
    file.write_text(FILE)
    monkeypatch.setattr(sweep, "sweep", lambda parts, points, *_: seen.update(points) or 0)
    assert cli("sweep", file, "--num-envs", 16, "--out", "x")[0] == 0
    lanes = [f"task=lane,method={method},lambda_lr={rate}" for method in ("mappo_l", "f4sg") for rate in ("0.5", "1")]
    assert list(seen) == [*lanes, "task=noisy,draw=0,method=f4sg", "task=noisy,draw=1,method=f4sg"]
    assert {config.seeds for config in seen.values()} == {5}
    assert {config.num_envs for config in seen.values()} == {16}  # the command line has the last word
    assert [config.steps for config in seen.values()] == [4800] * 4 + [9600] * 2
    assert seen[lanes[0]].activation == "tanh"  # as lane in configs/tasks.toml says


@pytest.mark.parametrize(
    ("file", "part"),
    [
        ("[method.f4sg]\nemotion_l2 = 7.0", 'method = ["mappo_l", "f4sg"]'),
        ("[method.f4sg]\nemotion_l2 = 7.0", 'set.method = ["mappo_l", "f4sg"]'),
        ("", '[sweep.method.f4sg]\nemotion_l2 = 7.0\n[sweep.set]\nmethod = ["mappo_l", "f4sg"]'),
    ],
)
def test_tables_of_methods_hold_however_the_methods_are_named(file: str, part: str, tmp_path: pathlib.Path):
    (tmp_path / "study.toml").write_text(f'extends = "lane"\n{file}\n[sweep]\n{part}\n')
    found = points.make_points(points.from_file(tmp_path / "study.toml"))
    assert {config.method: config.emotion_l2 for config in found.values()} == {"mappo_l": 1.0, "f4sg": 7.0}


@pytest.mark.parametrize("file", ["base.toml", "deeper/base.toml"])
def test_a_part_extends_a_file_next_to_its_own(file: str, tmp_path: pathlib.Path):
    """From whichever folder the sweep starts."""
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text('extends = "paper/ant_2x4"\nclip = 0.3')
    (tmp_path / "study.toml").write_text(f'[sweep]\nextends = "{file}"\nset.seed = [0, 100]')
    found = points.make_points(points.from_file(tmp_path / "study.toml"))
    assert {(config.task, config.clip, config.seeds) for config in found.values()} == {("ant_2x4", 0.3, 20)}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('task = "lane"', "nothing varies"),
        ("sweep = 3", "has no [[sweep]] table"),
        ('[sweep]\nextends = "lane"\nset = 3', "set must be a table of settings"),
        ('[sweep]\nextends = "lane"\nrandom = 1.5', "random must be a whole number of at least 1, not 1.5"),
        ('[sweep]\nextends = "lane"\nclpi = 0.1', "unknown setting 'clpi'; did you mean 'clip'?"),
        (
            'task = "lane"\n[sweep]\nextends = "noisy"',
            "extends another file only where the file above it names no task",
        ),
        ('[[sweep]]\nextends = "lane"\nclip = 0.1\n[[sweep]]\nextends = "lane"', "two points have the name 'point'"),
        ('[sweep]\nextends = "lane"\nmethod = 3', "method = 3 does not fit: expected a word"),
        ('[sweep]\nextends = "lane"\nset.method = [["f4sg"]]', "method = ['f4sg'] does not fit: expected a word"),
        ("[sweep]\nextends = 3", "'extends' must be one name that pmt envs lists or one path, not 3"),
        ('[sweep]\nextends = "lan"', "extends 'lan', which is not there; did you mean 'lane'?"),
        ('[sweep]\nextends = "lane"\nset.clip = "0.1:0.2"', "clip has a range: add --random N"),
    ],
)
def test_mistakes_in_a_file_get_one_sentence(text: str, says: str, tmp_path: pathlib.Path, cli):
    (tmp_path / "study.toml").write_text(text)
    code, _, err = cli("sweep", tmp_path / "study.toml", "--out", tmp_path / "x")
    assert code == 2 and says in err and err.count("\n") == 1


def test_a_file_of_a_sweep_is_no_run(tmp_path: pathlib.Path, cli):
    (tmp_path / "study.toml").write_text(FILE)
    assert "describes a sweep of many runs: pmt sweep" in cli("train", tmp_path / "study.toml")[2]
    assert "leave out --set and --random" in cli("sweep", tmp_path / "study.toml", "--set", "clip=1", "--out", "x")[2]


def test_options_that_are_given_lie_beside_those_that_vary():
    words = ["env=partition=[[0,1],[2]],partition=[[0],[1,2]]"]
    found = points.make_points([points.from_words("velocity_hopper_3x1", words)], env=["cost=excess"])
    assert list(found) == ["env=partition=0,1+2", "env=partition=0+1,2"]
    options = [dict(config.env) for config in found.values()]
    assert [x["partition"] for x in options] == [((0, 1), (2,)), ((0,), (1, 2))]
    assert all(x["cost"] == "excess" and x["observation"] == "raw" for x in options)
    found = points.make_points([points.from_words("lane", ["env=[num_agents=2,b=1.50],[num_agents=3,b=2]"])])
    assert list(found) == ["env=b=1.5,num_agents=2", "env=b=2,num_agents=3"]


def test_one_value_is_one_point():
    assert list(points.make_points([points.Part("lane", {"env": ["num_agents=3"]})])) == ["env=num_agents=3"]
    with pytest.raises(UsageError, match="does not fit"):
        points.make_points([points.Part("lane", {"clip": ["wide"]})])
