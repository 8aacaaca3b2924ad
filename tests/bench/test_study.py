"""The study's tables: measures and comparisons of stored runs."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest

from bench.tables import later_studies, study
from bench.tables.study import measures, welch


def stored(method: str, seen: float, true_cost: list[float], **settings: float) -> dict:
    """A run of three seeds and ten points whose true episode cost is constant."""
    points, seeds = 10, len(true_cost)
    config = {"cost_seen": seen, "lambda_init": 2.0, "method": method} | settings
    curve = {name: [[1.0] * points] * seeds for name in ("episode_reward", "episode_cost", "violation_rate", "lambda")}
    return {
        "steps": list(range(10, 110, 10)),
        "seeds": list(range(seeds)),
        **curve,
        "episode_length": [[1.0] * points] * seeds,
        "true_episode_cost": [[x] * points for x in true_cost],
        "true_step_cost": [[x / 100] * points for x in true_cost],
        "table": {
            "reward": [1.0] * seeds,
            "cost": [1.0] * seeds,
            "true cost": true_cost,
            "true cost per 1,000 steps while training": [10 * x for x in true_cost],
        },
        "source": "training",
        "task": "lane",
        "method": method,
        "cost_limit": 5.0 * seen,
        "seconds": 1.0,
        "config": "\n".join(f"{k} = {json.dumps(v)}" for k, v in config.items()),
    }


def test_measures_up_to_a_step_come_from_the_curves():
    run = stored("f4sg", 0.5, [4.0, 6.0, 5.0])
    run["true_step_cost"] = [[0.1] * 5 + [0.0] * 5] * 3
    assert measures(run)["training"].tolist() == [40.0, 60.0, 50.0]
    np.testing.assert_allclose(measures(run, until=50)["training"], 100.0)
    np.testing.assert_allclose(measures(run, until=99)["end"], [4.0, 6.0, 5.0])


def test_the_table_compares_fear_with_the_others_of_the_same_share(tmp_path: pathlib.Path):
    low, high = list(np.linspace(1, 2, 12)), list(np.linspace(8, 9, 12))
    cells = [stored("f4sg", 0.5, low), stored("mappo_l", 0.5, high), stored("mappo_l", 0.5, high, lambda_init=4.0)]
    file = tmp_path / "x.json"
    file.write_text(json.dumps(cells))
    lines = study.as_study(file).splitlines()[2:]
    assert [line.split("|")[2].strip() for line in lines] == [
        "MAPPO-L, lambda from 2",
        "MAPPO-L, lambda from 4",
        "F4SG",
    ]
    assert all("12 of 12" in line and "| 1.00 | < .001" in line for line in lines[:2])
    assert "0 of 12" in lines[2] and lines[2].rstrip().endswith("| - | - |")


def test_welch_is_scipys():
    import scipy.stats

    x, y = np.array([1.0, 2.0, 4.0, 9.0]), np.array([0.5, 1.0, 1.5])
    expected = scipy.stats.ttest_ind(x, y, equal_var=False).confidence_interval(0.95)
    middle, half = welch(x, y)
    assert (middle - half, middle + half) == pytest.approx((expected.low, expected.high))


def test_the_second_round_names_each_criterion_that_does_not_hold(tmp_path: pathlib.Path):
    """Candidate C: as cheap as MAPPO-L while training, too costly at the end on the grid."""

    def cells(task: str, share: float, candidate: float, usual: float, base: float) -> list[dict]:
        fear = {"emotion_lr": 0.01, "lambda_kp": 0.0}
        runs = [("f4sg", candidate, fear), ("f4sg", usual, fear | {"emotion_lr": 0.001}), ("mappo_l", base, fear)]
        found = [stored(method, share, list(x + np.linspace(0, 0.5, 12)), **more) for method, x, more in runs]
        return [run | {"task": task} for run in found]

    file = tmp_path / "x.json"
    every = cells("voltage_33", 1.0, 2, 3, 2) + cells("hand_over_2x6", 1.0, 2, 3, 2)
    every += cells("ant_2x4", 0.03, 2, 2, 9) + cells("voltage_33", 0.05, 4, 2, 9)
    file.write_text(json.dumps(every))
    rows = [line.strip("| ").split(" | ") for line in later_studies.as_variant(file).splitlines()[2:]]
    assert [(row[0], row[-1]) for row in rows if "no" in row[-1]] == [("2", "**no**")]
    assert "voltage_33" in next(row[1] for row in rows if "no" in row[-1])
    assert len(rows) == 8
    lines = [line.split("|") for line in later_studies.as_second(file).splitlines()[2:]]
    assert [line[-2].strip() != "-" for line in lines] == [line[3].strip() == "MAPPO-L" for line in lines]


def test_cells_of_a_comparison_are_read_at_the_same_update():
    """Four times the environments take four times the steps; who stopped early is not compared with a later self."""
    early = stored("mappo_l", 0.5, [4.0] * 8, num_envs=16, lr_half_life=2e5)
    late = stored("f4sg", 0.5, [6.0] * 8, num_envs=64, lr_half_life=2e5) | {"steps": list(range(40, 840, 80))}
    late["true_episode_cost"] = [[6.0] * 5 + [1.0] * 5] * 8  # what comes after the other's last update
    rows = [
        [x.strip() for x in line.split("|")[1:-1]] for line in later_studies.compared([[early, late]]).splitlines()[2:]
    ]
    assert [(row[1], row[3]) for row in rows] == [("MAPPO-L", "4.0 +- 0.0"), ("F4SG", "6.0 +- 0.0")]
    assert [row[-2] for row in rows] == ["0 of 8", "8 of 8"]
    assert rows[0][-1] == "-" and rows[1][-1].startswith("< .001")


def test_a_later_form_is_read_at_its_own_end_and_a_cell_without_its_like_alone(tmp_path: pathlib.Path):
    """As the limits' study fixed before its runs: MACPO's runs of eight million steps next to those of ten."""
    falls = [[8.0] * 5 + [2.0] * 5] * 8
    before = [stored("macpo", 1.0, [2.0] * 8, lambda_rule="integral") | {"true_episode_cost": falls, "cost_limit": 1.0}]
    (tmp_path / "limits_less_noise_h100.json").write_text(json.dumps(before))
    short = stored("macpo", 1.0, [4.0] * 8, lambda_rule="integral") | {"cost_limit": 1.0}
    short["steps"] = [x // 2 for x in short["steps"]]
    file = tmp_path / "x.json"
    file.write_text(json.dumps([short, short | {"cost_limit": 10.0}]))
    rows = [
        [x.strip() for x in line.split("|")[1:-1]] for line in later_studies.as_after_less_noise(file).splitlines()[2:]
    ]
    assert [row[3] for row in rows] == ["2.0 +- 0.0", "4.0 +- 0.0", "4.0 +- 0.0"]
    assert [row[-1] == "-" for row in rows] == [True, False, True]


def test_why_gives_both_halves_of_the_critic_and_the_ratio_of_fear(tmp_path: pathlib.Path):
    seen = {"cost_critic/explained_variance": [0.2] * 5 + [0.6] * 5}
    fear = {"fear/on_costly": [0.3] * 10, "fear/on_safe": [0.1] * 10, "fear/ece": [0.01] * 10}
    cells = [stored("f4sg", 0.5, [1.0, 2.0]) | {"diagnostics": seen | fear}]
    cells += [stored("mappo_l", 0.5, [1.0, 2.0]) | {"diagnostics": seen}]
    file = tmp_path / "x.json"
    file.write_text(json.dumps(cells))
    rows = [[x.strip() for x in line.split("|")[2:-1]] for line in study.as_why(file).splitlines()[2:]]
    assert rows[0] == ["MAPPO-L", "0.20", "0.60", "-", "-", "-", "-"]
    assert rows[1] == ["F4SG", "0.20", "0.60", "0.300", "0.1000", "3", "0.0100"]


def test_a_probe_compares_fear_with_the_same_settings_and_corrects_over_all_measures(tmp_path: pathlib.Path):
    """The tables of README and study that are read at their ends: three measures, one family of tests a file."""
    low, high = list(np.linspace(1, 2, 12)), list(np.linspace(8, 9, 12))
    usual = {"cost_value_clip": np.nan, "max_grad_norm": 10.0, "lambda_rule": "integral"}
    pid = {"cost_value_clip": np.inf, "max_grad_norm": np.inf, "lambda_rule": "pid"}

    def cell(method: str, costs: list[float], recipe: dict) -> dict:
        run = stored(method, 0.5, costs)
        run["config"] += "\n" + "\n".join(
            f"{k} = {json.dumps(v).lower().replace('infinity', 'inf')}" for k, v in recipe.items()
        )
        return run

    file = tmp_path / "x.json"
    every = [cell("f4sg", low, usual), cell("mappo_l", high, usual), cell("f4sg", low, pid), cell("mappo_l", low, pid)]
    file.write_text(json.dumps([*every, cell("mappo_l", high, usual | {"cost_value_clip": np.inf})]))
    rows = [[x.strip() for x in line.split("|")[1:-1]] for line in study.as_probe(file).splitlines()[2:]]
    assert [row[2] for row in rows] == [
        "MAPPO-L, as in the study",
        "F4SG, as in the study",
        "MAPPO-L, `cost_value_clip` inf",
        "MAPPO-L, PID for tight limits",
        "F4SG, PID for tight limits",
    ]
    assert all(row[:2] == ["0.5", "5"] for row in rows)
    single = study.u_test(low, high)
    six = study.holm([single, single, 1.0, 1.0, 1.0, 1.0])[0]  # two pairs, three measures each
    assert rows[1][-1] == f"{study.p_value(six)}, {study.p_value(six)}, 1" and rows[4][-1] == "1, 1, 1"
    assert [row[-2] for row in rows] == ["12 of 12", "0 of 12", "12 of 12", "0 of 12", "0 of 12"]
    assert [row[-1] for row in rows if "MAPPO-L" in row[2]] == ["-"] * 3
