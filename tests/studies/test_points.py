"""What a sweep trains: combinations, draws, and files that list them."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest

from pmt_jax.errors import UsageError
from pmt_jax.studies import points, sweep


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--set", "lamda_lr=1"], "unknown setting 'lamda_lr'; did you mean 'lambda_lr'?"),
        (["--set", "clip"], "--set takes NAME=VALUE,VALUE,..., or with --random NAME=LOW:HIGH, not 'clip'"),
        (["--set", "clip=0.1,wide"], "clip = 'wide' does not fit: expected a number"),
        (["--set", "method=happo,hapo"], "unknown method 'hapo'; did you mean 'happo'?"),
        (["--set", "task=lane,noisy"], "--set has one task"),
        ([], "nothing varies: give --set NAME=VALUE,..., or a TOML file with a [sweep] table"),
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
        ("sweep = 3", "has no [sweep] table"),
        ('[sweep]\nextends = "lane"\nset = 3', "set must be a table of settings"),
        ('[sweep]\nextends = "lane"\nrandom = 1.5', "random must be a whole number, not 1.5"),
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
