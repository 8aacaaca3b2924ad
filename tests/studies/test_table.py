"""Tables of runs: what stands in them is what the runs did."""

from __future__ import annotations

import json
import pathlib
import re

import numpy as np
import pytest
import scipy.stats

from by_hand import made, row, written
from pmt_jax.config.methods import METHODS
from pmt_jax.limits import Limits
from pmt_jax.studies import plot, statistics
from pmt_jax.studies.rows import TableRow, rows
from pmt_jax.studies.run_log import Group, RunLog, groups, read, read_all
from pmt_jax.training import final


def test_a_table_by_hand(tmp_path: pathlib.Path, cli):
    made(tmp_path / "a", "lane", "mappo_l", {0: [1, 1], 1: [2, 1], 2: [3, 0.5]})
    made(tmp_path / "b", "lane", "f4sg", {0: [1, 0], 1: [8, 0]})
    made(tmp_path / "c", "lane", "f4sg", {5: [2, 0], 6: [3, 0.8]}, seed=5)  # more seeds of the same
    code, out, _ = cli("table", tmp_path, "--format", "json", "--baseline", "mappo_l")
    data = {row["method"]: row for row in json.loads(out)["rows"]}
    assert code == 0 and list(data) == ["mappo_l", "f4sg"]
    low, high = statistics.mean_interval([1, 2, 3])
    assert data["mappo_l"]["reward"] == pytest.approx({"iqm": 2, "low": low, "high": high, "mean": 2, "std": 1})
    assert data["f4sg"]["seeds"] == 4 and data["f4sg"]["reward"]["iqm"] == 2.5  # 1 and 8 are cut off
    rate = data["f4sg"]["violation rate"]
    assert rate["iqm"] == rate["low"] == rate["high"] == 0.25 and rate["std"] == 0
    assert data["f4sg"]["cost"]["low"] == 0  # no interval reaches below what a cost can be
    assert data["mappo_l"]["within"] == 1 and data["f4sg"]["worst"] == 0.8
    # 12 pairs: 1 ties with 1; 8 wins 3; 2 wins 1 and ties 1; 3 wins 2 and ties 1.
    assert data["f4sg"]["better"]["more reward"]["probability"] == 7.5 / 12
    assert data["f4sg"]["better"]["less cost"]["probability"] == (3 * 3 + 2) / 12  # less cost is better
    assert data["mappo_l"]["better"] is None


def test_cost_beyond_is_of_true_costs_where_few_were_noticed(tmp_path: pathlib.Path, cli):
    beyond = {"true_episode_cost": 11.0, "episode_cost_beyond": 5.0}
    made(tmp_path / "a", "lane", "mappo_l", {0: [1, 5.5]}, cost_seen=0.5, **beyond)
    (data,) = json.loads(cli("table", tmp_path, "--format", "json")[1])["rows"]
    assert (data["true cost"]["mean"], data["cost beyond"]["mean"]) == (11, 10)


def test_a_table_says_how_the_limit_was_kept(tmp_path: pathlib.Path, cli):
    """Shares of episodes at the end; the excess over all of training."""
    lines = [
        row(
            100 * step,
            seed,
            1.0,
            episode_cost=0.5 + seed,
            within_limit=step / 20,
            episode_cost_beyond=seed * (20.0 - step),
        )
        for step in range(1, 21)
        for seed in (0, 1)
    ]
    written(tmp_path / "a", lines)
    (data,) = json.loads(cli("table", tmp_path, "--format", "json")[1])["rows"]
    assert data["episodes within"]["mean"] == pytest.approx((19 + 20) / 40)
    assert data["cost beyond"]["mean"] == pytest.approx((0 + 9.5) / 2)
    assert (data["within"], data["worst"]) == (0.5, 1.5)


def test_limits_are_those_of_the_costs_beside_them(tmp_path: pathlib.Path, cli):
    """Each of several; on true costs where not all are observed."""
    each = {"cost_limit": 25.1, "cost_limit/0": 25.0, "cost_limit/1": 0.1, "episode_cost": 3.0}
    each |= {"episode_cost/0": 2.0, "episode_cost/1": 1.0}
    written(tmp_path / "two", [row(100, 0, 1.0, **each)])
    old = each | {"cost_limit": 60.0, "cost_limit/0": 50.0, "cost_limit/1": 10.0}  # before --change
    (tmp_path / "two" / "metrics.jsonl").write_text(row(50, 0, 1.0, **old) + row(100, 0, 1.0, **each))
    text = cli("table", tmp_path / "two")[1]
    assert "  25 + 0.1  0/1  " in text and "each must be within its own limit" in text
    seen = {"cost_limit": 0.3, "episode_cost": 0.24, "true_episode_cost": 0.8}
    written(tmp_path / "seen", [row(100, 0, 1.0, **seen)], 'task = "lane"\ncost_seen = 0.3\n')
    line = cli("table", tmp_path / "seen")[1].splitlines()[2]
    assert line.split()[-3:] == ["1", "1/1", "0.8"]
    made(tmp_path / "all", "lane", "happo", {0: [1, 0.5]}, true_episode_cost=0.5)
    assert "true cost (limit 1)" in cli("compare", tmp_path / "seen", tmp_path / "all")[1]


def test_what_mean_actions_cost_is_what_they_are_judged_by(tmp_path: pathlib.Path, cli):
    """True costs, where not all are noticed; a seed that broke has no cost and is not within."""
    seen = {"cost_limit": 0.1, "episode_cost": 0.05, "true_episode_cost": 0.5}
    lines = [row(100, seed, 1.0, **seen, **({"broken": "a weight"} if seed == 2 else {})) for seed in range(3)]
    run = written(tmp_path / "seen", lines, 'task = "lane"\ncost_seen = 0.1\n')
    ended = json.loads(row(100, 0, 2.0, cost_limit=0.1, episode_cost=0.05))
    final.write(run, [ended | {"seed": seed, "true_episode_cost": cost} for seed, cost in enumerate((0.5, 3.0))])
    (data,) = json.loads(cli("table", tmp_path, "--format", "json")[1])["rows"]
    assert (data["mean_actions"]["within"], data["mean_actions"]["seeds"]) == (1, 3)
    (log,) = read_all([run])
    (found,) = rows([log])
    np.testing.assert_allclose(found.deployed["cost"], [0.5, 3.0, np.nan])
    np.testing.assert_allclose(found.deployed["beyond"], [-0.5, 2.0, np.nan])


def test_a_mistake_in_one_of_many_runs_names_its_file(tmp_path: pathlib.Path, cli):
    made(tmp_path / "good", "lane", "happo", {0: [1, 1]})
    bad = written(tmp_path / "bad", [row(100, 0, 1.0)], 'task = "lane"\nclipp = 1\n')
    code, _, err = cli("table", tmp_path)
    assert code == 2 and f"{bad / 'config.toml'}: unknown setting 'clipp'" in err
    (bad / "config.toml").write_text('task = "lane"\n')
    (bad / "changes.jsonl").write_text('{"step": "x", "changed": [1]}\n')
    code, _, err = cli("table", tmp_path)
    assert code == 2 and f"{bad / 'changes.jsonl'}: a line is not of the form" in err


def test_a_table_says_who_left_the_corridor(tmp_path: pathlib.Path, cli):
    made(tmp_path / "a", "ant_2x4", "happo", {0: [1, 1]}, **{"info/outside": 0.5})
    made(tmp_path / "b", "lane", "happo", {0: [1, 1]})
    assert "outside: share of steps beyond a wall" in cli("table", tmp_path / "a")[1]
    head, _, ant, lane = cli("table", tmp_path)[1].splitlines()[:4]
    place = head.index("outside")
    assert ant[place:].startswith("0.5 [-] ") and lane[place:].startswith("- ")
    assert "outside" not in cli("table", tmp_path / "b")[1]


def test_settings_that_differ_make_rows_of_their_own(tmp_path: pathlib.Path, cli):
    made(tmp_path / "a", "lane", "happo", {0: [1, 1]}, clip=0.1)
    made(tmp_path / "b", "lane", "happo", {0: [2, 2]}, clip=0.2)
    code, out, _ = cli("table", tmp_path / "a", tmp_path / "b")
    assert code == 0 and "happo clip=0.1" in out and "happo clip=0.2" in out
    assert "'happo' means several rows of lane" in cli("table", tmp_path, "--baseline", "happo")[2]
    assert cli("table", tmp_path, "--baseline", "happo clip=0.1")[0] == 0
    made(tmp_path / "c", "lane", "happo", {0: [3, 3]}, clip=0.2)
    assert "seed 0 counts twice" in cli("table", tmp_path)[2]


def test_figures_come_from_evaluations_where_there_are_any(tmp_path: pathlib.Path, cli):
    judged = {"eval/episode_reward": 7.0, "eval/episode_cost": 0.5, "eval/violation_rate": 0.125}
    made(tmp_path / "a", "lane", "happo", {0: [1, 1]}, **judged)
    made(tmp_path / "b", "lane", "mappo", {0: [1, 1]})
    text = cli("table", tmp_path)[1]
    happo, mappo = (next(line for line in text.splitlines() if f" {m} " in line) for m in ("happo", "mappo"))
    assert happo.split()[4:10] == ["7", "[-]", "0.5", "[-]", "0.125", "[-]"] and mappo.split()[4:6] == ["1", "[-]"]
    assert "evaluation episodes (mean actions)" in text and "training episodes (sampled actions)" in text


def test_a_seed_without_a_figure_shows(tmp_path: pathlib.Path, cli):
    made(tmp_path / "a", "lane", "happo", {0: [1, 1], 1: [None, None]})
    made(tmp_path / "b", "lane", "mappo", {0: [1, 1]}, broken="critic/loss of seed 0 is nan")
    made(tmp_path / "c", "noisy", "happo", {0: [1, 1]})
    lines = [line.split() for line in cli("table", tmp_path, "--baseline", "mappo")[1].splitlines()[2:5]]
    assert lines[0][:6] == ["lane", "mappo", "1", "10,000", "-", "-"]
    assert lines[1][:6] == ["lane", "happo", "2", "10,000", "-", "-"]
    assert lines[2][:6] == ["noisy", "happo", "1", "10,000", "1", "[-]"]  # a task without the baseline


def test_the_papers_numbers_stand_beside_ours_in_every_format(tmp_path: pathlib.Path, cli):
    made(tmp_path / "a", "ant_2x4", "f4sg", {0: [100, 1]})
    made(tmp_path / "b", "voltage_33", "happo", {0: [1, 1]}, **{"info/totally_controllable_ratio": 0.5})
    text = cli("table", tmp_path)[1]
    ant = next(line for line in text.splitlines() if line.startswith("ant_2x4"))
    assert ant.endswith("2880.68 ± 106.21  4.02 ± 1.46") and "ant_2x4: Table 1" in text
    assert "CR" in text and "PL" not in text.splitlines()[0]
    target = tmp_path / "table.md"
    code, out, _ = cli("table", tmp_path, "--format", "markdown", "-o", target)
    assert code == 0 and out == f"wrote {target}\n"
    assert cli("table", tmp_path, "--format", "json", "-o", "/dev/null")[1] == ""
    lines = target.read_text().splitlines()
    assert lines[1] == "|---" * (lines[0].count("|") - 1) + "|" and "| 2880.68 ± 106.21 | 4.02 ± 1.46 |" in lines[2]
    latex = cli("table", tmp_path, "--format", "latex")[1]
    assert r"ant\_2x4 & f4sg & 1 & " in latex and latex.rstrip().endswith(r"\end{tabular}")


def test_reported_figures_of_others_come_with_their_provenance(tmp_path: pathlib.Path, cli):
    made(tmp_path / "a", "velocity_ant_2x4", "macpo", {0: [100, 1]})
    made(tmp_path / "b", "velocity_half_cheetah_2x3", "mappo_l", {0: [100, 1]})
    made(tmp_path / "c", "velocity_swimmer_2x1", "mappo_l", {0: [100, 1]})
    text = cli("table", tmp_path)[1]
    ant, cheetah, swimmer = text.splitlines()[2:5]
    assert ant.split()[-4:] == ["1099.23", "3.39", "798.00", "10.50"]
    assert cheetah.split()[-4:] == ["-", "-", "1141.00", "0.00"] and swimmer.split()[-4:] == ["-"] * 4
    assert (
        "rerun reward" in text
        and "velocity_ant_2x4, velocity_half_cheetah_2x3, paper: second hand" in text
        and "not verified." in text
    )


def test_improvement_over_all_tasks_weighs_tasks_alike(tmp_path: pathlib.Path, cli):
    for task, reward in (("lane", 5), ("noisy", 1)):
        made(tmp_path / task / "base", task, "mappo_l", {0: [2, 1], 1: [3, 1]})
        made(tmp_path / task / "ours", task, "f4sg", {0: [reward, 1]})
    text = cli("table", tmp_path, "--baseline", "mappo_l")[1]
    assert "All tasks together, f4sg: P(more reward) 0.5 [" in text and ", P(less cost) 0.5 [" in text


def test_tables_that_cannot_be_made(tmp_path: pathlib.Path, cli):
    assert f"{tmp_path} holds no run" in cli("table", tmp_path)[2]
    made(tmp_path / "a", "lane", "happo", {0: [1, 1]})
    assert "unknown format 'html'" in cli("table", tmp_path, "--format", "html")[2]
    assert "no row is called 'mappo'; did you mean 'happo'?" in cli("table", tmp_path, "--baseline", "mappo")[2]
    assert "cannot write" in cli("table", tmp_path, "-o", tmp_path / "a" / "config.toml" / "where")[2]
    assert "name a row with --baseline" in cli("table", tmp_path, "--test")[2]


def test_the_best_row_is_the_one_with_most_reward_within_the_limit():
    def row(reward: float, cost: float) -> TableRow:
        scores = {"reward": np.array([reward]), "cost": np.array([cost])}
        return TableRow("lane", "happo", "", Limits((1.0,)), 1, "training", scores)

    best = [row(2, 1.0), row(1, 0.0), row(9, 1.5), row(5, 3.0), row(np.nan, np.nan)]
    shuffled = [best[i] for i in (4, 2, 0, 3, 1)]
    assert sorted(shuffled, key=lambda r: r.rank) == best


def test_seeds_beyond_the_limit_show(tmp_path: pathlib.Path, cli):
    made(tmp_path / "a", "lane", "happo", {0: [1, 0.5], 1: [1, 1.0], 2: [1, 4.25], 3: [1, 0]})
    made(tmp_path / "b", "lane", "mappo", {0: [1, 0.5], 1: [None, None]})
    text = cli("table", tmp_path)[1]
    mappo, happo = (line.split() for line in text.splitlines()[2:4])
    assert happo[-2:] == ["3/4", "4.25"] and mappo[-2:] == ["1/2", "-"]  # a seed without a cost keeps no limit
    assert "seeds within: seeds whose cost is within it" in text


def test_true_costs_show_where_not_all_are_observed(tmp_path: pathlib.Path, cli):
    true = {"true_episode_cost": 5.0, "true_violation_rate": 0.25, "true_step_cost": 0.2}
    made(tmp_path / "observed", "lane", "mappo_l", {0: [1, 5.0]}, **true)
    assert "true" not in cli("table", tmp_path / "observed")[1]
    true["true_violation_rate"] = 0.5
    made(tmp_path / "seldom", "lane", "f4sg", {0: [1, 0.5], 1: [2, 0.4]}, cost_seen=0.1, **true)
    code, out, _ = cli("table", tmp_path, "--format", "json", "--baseline", "mappo_l")
    row = {row["method"]: row for row in json.loads(out)["rows"]}["f4sg"]
    assert code == 0 and row["true cost"]["iqm"] == 5 and row["true step cost"]["iqm"] == 0.2
    assert row["within"] == 1 and row["worst"] == 5  # the limit on what is observed is 1, a tenth of 10
    assert row["better"]["less true cost"]["probability"] == 0.5


def test_tests_against_the_baseline_are_corrected_for_their_number(tmp_path: pathlib.Path, cli):
    scores = {"mappo_l": range(5), "f4sg": range(10, 15), "r4sg": [-1, 1.5, 2.5, 3.5, 6]}
    for method, values in scores.items():
        made(tmp_path / method, "lane", method, {i: [x, 0.1 * x**2] for i, x in enumerate(values)})
    code, out, _ = cli("table", tmp_path, "--format", "json", "--baseline", "mappo_l", "--test")
    rows = {row["method"]: row for row in json.loads(out)["rows"]}
    raw = {method: scipy.stats.mannwhitneyu(scores[method], scores["mappo_l"]).pvalue for method in ("f4sg", "r4sg")}
    assert code == 0 and raw["f4sg"] == pytest.approx(2 / 252) and raw["r4sg"] > 0.5
    assert rows["f4sg"]["p"]["more reward"] == pytest.approx(2 * raw["f4sg"])  # the smaller of two
    assert rows["r4sg"]["p"]["more reward"] == pytest.approx(raw["r4sg"])
    assert rows["mappo_l"]["p"] is None
    text = cli("table", tmp_path, "--baseline", "mappo_l", "--test")[1]
    assert "p (more reward)" in text and " 0.016 " in text and "Holm's correction" in text
    assert "p (" not in cli("table", tmp_path, "--baseline", "mappo_l")[1]


def test_a_table_is_written_whole_or_not_at_all(tmp_path: pathlib.Path, cli, monkeypatch):
    made(tmp_path / "a", "lane", "happo", {0: [1, 1]})
    target = tmp_path / "table.txt"
    target.write_text("before")

    def full(path: pathlib.Path, text: str) -> None:
        path.touch()
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(pathlib.Path, "write_text", full)
        assert "No space left on device" in cli("table", tmp_path, "-o", target)[2]
    assert target.read_text() == "before" and len(list(tmp_path.iterdir())) == 2


# ---------------------------------------------------------------------------------------------------------------------
# Curves of runs, as they are drawn


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
