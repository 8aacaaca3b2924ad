"""The tables of the study's second and third studys: cells with the one they are compared with, variants next to
their criteria.

Cells are read at a common update, as the preregistration says: in the second study the last that all cells of the task
reached, in the third the last that the cells of a comparison reached.
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pmt_jax.config.settings import Config
from pmt_jax.studies.statistics import holm, iqm, probability_of_improvement, u_test

from . import runs
from .speed import markdown
from .study import (
    NAMES,
    Scores,
    baseline,
    difference,
    label,
    mean_sd,
    measures,
    p_value,
    pooled,
    settings,
    share,
    unsafe,
    welch,
)

Read = Callable[[Sequence[runs.Run]], list[dict[str, Scores]]]

MEASURES = ("end", "training", "reward")
AS_IT_IS = {"method": "f4sg", "emotion_lr": 0.001, "fear_lr_start": 0.0}
A, C, D = (
    {"emotion_lr": 0.003},
    {"emotion_lr": 0.01},
    {"fear_lr_start": 0.01},
)  # question b, all with `fear_start` nan


def _read(cells: Sequence[runs.Run], among: Sequence[runs.Run] = ()) -> list[dict[str, Scores]]:
    """The measures of each cell at the last update that all of them, and all of `among`, reached."""
    last = min(max(run["steps"]) / _environments(run) for run in (*cells, *among))
    return [measures(run, last * _environments(run)) for run in cells]


def _at_their_ends(cells: Sequence[runs.Run]) -> list[dict[str, Scores]]:
    """The measures of each cell at its own last update."""
    return [measures(run, max(run["steps"])) for run in cells]


def _environments(run: runs.Run) -> int:
    return settings(run).get("num_envs", Config.num_envs)


def as_second(file: pathlib.Path) -> str:
    """The second study: a row a cell; p corrected over the comparisons of one task with F4SG as it is."""
    found = sorted(runs.load(file), key=lambda run: (run["task"], -share(run), -list(NAMES).index(run["method"])))
    body = []
    for task in dict.fromkeys(run["task"] for run in found):
        cells = [run for run in found if run["task"] == task]
        scores = _read(cells)
        pairs = [(i, _fear_as_it_is(cells, run)) for i, run in enumerate(cells) if run["method"] == "mappo_l"]
        p = holm([u_test(scores[i]["end"], scores[j]["end"]) for i, j in pairs])
        corrected = {i: value for (i, _), value in zip(pairs, p, strict=True)}
        for i, (run, own) in enumerate(zip(cells, scores, strict=True)):
            base = baseline(run, cells)
            less = "-" if base is None or base is run else difference(own, scores[cells.index(base)])
            line = [task, f"{share(run):g}", label(run, [x for x in cells if share(x) == share(run)])]
            line += [mean_sd(own["end"]), mean_sd(own["training"]), less, mean_sd(own["reward"])]
            body.append([*line, unsafe(run, own), p_value(corrected[i]) if i in corrected else "-"])
    head = ["task", "p", "method", "true cost at the end", "true cost per 1,000 steps, training"]
    head += ["less MAPPO-L's [95 %]", "reward", "unsafe seeds", "corrected p, F4SG's cost at the end"]
    return markdown(head, body)


def _fear_as_it_is(cells: Sequence[runs.Run], run: runs.Run) -> int:
    """F4SG's cell with default settings at the p of `run`."""
    return cells.index(_cell(cells, run["task"], share(run), **AS_IT_IS))


def as_variant(file: pathlib.Path) -> str:
    """Question b in the second study: variant C against each criterion of the preregistration."""
    found = runs.load(file)
    body = _while_training(found, ("voltage_33", "hand_over_2x6"), C, among=found)
    body += _at_the_end(found, (("ant_2x4", 0.03), ("voltage_33", 0.05)), C, among=found)
    return _as_criteria(body, "variant C")


def as_variant_late(file: pathlib.Path) -> str:
    """Variant C of the second study on the ant, read at the last update of the three cells; an exploration."""
    return _as_criteria(_at_the_end(runs.load(file), (("ant_2x4", 0.03),), C), "variant C, read later")


def as_variant_a(file: pathlib.Path) -> str:
    """Question b in the third study: variant A against the same criteria, next to cells of the second study."""
    found = [run for run in runs.load(file) if settings(run)["emotion_lr"] == A["emotion_lr"]] + _second(file)
    body = _while_training(found, ("voltage_33", "hand_over_2x6"), A)
    body += _at_the_end(found, (("ant_2x4", 0.03), ("voltage_33", 0.05)), A)
    return _as_criteria(body, "variant A")


def as_variant_half_life(file: pathlib.Path) -> str:
    """Question b in the third study: variant C on the grid with a half-life, and what the half-life alone does."""
    found = runs.load(file)
    body = _while_training(found, ("voltage_33",), C, lr_half_life=2e5)
    body += _at_the_end(found, (("voltage_33", 0.05),), C, lr_half_life=2e5)
    halving, without = _read(
        [
            _cell(found, "voltage_33", 1.0, method="mappo_l", lr_half_life=2e5),
            _cell(_second(file), "voltage_33", 1.0, method="mappo_l"),
        ]
    )
    for name, what, sign in (("reward", "reward", -1), ("end", "true cost", 1)):
        p = u_test(halving[name], without[name])
        worse = p < 0.05 and sign * (halving[name].mean() - without[name].mean()) > 0
        text = f"{mean_sd(halving[name])}; {mean_sd(without[name])}; p {p_value(p)}"
        body.append(["4", f"MAPPO-L's {what} at the end, against a constant learning rate's, p = 1", text, not worse])
    return _as_criteria(body, "with `lr_half_life` 2e5")


def as_variant_d(file: pathlib.Path) -> str:
    """Question b in the fourth study: variant D, fast in its first updates only, against the same criteria."""
    found = runs.load(file)
    body = _while_training(found, ("voltage_33", "hand_over_2x6"), D)
    body += _at_the_end(found, (("ant_2x4", 0.03), ("voltage_33", 0.05)), D)
    return _as_criteria(body, "variant D")


def as_fourth(file: pathlib.Path) -> str:
    """Cells of the fourth and the sixth study, those of one task and p next to MAPPO-L, without question f."""
    found = [run for run in runs.load(file) if run["task"] != "ant_4x2"]
    groups = dict.fromkeys((run["task"], share(run)) for run in found)
    cells = [[run for run in found if (run["task"], share(run)) == group] for group in groups]
    return compared([_first(same, method="mappo_l") for same in cells])


def as_fifth(file: pathlib.Path) -> str:
    """Question b in the fifth study: criterion 1 on the grid, over the seeds of the fourth study and of this one."""
    both = [runs.load(file.with_name("study_fourth_h200.json")), runs.load(file)]
    variant, base = (
        pooled([_read([_cell(found, "voltage_33", 1.0, **cell)])[0] for found in both])
        for cell in ({"method": "f4sg", **D}, {"method": "mappo_l"})
    )
    return _as_criteria([_lag("voltage_33", variant, base)], "variant D, 80 seeds")


def as_power(file: pathlib.Path) -> str:
    """Question f: F4SG against MAPPO-L on the ant 4x2, 30 seeds, at the last update that both reached."""
    return compared([_first([run for run in runs.load(file) if run["task"] == "ant_4x2"], method="mappo_l")])


def _while_training(
    found: Sequence[runs.Run],
    tasks: Sequence[str],
    variant: dict[str, Any],
    among: Sequence[runs.Run] = (),
    **more: Any,
) -> list:
    """Criterion 1: true cost while training within 1 of MAPPO-L's in 1,000 steps, its interval below 5."""
    body = []
    for task in tasks:
        cells = [_cell(found, task, 1.0, method="f4sg", **variant, **more)]
        cells.append(_cell(found, task, 1.0, method="mappo_l", **more))
        body.append(_lag(task, *_read(cells, [run for run in among if run["task"] == task])))
    return body


def _lag(task: str, own: dict[str, Scores], base: dict[str, Scores]) -> list:
    middle, half = welch(own["training"], base["training"])
    what = f"true cost while training, less MAPPO-L's, `{task}`, p = 1"
    return ["1", what, difference(own, base), middle < 1 and middle + half < 5]


def _at_the_end(
    found: Sequence[runs.Run],
    where: Sequence[tuple[str, float]],
    variant: dict[str, Any],
    among: Sequence[runs.Run] = (),
    **more: Any,
) -> list:
    """Criteria 2 and 3: true cost no worse than F4SG's as it is and below MAPPO-L's, reward nearly F4SG's."""
    body = []
    for task, seen in where:
        wanted = ({"method": "f4sg", **variant}, AS_IT_IS, {"method": "mappo_l", "lambda_kp": 0.0})
        cells = [_cell(found, task, seen, **cell, **more) for cell in wanted]
        own, usual, base = _read(cells, [run for run in among if run["task"] == task])
        at = f"`{task}`, p = {seen:g}"
        ends = [mean_sd(x["end"]) for x in (own, usual, base)]
        above, below = u_test(own["end"], usual["end"]), u_test(own["end"], base["end"])
        worse = above < 0.05 and probability_of_improvement([own["end"]], [usual["end"]]) > 0.5
        what = f"{ends[0]}; {ends[1]}; p {p_value(above)}"
        body.append(["2", f"true cost at the end against F4SG's, {at}", what, not worse])
        what = f"{ends[0]}; {ends[2]}; p {p_value(below)}"
        lower = below < 0.01 and probability_of_improvement([own["end"]], [base["end"]]) < 0.5
        body.append(["2", f"true cost at the end below MAPPO-L's, {at}", what, lower])
        ant = task.startswith("ant")
        least = 0.9 * usual["reward"].mean() if ant else usual["reward"].mean() - usual["reward"].std(ddof=1)
        text = f"{mean_sd(own['reward'])}; at least {least:.{0 if ant else 2}f}"
        body.append(["3", f"reward at the end, {at}", text, own["reward"].mean() >= least])
    return body


def _as_criteria(body: list, name: str) -> str:
    body = [[*line, "yes" if holds else "**no**"] for *line, holds in sorted(body, key=lambda line: line[0])]
    return markdown(["criterion", "measure", name, "holds"], body)


def as_lag_in_time(file: pathlib.Path) -> str:
    """Question b: fear of costly and of other steps on the hands in the first updates, as it is and variant A's."""
    cells = [_cell(_second(file), "hand_over_2x6", 1.0, **AS_IT_IS), _cell(runs.load(file), "hand_over_2x6", 1.0, **A)]
    updates = (1, 2, 3, 4, 6, 8, 12, 16, 20, 24)  # one point of the curves each
    body = []
    for run in cells:
        for name, what in (("on_costly", "a step observed as costly"), ("on_safe", "others")):
            found = run["diagnostics"][f"fear/{name}"]
            body.append([label(run, cells), what, *(f"{found[update - 1]:.2f}" for update in updates)])
    return markdown(["method", "mean fear of", *(f"update {update}" for update in updates)], body)


def as_half_life(file: pathlib.Path) -> str:
    """Question b in the third study: a half-life on the grid, next to MAPPO-L with it at the same p."""
    found = [run for run in runs.load(file) if settings(run)["lr_half_life"] == 2e5]
    groups = [[x for x in found if share(x) == seen] for seen in (1.0, 0.05)]
    return compared([_first(cells, method="mappo_l") for cells in groups])


def as_batch(file: pathlib.Path) -> str:
    """Question a in the third study: MAPPO-L with four times the environments, next to the first and the second study.

    Rows are read at the same number of updates, so the larger batch has had four times the steps.
    """
    batch = _cell(runs.load(file), "ant_2x4", 0.03, method="mappo_l", num_envs=1536)
    first = runs.load(file.with_name("study_ant_2x4_h200.json"))
    usual = {"method": "mappo_l", "lambda_kp": 0.0, "lambda_init": 2.0}
    pairs = [[_cell(found, "ant_2x4", 0.03, **cell) for cell in (AS_IT_IS, usual)] for found in (_second(file), first)]
    return compared([[*pair, batch] for pair in pairs])


def as_sway(file: pathlib.Path) -> str:
    """Question e: a corridor that moves, seen and hidden; F4SG and R4SG against MAPPO-L."""
    found = [run for run in runs.load(file) if settings(run)["sway"] != "none"]
    groups = [[x for x in found if settings(x)["sway"] == sway] for sway in ("seen", "hidden")]
    return compared([_first(cells, method="mappo_l") for cells in groups])


def as_responses(file: pathlib.Path) -> str:
    """Question c under noise: the variants of R4SG on the grid against MAPPO-L of the second study."""
    variants = [run for run in runs.load(file) if run["method"] == "r4sg" and run["task"] == "voltage_33"]
    return compared([[_cell(_second(file), "voltage_33", 0.05, method="mappo_l"), *variants]])


def as_prior(file: pathlib.Path) -> str:
    """Question d: F4SG with the fear of another task from the first step on, next to F4SG that starts afresh."""
    return compared([_prior_last(file)])


def as_prior_in_time(file: pathlib.Path) -> str:
    """Question d: fear of the steps observed as costly, and true cost, in each tenth of the run; seeds' means."""
    body = []
    for run in _prior_last(file):
        fear = run["diagnostics"]["fear/on_costly"]
        cost = 1000 * np.nanmean(np.array(run["true_step_cost"], float), axis=0)
        name = label(run, _prior_last(file))
        body.append([name, "fear of a step observed as costly", *(f"{x:.2f}" for x in fear)])
        body.append([name, "true cost per 1,000 steps", *(f"{x:.0f}" for x in cost)])
    return markdown(["method", "mean", *(f"to {x / 1e6:.1f} M" for x in run["steps"])], body)


def as_against_mappo_l(file: pathlib.Path) -> str:
    """All cells of a file next to MAPPO-L, at the last update that all of them reached."""
    return compared([_first(runs.load(file), method="mappo_l")])


def as_against_f4sg(file: pathlib.Path) -> str:
    """All cells of a file next to F4SG, at the last update that all of them reached."""
    return compared([_first(runs.load(file), method="f4sg")])


def as_unclipped(file: pathlib.Path) -> str:
    """Limits: cells without a clip on cost values next to those of the same method, rule and limit with it."""
    return _beside_their_like(file, "limits_pid_h200", "limits_control_h200", "limits_macpo_02_h200")


def as_less_noise(file: pathlib.Path) -> str:
    """Limits: cells with less noise at the end next to those of the same method, rule and limit without it."""
    return _beside_their_like(file, "limits_unclipped_h200")


def as_after_less_noise(file: pathlib.Path) -> str:
    """Limits: cells of a later setting next to those of less noise, each at its own end."""
    return _beside_their_like(file, "limits_less_noise_h100", read=_at_their_ends)


def as_noise_in_time(file: pathlib.Path) -> str:
    """Limits: noise of actions, cost and seeds within in each half million steps from six million on.

    The standard deviation is the seeds' mean, the cost their interquartile mean; a seed's cost is that of its rows.
    """
    width, found, body = 0.5e6, runs.load(file), []
    ends = np.arange(6.5e6, max(max(run["steps"]) for run in found), width)
    for run in found:
        log, noise = runs.curves(run), np.array(run["diagnostics"]["actor/std"], float)
        windows = [(log.steps > end - width) & (log.steps <= end) for end in ends]
        costs = [np.nanmean(log.metrics["episode_cost"][:, at], axis=1) for at in windows]
        std = [noise[at].mean() for at in windows]
        name = label(run, found)
        body.append([name, "standard deviation", *(f"{x:.3f}" for x in std)])
        body.append([name, "cost", *(f"{iqm(x):.2f}" for x in costs)])
        body.append([name, "seeds within", *(f"{(x <= run['cost_limit']).sum()}" for x in costs)])
    return markdown(["cell", "of half a million steps", *(f"to {x / 1e6:g} M" for x in ends)], body)


def _beside_their_like(file: pathlib.Path, *names: str, read: Read = _read) -> str:
    """Each cell of `file` next to the one of the files `names` that has its method, multiplier's rule and limit.

    One without its like is alone.
    """
    found = [run for name in names for run in runs.load(file.with_name(f"{name}.json"))]

    def cell(run: runs.Run) -> tuple[Any, ...]:
        return run["method"], settings(run)["lambda_rule"], run["cost_limit"]

    like = {cell(run): run for run in found}
    return compared([[*filter(None, [like.get(cell(run))]), run] for run in runs.load(file)], read)


def _prior_last(file: pathlib.Path) -> list[runs.Run]:
    return sorted(runs.load(file), key=lambda run: bool(settings(run)["init_fear"]))


def compared(groups: Sequence[Sequence[runs.Run]], read: Read = _read) -> str:
    """A row a cell; those of a group are compared with its first, p corrected over all groups for each measure.

    Groups of several tasks have a column for the task.
    """
    scores = [read(cells) for cells in groups]
    pairs = [(i, j) for i, cells in enumerate(groups) for j in range(1, len(cells))]
    corrected = [holm([u_test(scores[i][j][name], scores[i][0][name]) for i, j in pairs]) for name in MEASURES]
    every = [run for cells in groups for run in cells]
    body = []
    for i, cells in enumerate(groups):
        for j, (run, own) in enumerate(zip(cells, scores[i], strict=True)):
            p = ", ".join(p_value(x[pairs.index((i, j))]) for x in corrected) if j else "-"
            less = difference(own, scores[i][0]) if j else "-"
            name = label(run, [x for x in every if x["task"] == run["task"]])
            line = [run["task"], f"{share(run):g}", name, str(run["seeds"][0]), mean_sd(own["end"])]
            body.append([*line, mean_sd(own["training"]), less, mean_sd(own["reward"]), unsafe(run, own), p])
    head = ["task", "p", "method", "seeds from", "true cost at the end", "true cost per 1,000 steps, training"]
    head += ["less the first row's [95 %]", "reward", "unsafe seeds", "corrected p: end, training, reward"]
    several = len({run["task"] for run in every}) > 1
    return markdown(head, body) if several else markdown(head[1:], [line[1:] for line in body])


def _second(file: pathlib.Path) -> list[runs.Run]:
    return runs.load(file.with_name("study_second_h200.json"))


def _cell(found: Sequence[runs.Run], task: str, seen: float, **wanted: Any) -> runs.Run:
    """The first run of the task, of this share of observed costs, with these settings."""
    wanted |= {"cost_seen": seen}
    return next(run for run in found if run["task"] == task and settings(run).items() >= wanted.items())


def _first(cells: Sequence[runs.Run], method: str) -> list[runs.Run]:
    """`cells`, those of the method first."""
    return sorted(cells, key=lambda run: run["method"] != method)


KINDS: dict[str, Callable[[pathlib.Path], str]] = {
    "second": as_second,
    "variant": as_variant,
    "variant_late": as_variant_late,
    "variant_a": as_variant_a,
    "variant_half_life": as_variant_half_life,
    "lag_in_time": as_lag_in_time,
    "half_life": as_half_life,
    "larger_batch": as_batch,
    "sway": as_sway,
    "responses": as_responses,
    "variant_d": as_variant_d,
    "fourth": as_fourth,
    "fifth": as_fifth,
    "sixth": as_fourth,
    "power": as_power,
    "prior": as_prior,
    "prior_in_time": as_prior_in_time,
    "against_mappo_l": as_against_mappo_l,
    "against_f4sg": as_against_f4sg,
    "unclipped": as_unclipped,
    "less_noise": as_less_noise,
    "after_less_noise": as_after_less_noise,
    "noise_in_time": as_noise_in_time,
}
