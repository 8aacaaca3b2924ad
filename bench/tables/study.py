"""The tables of docs/results/study.md: stored runs whose costly steps are noticed with a probability."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from pmt_jax.formats import markdown
from pmt_jax.studies.rows import place
from pmt_jax.studies.statistics import difference_interval, holm, welch_test

from . import runs

Scores = NDArray[np.float64]  # [seeds]

NAMES = {"mappo_l": "MAPPO-L", "f4sg": "F4SG", "r4sg": "R4SG", "mixed": "Mixed", "macpo": "MACPO"}
PAIR = ("mappo_l", "f4sg")
MOST = 0.8  # of the way to the last reward
EQUAL = {"reward": 2, "training": 10}  # bounds of equivalence, %
CONTROLS = {  # labels of stored runs, in the order of the table
    "mappo_l": "MAPPO-L",
    "f4sg": "F4SG",
    "current": "F4SG with fear of the current state",
    "squared": "F4SG with squared errors",
    "target_only": "fear as target of the cost critic alone",
    "no_l2": "F4SG without the cognitive error",
    "f4sg_letter": "F4SG as printed",
    "mixed": "Mixed",
    "r4sg": "R4SG",
    "trace_99": "MAPPO-L with cost traces of 0.99",
    "monte_carlo": "MAPPO-L with Monte Carlo costs",
    "mappo_pid": "MAPPO-L with a PID multiplier",
    "macpo": "MACPO",
}


def measures(run: runs.Run) -> dict[str, Scores]:
    """The three measures of each seed: true cost at the end and per 1,000 steps of training, reward at the end."""
    columns = {"training": runs.TRUE_WHILE_TRAINING, "end": runs.TRUE, "reward": "reward"}
    return {name: np.array(run["table"][column], float) for name, column in columns.items()}


def joined(found: Iterable[runs.Run]) -> list[runs.Run]:
    """Runs that differ only in their seeds as one, in the order of the first of each."""
    alike: dict[str, runs.Run] = {}
    for run in found:
        key = repr((run["task"], run.get("label"), run["steps"], runs.shared(run)))
        one = alike.setdefault(key, run)
        if not set(one["seeds"]) & set(run["seeds"]):
            table = {column: [*x, *run["table"][column]] for column, x in one["table"].items()}
            per_seed = {name: [*one[name], *run[name]] for name in ("seeds", *runs.CURVES, *runs.TRUE_CURVES)}
            alike[key] = one | per_seed | {"table": table}
    return list(alike.values())


def early(run: runs.Run) -> Scores:
    """True cost per 1,000 steps [seeds] until a point of the reward's curve is `MOST` of the way to the last reward.

    The way is from the first point's reward to the mean of the points in the last tenth of the steps.
    """
    steps = np.array(run["steps"])
    weights = np.diff(steps, prepend=0)
    rewards, costs = (np.array(run[name], float) for name in ("episode_reward", "true_step_cost"))
    harm = []
    for reward, cost in zip(rewards, costs, strict=True):
        first, last = reward[np.isfinite(reward)][0], np.nanmean(reward[steps > 0.9 * steps[-1]])
        way = (reward - first) * np.sign(last - first)
        end = 1 + np.flatnonzero(way >= MOST * abs(last - first))[0]
        harm.append(1000 * np.nansum((cost * weights)[:end]) / steps[end - 1])
    return np.array(harm)


def share(run: runs.Run) -> float:
    """The probability with which a costly step is noticed."""
    return runs.settings(run)["cost_seen"]


def unsafe(run: runs.Run) -> str:
    """How many seeds end beyond the limit, with the worst agent's cost where agents differ."""
    judged = runs.row_of(run).score("true worst agent")
    return f"{(judged > run['cost_limit'] / share(run)).sum()} of {len(judged)}"


def pairs(files: pathlib.Path, pair: tuple[str, str] = PAIR) -> list[tuple[runs.Run, runs.Run]]:
    """MAPPO-L and F4SG, or another pair of methods, wherever all else is equal.

    They come by probability, then by task in the order of the files, whose names a + joins.
    """
    cells: dict[str, dict[str, runs.Run]] = {}
    for run in joined(runs.load(files)):
        if run["method"] in pair:
            cells.setdefault(_cell(run), {})[run["method"]] = run
    found = [(cell[pair[0]], cell[pair[1]]) for cell in cells.values() if len(cell) == len(pair)]
    tasks = [theirs["task"] for theirs, _ in found]
    return sorted(found, key=lambda pair: (share(pair[0]), tasks.index(pair[0]["task"])))


def as_probe(files: pathlib.Path) -> str:
    """F4SG against MAPPO-L, a line a comparison; a + joins the names of files.

    The tests are Welch's. Holm corrects those of the harm over all lines, the other two with the harm's over the three
    of their line. d is Cohen's. The harm stands there twice: of the whole run, and until `MOST` of the way to its last
    reward.
    """
    found = pairs(files)
    scores = [(measures(theirs), measures(ours)) for theirs, ours in found]
    tests = [[welch_test(ours[name], theirs[name]) for name in ours] for theirs, ours in scores]
    harm, named = holm([line[0] for line in tests]), line_names(found)
    body = []
    for i, (theirs, ours) in enumerate(scores):
        run, p = found[i][0], map(p_value, (harm[i], *holm(tests[i])[1:]))
        line = [named[i], f"{share(run):g}", f"{_limit(run):g}", mean_sd(theirs["training"])]
        line += [mean_sd(ours["training"]), _effect(ours["training"], theirs["training"])]
        line += [", ".join(mean_sd(early(run)) for run in found[i])]
        line += [f"{mean_sd(theirs[name])}, {mean_sd(ours[name])}" for name in ("end", "reward")]
        body.append([*line, ", ".join(map(unsafe, found[i])), ", ".join(p)])
    head = ["task", "p", "limit", "harm, of 1,000 steps: MAPPO-L", "F4SG", "difference [95 %], d, %"]
    head += [f"harm until {MOST:.0%}: MAPPO-L, F4SG".replace("%", " %")]
    head += [f"{what}: MAPPO-L, F4SG" for what in ("true cost at the end", "reward", "seeds beyond")]
    return markdown([*head, "corrected p: harm, cost, reward"], body)


def as_harm(files: pathlib.Path) -> str:
    """The harm of `as_probe` alone, with p if there are several. Seeds beyond are MAPPO-L's, then F4SG's.

    Of lines that differ in the multiplier, only the one under which MAPPO-L does least harm; Holm corrects over all.
    """
    found = pairs(files)
    scores = [[measures(run)["training"] for run in pair] for pair in found]
    p = holm([welch_test(ours, theirs) for theirs, ours in scores])
    several = len({share(pair[0]) for pair in found}) > 1
    kinds = [(theirs["task"], share(theirs), _limit(theirs)) for theirs, _ in found]
    least: dict[tuple[str, float, float], float] = {}
    for kind, (theirs, _) in zip(kinds, scores, strict=True):
        least[kind] = min(theirs.mean(), least.get(kind, np.inf))
    body = []
    for kind, name, pair, (theirs, ours), corrected in zip(kinds, line_names(found), found, scores, p, strict=True):
        if theirs.mean() > least[kind]:
            continue
        line = [name, *[f"{share(pair[0]):g}"] * several, mean_sd(theirs), mean_sd(ours), _change(ours, theirs)]
        body.append([*line, p_value(corrected), ", ".join(map(unsafe, pair))])
    head = ["task", *["p"] * several, "harm, of 1,000 steps: MAPPO-L", "F4SG", "change", "corrected p", "seeds beyond"]
    return markdown(head, body)


def as_controls(files: pathlib.Path) -> str:
    """What lacks a part of F4SG, or has one, and other methods, against F4SG and against MAPPO-L, until all have ended.

    Of runs in files joined by + that do not notice every costly step, on tasks where more than these two have run. Holm
    corrects all tests of the table together.
    """
    found: dict[str, dict[str, runs.Run]] = {}
    for run in joined(runs.load(files)):
        label = run.get("label", run["method"])
        if share(run) < 1 and label in CONTROLS:
            found.setdefault(run["task"], {})[label] = run
    found = {task: cell for task, cell in found.items() if set(cell) - set(PAIR)}
    scores = {task: _until_all_ended(cell) for task, cell in found.items()}
    lines = [(task, name) for task, cell in found.items() for name in CONTROLS if name in cell]
    tested = [(*line, other) for line in lines for other in PAIR if line[1] not in (other, PAIR[0])]
    harm = {line: scores[line[0]][line[1]]["training"] for line in lines}
    p = holm([welch_test(harm[task, name], harm[task, other]) for task, name, other in tested])
    against = {}
    for (task, name, other), corrected in zip(tested, p, strict=True):
        against[task, name, other] = f"{_difference(harm[task, name], harm[task, other])}, {p_value(corrected)}"
    body = []
    for task, name in lines:
        own, limit = scores[task][name], _limit(found[task][name])
        line = [*[f"`{task}`"] * (len(found) > 1), CONTROLS[name], mean_sd(own["training"])]
        line += [against.get((task, name, other), "-") for other in reversed(PAIR)]
        line += [mean_sd(own["end"]), mean_sd(own["reward"]), f"{(own['end'] > limit).sum()} of {own['end'].size}"]
        body.append(line)
    less = [f"less {NAMES[other]}'s [95 %], d, p" for other in reversed(PAIR)]
    head = [*["task"] * (len(found) > 1), "", "harm, of 1,000 steps", *less, "true cost at the end", "reward"]
    return markdown([*head, "seeds beyond"], body)


def _until_all_ended(cell: dict[str, runs.Run]) -> dict[str, dict[str, Scores]]:
    """The measures of each run, as if all had ended with the first; of all rows where they did."""
    end = min(run["steps"][-1] for run in cell.values())
    together = all(run["steps"][-1] == end for run in cell.values())
    return {name: measures(run) if together else _until(run, end) for name, run in cell.items()}


def as_equivalence(files: pathlib.Path) -> str:
    """R4SG less MAPPO-L in shares of MAPPO-L's mean, a line a comparison, and whether they are equal within `EQUAL`.

    Two one-sided tests of Welch at 5 % say that they are where the 90 % interval lies within the bounds.
    """
    body = []
    for theirs, ours in pairs(files, ("mappo_l", "r4sg")):
        line = [f"`{ours['task']}`", f"{share(ours):g}", str(len(ours["seeds"]))]
        for name, bound in EQUAL.items():
            found, reference = measures(ours)[name], measures(theirs)[name]
            scale = 100 / abs(reference.mean())
            low, high = (scale * x for x in difference_interval(found, reference, 0.9))
            words = "yes" if max(-low, high) < bound else "not shown"
            line += [f"{scale * (found.mean() - reference.mean()):.1f} [{low:.1f}, {high:.1f}]", words]
        body.append(line)
    head = ["task", "p", "seeds"]
    for what, bound in zip(("reward", "harm"), EQUAL.values(), strict=True):
        head += [f"{what}, % [90 %]", f"equal within {bound} %"]
    return markdown(head, body)


def _until(run: runs.Run, end: int) -> dict[str, Scores]:
    """The measures as if the run had ended at step `end`: harm until then, cost and reward of the last tenth.

    A point of a curve counts by the steps that it is the mean of.
    """
    steps = np.array(run["steps"])
    until, last = steps <= end, (steps <= end) & (steps > 0.9 * end)

    def mean(name: str, chosen: NDArray[np.bool_]) -> Scores:
        curve = np.array(run[name], float)[:, chosen]
        weights = np.where(np.isfinite(curve), np.diff(steps, prepend=0)[chosen], 0)
        return np.nansum(curve * weights, 1) / weights.sum(1)

    return {
        "training": 1000 * mean("true_step_cost", until),
        "end": mean("true_episode_cost", last),
        "reward": mean("episode_reward", last),
    }


def _cell(run: runs.Run) -> str:
    """What F4SG and MAPPO-L have in common if they are compared: the limit, and all settings but the sample's."""
    return repr((_limit(run), {name: x for name, x in runs.shared(run).items() if name != "method"}))


def line_names(found: list[tuple[runs.Run, runs.Run]]) -> list[str]:
    """The task of each comparison, with its limit where a task's lines of one probability differ in it, and all with
    their multiplier if those of any do.
    """
    tasks = [(theirs["task"], share(theirs)) for theirs, _ in found]
    limits = [f"limit {_limit(theirs):g}" for theirs, _ in found]
    rates = [f"`lambda_lr` {runs.settings(theirs).get('lambda_lr', 0):g}" for theirs, _ in found]

    def several(task: tuple[str, float], words: list[str]) -> bool:
        return len({word for of, word in zip(tasks, words, strict=True) if of == task}) > 1

    rated = any(several(task, rates) for task in tasks)
    return [
        ", ".join([f"`{task[0]}`", *[limit] * several(task, limits), *[rate] * rated])
        for task, limit, rate in zip(tasks, limits, rates, strict=True)
    ]


def _effect(ours: Scores, theirs: Scores) -> str:
    """As `_difference`, and as a share of theirs."""
    return f"{_difference(ours, theirs)}, {_change(ours, theirs)}"


def _difference(ours: Scores, theirs: Scores) -> str:
    """The difference of the means with its 95 % interval, and in standard deviations."""
    low, high = difference_interval(ours, theirs)
    difference = ours.mean() - theirs.mean()
    spread = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 2)
    in_sd = difference / spread if spread else 0
    return f"{difference:.1f} [{low:.1f}, {high:.1f}], {in_sd:.1f}"


def _change(ours: Scores, theirs: Scores) -> str:
    return f"{100 * (ours.mean() / theirs.mean() - 1):.0f} %"


def _limit(run: runs.Run) -> float:
    """The limit of true costs: the team notices a share of them."""
    return round(run["cost_limit"] / share(run), 9)


def as_weights(file: pathlib.Path) -> str:
    """How far regret's weight on the ratio is from 1: a row for each run with regret, means over its seeds."""
    body = []
    weighed = [run for run in runs.load(file) if "regret/weight_mean" in run["diagnostics"]]
    for run in sorted(weighed, key=lambda run: (run["task"], -share(run), place(run["method"]))):
        mean, std = (np.array(run["diagnostics"][f"regret/weight_{x}"]) for x in ("mean", "std"))
        line = [run["task"], f"{share(run):g}", NAMES[run["method"]]]
        body.append([*line, f"{mean.min():.4f} to {mean.max():.4f}", f"{std.max():.4f}", f"{std[-1]:.4f}"])
    head = [
        "task",
        "p",
        "method",
        "mean of the weight, lowest to highest chunk",
        "its standard deviation, highest chunk",
    ]
    return markdown([*head, "last chunk"], body)


def mean_sd(x: Scores) -> str:
    small = abs(x.mean()) < 10 and x.std(ddof=1) < 0.5
    spec = ".0f" if abs(x.mean()) >= 100 else ".2f" if small else ".1f"
    return f"{x.mean():{spec}}±{x.std(ddof=1):{spec}}"


def p_value(value: float) -> str:
    return "< .001" if value < 0.001 else f"{value:.3f}".lstrip("0") if value < 1 else "1"


KINDS: dict[str, Callable[[pathlib.Path], str]] = {
    "weights": as_weights,
    "probe": as_probe,
    "harm": as_harm,
    "controls": as_controls,
    "equivalence": as_equivalence,
}
