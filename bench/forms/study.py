"""The tables of docs/results/study.md: stored runs of seldom felt costs, read as the preregistration says."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmt_jax.config.settings import Config
from pmt_jax.studies.statistics import difference_interval, holm, iqm, iqm_interval, probability_of_improvement, u_test

from .. import records
from . import runs
from .tables import markdown

Scores = NDArray[np.float64]  # [seeds]

NAMES = {"mappo_l": "MAPPO-L", "f4sg": "F4SG", "r4sg": "R4SG", "mixed": "Mixed", "macpo": "MACPO"}
SHOWN = {"lambda_init": "lambda from {}", "emotion_lr": "`emotion_lr` {}", "fear_start": "`fear_start` {}"}
SHOWN |= {"regret_response": "`{}`", "lambda_kp": "`lambda_kp` {}"}
LAST = 0.1  # share of the steps that count as the end


def measures(run: runs.Run, until: float = np.inf) -> dict[str, Scores]:
    """The three measures of each seed, up to a step: true cost at the end and while training, reward at the end.

    Of a whole run they were stored from all rows; up to a step they come from the stored curves.
    """
    if until >= max(run["steps"]):
        columns = {"end": "true cost", "training": runs.TRUE_WHILE_TRAINING, "reward": "reward"}
        return {name: np.array(run["table"][column], float) for name, column in columns.items()}
    log = runs.curves(run)
    used = log.steps <= until
    end = used & (log.steps > (1 - LAST) * log.steps[used][-1])

    def mean(name: str, at: NDArray[np.bool_]) -> Scores:
        values = log.metrics[name][:, at]
        known = np.isfinite(values)
        return np.where(known, values, 0.0).sum(1) / known.sum(1)

    return {
        "end": mean("true_episode_cost", end),
        "training": 1000 * mean("true_step_cost", used),
        "reward": mean("episode_reward", end),
    }


def label(run: runs.Run, among: Sequence[runs.Run]) -> str:
    """The method, with the settings in which the runs of `among` differ."""
    name = NAMES[run["method"]]
    mine = _settings(run)
    differing = [
        form.format(f"{mine[key]:g}" if isinstance(mine[key], float) else mine[key])
        for key, form in SHOWN.items()
        if any(repr(_settings(x)[key]) != repr(mine[key]) for x in among if x["method"] == run["method"])
    ]
    return ", ".join([name, *differing])


def _settings(run: runs.Run) -> dict[str, Any]:
    """The run's settings; those that are newer than it have their defaults."""
    return {key: getattr(Config, key) for key in SHOWN} | runs.curves(run).settings


def as_study(file: pathlib.Path) -> str:
    """Question a: a row a cell, and F4SG's comparisons with the other methods of the same p."""
    found = sorted(runs.load(file), key=lambda run: (-_share(run), list(NAMES).index(run["method"])))
    scores = [measures(run) for run in found]
    pairs = [(i, _fear_beside(found, run)) for i, run in enumerate(found) if _is_compared(run)]
    corrected = {
        name: holm([u_test(scores[j][name], scores[i][name]) for i, j in pairs])
        for name in ("end", "training", "reward")
    }
    place = {i: k for k, (i, _) in enumerate(pairs)}
    fear = dict(pairs)
    head = ["p", "method", "true cost at the end", "interquartile mean [95 %]", "true cost per 1,000 steps, training"]
    head += ["reward", "unsafe seeds", "P(F4SG lower)", "corrected p: end, training, reward"]
    body = []
    for i, (run, own) in enumerate(zip(found, scores, strict=True)):
        low, high = iqm_interval(own["end"])
        limit = run["cost_limit"] / _share(run)
        line = [f"{_share(run):g}", label(run, [x for x in found if _share(x) == _share(run)])]
        line += [_mean_sd(own["end"]), f"{iqm(own['end']):.1f} [{low:.1f}, {high:.1f}]", _mean_sd(own["training"])]
        line += [_mean_sd(own["reward"]), f"{(own['end'] > limit).sum()} of {len(own['end'])}"]
        if i in fear:
            wins = probability_of_improvement([own["end"]], [scores[fear[i]]["end"]])
            line += [f"{wins:.2f}", ", ".join(_p(p[place[i]]) for p in corrected.values())]
        else:
            line += ["-", "-"]
        body.append(line)
    return markdown(head, body)


def _share(run: runs.Run) -> float:
    return runs.curves(run).settings["cost_seen"]


def _is_compared(run: runs.Run) -> bool:
    return run["method"] == "mappo_l" or (run["method"] != "f4sg" and _share(run) < 1)


def _fear_beside(found: Sequence[runs.Run], run: runs.Run) -> int:
    return next(i for i, other in enumerate(found) if other["method"] == "f4sg" and _share(other) == _share(run))


def as_lag(file: pathlib.Path) -> str:
    """Questions b and c, second part: each cell beside the reference cells, with Welch's interval of the difference.

    Cells of question a that belong to it are read up to the last step of the cell beside them.
    """
    new = runs.load(file)
    until = {run["task"]: max(run["steps"]) for run in new}
    old = [
        run
        for name in ("study_ant_2x4_h200", "study_voltage_33_h200")
        for run in runs.load(records.RESULTS / f"{name}.json")
        if run["method"] in ("mappo_l", "f4sg", "r4sg") and runs.curves(run).settings["lambda_init"] < 4
    ]
    kept = {(run["task"], _share(run)) for run in new}
    every = new + [run for run in old if (run["task"], _share(run)) in kept]
    every.sort(key=lambda run: (run["task"], -_share(run), run["seeds"][0], list(NAMES).index(run["method"])))
    head = ["task", "p", "method", "seeds from", "true cost per 1,000 steps, training", "less MAPPO-L's [95 %]"]
    head += ["true cost at the end", "reward"]
    body = []
    for run in every:
        own = measures(run, until[run["task"]])
        base = _baseline(run, every)
        less = "-" if base is None or base is run else _difference(own, measures(base, until[run["task"]]))
        line = [
            run["task"],
            f"{_share(run):g}",
            label(run, [x for x in every if x["task"] == run["task"]]),
            str(run["seeds"][0]),
            _mean_sd(own["training"]),
            less,
        ]
        body.append([*line, _mean_sd(own["end"]), _mean_sd(own["reward"])])
    return markdown(head, body)


def _baseline(run: runs.Run, every: Sequence[runs.Run]) -> runs.Run | None:
    """MAPPO-L at the same task and p, of the same seeds if there is one."""
    same = [x for x in every if x["method"] == "mappo_l" and (x["task"], _share(x)) == (run["task"], _share(run))]
    return next((x for x in same if x["seeds"][0] == run["seeds"][0]), same[0] if same else None)


def _difference(own: dict[str, Scores], base: dict[str, Scores]) -> str:
    middle, half = welch(own["training"], base["training"])
    return f"{middle:+.1f} [{middle - half:.1f}, {middle + half:.1f}]"


def welch(x: Scores, y: Scores, level: float = 0.95) -> tuple[float, float]:
    """Difference of means of x [n] and y [m], and the half-width of Welch's interval."""
    low, high = difference_interval(x, y, level)
    return (low + high) / 2, (high - low) / 2


def as_second(file: pathlib.Path) -> str:
    """The second round: a row a cell; p corrected over the comparisons of one task with F4SG as it is."""
    found, last = _by_task(file)
    body = []
    for task in last:
        cells = [run for run in found if run["task"] == task]
        scores = [measures(run, last[task]) for run in cells]
        pairs = [(i, _as_it_is(cells, run)) for i, run in enumerate(cells) if run["method"] == "mappo_l"]
        p = holm([u_test(scores[i]["end"], scores[j]["end"]) for i, j in pairs])
        corrected = {i: value for (i, _), value in zip(pairs, p, strict=True)}
        for i, (run, own) in enumerate(zip(cells, scores, strict=True)):
            base = _baseline(run, cells)
            less = "-" if base is None or base is run else _difference(own, measures(base, last[task]))
            unsafe = (own["end"] > run["cost_limit"] / _share(run)).sum()
            line = [task, f"{_share(run):g}", label(run, [x for x in cells if _share(x) == _share(run)])]
            line += [_mean_sd(own["end"]), _mean_sd(own["training"]), less, _mean_sd(own["reward"])]
            body.append([*line, f"{unsafe} of {len(own['end'])}", _p(corrected[i]) if i in corrected else "-"])
    head = ["task", "p", "method", "true cost at the end", "true cost per 1,000 steps, training"]
    head += ["less MAPPO-L's [95 %]", "reward", "unsafe seeds", "corrected p, F4SG's cost at the end"]
    return markdown(head, body)


def as_candidate(file: pathlib.Path) -> str:
    """Question b again: each criterion of the preregistration, what was measured, and whether it holds."""
    found, last = _by_task(file)

    def cell(task: str, share: float, **settings: Any) -> dict[str, Scores]:
        settings = {"method": "f4sg", "cost_seen": share, **settings}
        same = (x for x in found if x["task"] == task and _settings(x).items() >= settings.items())
        return measures(next(same), last[task])

    body = []
    for task in ("voltage_33", "hand_over_2x6"):
        candidate, base = cell(task, 1.0, emotion_lr=0.01), cell(task, 1.0, method="mappo_l")
        middle, half = welch(candidate["training"], base["training"])
        what = f"true cost while training, less MAPPO-L's, `{task}`, p = 1"
        body.append(["1", what, _difference(candidate, base), middle < 1 and middle + half < 5])
    for task, share in (("ant_2x4", 0.03), ("voltage_33", 0.05)):
        candidate, usual = cell(task, share, emotion_lr=0.01), cell(task, share, emotion_lr=0.001)
        base = cell(task, share, method="mappo_l", lambda_kp=0.0)
        at = f"`{task}`, p = {share:g}"
        ends = [_mean_sd(x["end"]) for x in (candidate, usual, base)]
        above = u_test(candidate["end"], usual["end"])
        worse = above < 0.05 and probability_of_improvement([candidate["end"]], [usual["end"]]) > 0.5
        body.append(
            ["2", f"true cost at the end beside F4SG's, {at}", f"{ends[0]}; {ends[1]}; p {_p(above)}", not worse]
        )
        below = u_test(candidate["end"], base["end"])
        body.append(
            ["2", f"true cost at the end below MAPPO-L's, {at}", f"{ends[0]}; {ends[2]}; p {_p(below)}", below < 0.01]
        )
        rewards = candidate["reward"].mean(), usual["reward"].mean()
        least = 0.9 * rewards[1] if task == "ant_2x4" else rewards[1] - usual["reward"].std(ddof=1)
        text = f"{_mean_sd(candidate['reward'])}; at least {least:.{0 if task == 'ant_2x4' else 2}f}"
        body.append(["3", f"reward at the end, {at}", text, rewards[0] >= least])
    body = [[*line, "yes" if holds else "**no**"] for *line, holds in sorted(body, key=lambda line: line[0])]
    return markdown(["criterion", "measure", "candidate C", "holds"], body)


def _by_task(file: pathlib.Path) -> tuple[list[runs.Run], dict[str, float]]:
    """The cells in order, and of each task the last step that all of its cells reached."""
    found = sorted(runs.load(file), key=lambda run: (run["task"], -_share(run), -list(NAMES).index(run["method"])))
    return found, {x["task"]: min(max(run["steps"]) for run in found if run["task"] == x["task"]) for x in found}


def _as_it_is(cells: Sequence[runs.Run], run: runs.Run) -> int:
    """F4SG's cell with default settings at the p of `run`."""
    usual = ("f4sg", _share(run), Config.emotion_lr)
    return next(i for i, x in enumerate(cells) if (x["method"], _share(x), _settings(x)["emotion_lr"]) == usual)


def as_equivalence(file: pathlib.Path) -> str:
    """Question c, first part: R4SG less MAPPO-L at p = 1, beside half of MAPPO-L's standard deviation."""
    cells = {run["method"]: measures(run) for run in runs.load(file) if _share(run) == 1}
    body = []
    for name, measure in {"reward": "reward", "true cost at the end": "end", "true cost, training": "training"}.items():
        middle, half = welch(cells["r4sg"][measure], cells["mappo_l"][measure], level=0.9)
        bound = float(cells["mappo_l"][measure].std(ddof=1)) / 2
        inside = abs(middle) + half <= bound
        p = u_test(cells["r4sg"][measure], cells["mappo_l"][measure])
        answer = "equivalent" if inside else "different" if p < 0.05 else "not told apart"
        body.append(
            [name, f"{middle:+.1f} [{middle - half:.1f}, {middle + half:.1f}]", f"+- {bound:.1f}", _p(p), answer]
        )
    return markdown(["measure", "R4SG less MAPPO-L [90 %]", "bounds", "p", "answer"], body)


def as_headline(file: pathlib.Path) -> str:
    """MAPPO-L beside F4SG at every p, with the multiplier that both share."""
    found = runs.load(file)
    base = min(runs.curves(run).settings["lambda_init"] for run in found)
    body = []
    for p in sorted({_share(run) for run in found}, reverse=True):
        same = [x for x in found if _share(x) == p and runs.curves(x).settings["lambda_init"] == base]
        pair = [(x, measures(x)) for name in ("mappo_l", "f4sg") for x in same if x["method"] == name]
        unsafe = [f"{(own['end'] > x['cost_limit'] / p).sum()} of {len(own['end'])}" for x, own in pair]
        ends, rewards = ([_mean_sd(own[measure]) for _, own in pair] for measure in ("end", "reward"))
        body.append([f"{p:g}", *(" / ".join(cell) for cell in (ends, rewards, unsafe))])
    return markdown(["p", "true cost, MAPPO-L / F4SG", "reward", "seeds beyond the limit"], body)


def as_weights(file: pathlib.Path) -> str:
    """How far regret's weight on the ratio is from 1: a row for each run with regret, means over its seeds."""
    body = []
    for run in sorted(runs.load(file), key=lambda run: (-_share(run), list(NAMES).index(run["method"]))):
        mean, std = (np.array(run["diagnostics"].get(f"regret/weight_{x}", ())) for x in ("mean", "std"))
        if std.size:
            line = [run["task"], f"{_share(run):g}", NAMES[run["method"]]]
            body.append([*line, f"{mean.min():.4f} to {mean.max():.4f}", f"{std.max():.4f}", f"{std[-1]:.4f}"])
    head = [
        "task",
        "p",
        "method",
        "mean of the weight, lowest to highest chunk",
        "its standard deviation, highest chunk",
    ]
    return markdown([*head, "last chunk"], body)


def as_why(file: pathlib.Path) -> str:
    """What the policy learned from: how well the cost critic explains its targets, how fear tells danger from safety.

    Means over seeds and over the chunks of the first and of the second half of training. Targets are felt costs, with
    F4SG and Mixed fear.
    """
    body = []
    every = sorted(runs.load(file), key=lambda run: (-_share(run), list(NAMES).index(run["method"])))
    for run in every:
        found = {name: np.array(x, float) for name, x in run["diagnostics"].items()}
        explained = found["cost_critic/explained_variance"]
        halves = [f"{np.nanmean(half):.2f}" for half in np.array_split(explained, 2)]
        line = [f"{_share(run):g}", label(run, [x for x in every if _share(x) == _share(run)]), *halves]
        fear = [
            np.nanmean(found[f"fear/{name}"]) for name in ("on_costly", "on_safe", "ece") if f"fear/{name}" in found
        ]
        shown = (
            [f"{fear[0]:.3f}", f"{fear[1]:.4f}", f"{fear[0] / fear[1]:.0f}", f"{fear[2]:.4f}"] if fear else ["-"] * 4
        )
        body.append([*line, *shown])
    head = ["p", "method", "explained variance of the cost critic, first half", "second half"]
    head += ["fear of a step that is felt as costly", "of others", "ratio", "calibration error (ECE)"]
    return markdown(head, body)


def _mean_sd(x: Scores) -> str:
    form = ".0f" if abs(x.mean()) >= 100 else ".1f"
    return f"{x.mean():{form}} +- {x.std(ddof=1):{form}}"


def _p(value: float) -> str:
    return "< .001" if value < 0.001 else f"{value:.3f}".lstrip("0") if value < 1 else "1"


FORMS: dict[str, Callable[[pathlib.Path], str]] = {
    "study": as_study,
    "lag": as_lag,
    "second": as_second,
    "candidate": as_candidate,
    "equivalence": as_equivalence,
    "weights": as_weights,
    "why": as_why,
    "headline": as_headline,
}
