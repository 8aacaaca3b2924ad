"""The study's tables: measures and comparisons of stored runs."""

from __future__ import annotations

import json
import pathlib

import numpy as np

from bench.tables import study


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
