"""Curves of runs, as they are drawn."""

from __future__ import annotations

import pathlib
import re

import numpy as np

from by_hand import row, written
from pmt_jax.config.methods import METHODS
from pmt_jax.limits import Limits
from pmt_jax.studies import plot
from pmt_jax.studies.run_log import Group, RunLog, groups, read


def run(method: str, seeds: int = 1, folder: str = "x", **settings: object) -> RunLog:
    values = np.linspace(0, 1, 20) + np.arange(seeds)[:, None]
    metrics = {"episode_reward": values, "episode_cost": 50 * values}
    named = {"method": method, **settings}
    return RunLog(
        pathlib.Path(folder), "lane", method, Limits((1.0,)), named, tuple(range(seeds)), np.arange(1, 21), metrics
    )


def group(*methods: str) -> list[Group]:
    return groups([run(method, 3) for method in methods])


def test_shorter_runs_of_a_group_are_unknown_beyond_their_end(tmp_path: pathlib.Path):
    config = 'task = "lane"\nseed = {}\n'
    lines = {seed: [row(step, seed, 10.0 * step) for step in range(1, length + 1)] for seed, length in ((0, 3), (1, 2))}
    (pooled,) = plot.pooled([read(written(tmp_path / f"{s}", x, config.format(s))) for s, x in lines.items()])
    steps, values = plot.curve(pooled, "episode_reward")
    assert steps.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(values, [[10, 20, 30], [10, 20, np.nan]])


def test_a_method_has_one_colour_everywhere():
    assert set(plot.METHOD_COLOURS) == set(METHODS) and len(set(plot.METHOD_COLOURS.values())) == len(METHODS)
    assert [look.colour for look in plot.looks(group("f4sg", "mappo"))] == [
        plot.METHOD_COLOURS["f4sg"],
        plot.METHOD_COLOURS["mappo"],
    ]
    (alone,) = plot.looks(group("r4sg"))
    assert alone == plot.Look(plot.METHOD_COLOURS["r4sg"])


def test_settings_of_a_method_are_told_apart():
    swept = groups([run("f4sg", lambda_lr=rate) for rate in range(9)])
    assert len(set(plot.looks(swept))) == 9 and plot.looks(swept)[0].colour != plot.looks(swept)[1].colour
    both = groups([run("f4sg", lambda_lr=0.1), run("f4sg", lambda_lr=0.2), run("mappo_l", lambda_lr=0.1)])
    first, second, other = plot.looks(both)
    assert first.colour == second.colour == plot.METHOD_COLOURS["f4sg"] and first.dashes != second.dashes
    assert other == plot.Look(plot.METHOD_COLOURS["mappo_l"])


def test_many_curves_are_lines_with_their_spread_beside_them(tmp_path: pathlib.Path):
    few, many = group("f4sg", "r4sg", "mappo_l"), group(*METHODS)
    assert "band from the lowest to the highest" in plot.caption(few) and "bars on the right" in plot.caption(many)
    assert plot.inline(few, "episode_reward", "reward").count('id="FillBetween') == 3
    assert 'id="FillBetween' not in plot.inline(many, "episode_reward", "reward")


def test_ticks_of_a_cost_axis_can_be_read():
    assert plot.cost_ticks(10, 250) == [0, 5, 10, 20, 50, 100, 200]
    assert plot.cost_ticks(1, 30) == [0, 0.5, 1, 2, 5, 10, 20]
    assert plot.cost_ticks(0.2, 900) == [0, 0.1, 0.2, 1, 10, 100, 1000]
    text = plot.inline(group("mappo"), "episode_cost", "cost")
    assert (
        "linear up to the limit" in text
        and "logarithmic beyond" in text
        and all(f">{tick}<" in text for tick in ("0", "0.5", "1", "10", "100"))
    )


def test_true_costs_are_drawn_where_not_all_are_observed():
    observed = run("f4sg", cost_seen=0.1)
    rate = np.full((1, 20), 0.01)
    metrics = observed.metrics | {"violation_rate": rate, "true_violation_rate": rate, "true_episode_cost": 50 * rate}
    same = groups([RunLog(**{**vars(observed), "metrics": metrics})])
    assert not [name for name in plot.panels(same, plot.TRAINING) if name.startswith("true")]
    metrics = metrics | {"true_violation_rate": 10 * rate}
    (seldom,) = groups([RunLog(**{**vars(observed), "metrics": metrics})])
    assert [n for n in plot.panels([seldom], plot.TRAINING) if n.startswith("true")] == [
        "true_episode_cost",
        "true_violation_rate",
    ]
    assert str(seldom.runs[0].limits_on("true_episode_cost")) == "10"


def test_what_a_task_declares_is_drawn():
    log = run("happo")
    grid = RunLog(**{**vars(log), "task": "voltage_33", "metrics": {"info/total_line_loss": np.ones((1, 20))}})
    shown = groups([grid])
    assert plot.panels(shown, plot.titles(shown)) == ["info/total_line_loss"]
    assert plot.titles(shown)["info/total_line_loss"] == "PL: losses in lines, MW"


def test_long_names_of_many_runs_stand_below_one_another_and_within_the_picture(tmp_path: pathlib.Path):
    config = 'task = "lane"\nemotion_lr = {0}\ncritic_lr = {0}\nclip = {0}\ngamma = 0.{0}\n'
    folders = [written(tmp_path / f"{i}", [row(10, 0, 1.0)], config.format(i)) for i in range(1, 9)]
    out = tmp_path / "curves.svg"
    plot.plot(folders, out)
    names = re.findall(r'<text [^>]* x="([\d.-]+)" y="([\d.-]+)"[^>]*>(mappo_l clip[^<]*)<', out.read_text())
    assert len(names) == 8 and len({y for _, y, _ in names}) == 8
    width = float(re.findall(r'width="([\d.]+)pt"', out.read_text())[0])
    assert all(0 < float(x) < width - 4 * len(text) for x, _, text in names)  # a letter is over 4 points wide


def test_plot_draws_every_metric_that_there_is(tmp_path: pathlib.Path, cli):
    fearful = [row(10, s, 1.0, method="f4sg", **{"fear/brier": 0.1, "lambda": 1.0}) for s in (0, 1)]
    written(tmp_path / "a", fearful, 'task = "lane"\nmethod = "f4sg"\n')
    written(tmp_path / "b", [row(10, 0, 1.0, episode_cost=0.5), row(20, 0, 2.0, episode_cost=None)])
    (tmp_path / "nothing").mkdir()
    out = tmp_path / "curves.svg"
    code, _, err = cli("plot", *sorted(tmp_path.iterdir()), "-o", out)
    assert code == 0 and f"left out: {tmp_path / 'nothing'} holds no run" in err
    text = out.read_text()
    for words in (
        "reward of an episode",
        "dashed: limit",
        "multiplier",
        "fear: Brier score",
        "f4sg (2 seeds)",
        "mappo_l",
    ):
        assert words in text
    assert "regret" not in text
