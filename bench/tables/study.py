"""The tables of docs/results/study.md: stored runs of seldom observed costs, read as the preregistration says.

Those of the later studies are in later_studies.py.
"""

from __future__ import annotations

import functools
import pathlib
import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmt_jax.config.settings import Config
from pmt_jax.studies.statistics import difference_interval, holm, iqm, iqm_interval, probability_of_improvement, u_test

from .. import records
from . import runs
from .speed import markdown, matching

Scores = NDArray[np.float64]  # [seeds]

NAMES = {"mappo_l": "MAPPO-L", "f4sg": "F4SG", "r4sg": "R4SG", "mixed": "Mixed", "macpo": "MACPO"}
SHOWN = {"lambda_init": "lambda from {}", "emotion_lr": "`emotion_lr` {}", "fear_start": "`fear_start` {}"}
SHOWN |= {"regret_response": "`{}`", "lambda_kp": "`lambda_kp` {}", "lr_half_life": "`lr_half_life` {}"}
SHOWN |= {name: f"`{name}` {{}}" for name in ("fear_lr_start", "kappa", "surrogate_weight", "regret_max")}
SHOWN |= {name: f"`{name}` {{}}" for name in ("num_envs", "init_fear", "max_grad_norm")}
SHOWN |= {name: f"`{name}` {{}}" for name in ("std_half_life", "std_decay_start", "limit_windup")}
SHOWN |= {"sway": "the corridor moves, {}"}
SHOWN |= {"cost_limit": "limit {}", "cost_value_clip": "`cost_value_clip` {}"}
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


def pooled(studies: Sequence[dict[str, Scores]]) -> dict[str, Scores]:
    """The measures of the seeds of several studies together."""
    return {name: np.concatenate([scores[name] for scores in studies]) for name in studies[0]}


def label(run: runs.Run, among: Sequence[runs.Run]) -> str:
    """The method, with the settings in which the runs of `among` differ."""
    name = NAMES[run["method"]]
    mine = settings(run)
    differing = [
        pattern.format(f"{mine[key]:g}" if isinstance(mine[key], float) else mine[key])
        for key, pattern in SHOWN.items()
        if mine[key] != ""
        and any(repr(settings(x)[key]) != repr(mine[key]) for x in among if x["method"] == run["method"])
    ]
    return ", ".join([name, *differing])


def settings(run: runs.Run) -> dict[str, Any]:
    """The run's settings; those that are newer than it have what was done before."""
    stored = _config(run["config"])
    return {key: getattr(Config, key, "none") for key in SHOWN} | runs.OLD | stored | (stored.get("env") or {})


@functools.cache  # a table asks for the settings of a run many times
def _config(text: str) -> dict[str, Any]:
    return tomllib.loads(text)


def as_study(file: pathlib.Path) -> str:
    """Question a: a row a cell, and F4SG's comparisons with the other methods of the same p."""
    found = sorted(runs.load(file), key=lambda run: (-share(run), list(NAMES).index(run["method"])))
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
        line = [f"{share(run):g}", label(run, [x for x in found if share(x) == share(run)])]
        line += [mean_sd(own["end"]), f"{iqm(own['end']):.1f} [{low:.1f}, {high:.1f}]", mean_sd(own["training"])]
        line += [mean_sd(own["reward"]), unsafe(run, own)]
        if i in fear:
            wins = probability_of_improvement([own["end"]], [scores[fear[i]]["end"]])
            line += [f"{wins:.2f}", ", ".join(p_value(p[place[i]]) for p in corrected.values())]
        else:
            line += ["-", "-"]
        body.append(line)
    return markdown(head, body)


def share(run: runs.Run) -> float:
    return settings(run)["cost_seen"]


def unsafe(run: runs.Run, own: dict[str, Scores]) -> str:
    """How many seeds end beyond the limit."""
    return f"{(own['end'] > run['cost_limit'] / share(run)).sum()} of {len(own['end'])}"


def _is_compared(run: runs.Run) -> bool:
    return run["method"] == "mappo_l" or (run["method"] != "f4sg" and share(run) < 1)


def _fear_beside(found: Sequence[runs.Run], run: runs.Run) -> int:
    return next(i for i, other in enumerate(found) if other["method"] == "f4sg" and share(other) == share(run))


def as_lag(file: pathlib.Path) -> str:
    """Questions b and c, second part: each cell against the reference cells, with Welch's interval of the difference.

    Cells of question a that belong to it are read up to the last step of the cell next to them.
    """
    new = runs.load(file)
    until = {run["task"]: max(run["steps"]) for run in new}
    old = [
        run
        for name in ("study_ant_2x4_h200", "study_voltage_33_h200")
        for run in runs.load(records.RESULTS / f"{name}.json")
        if run["method"] in ("mappo_l", "f4sg", "r4sg") and settings(run)["lambda_init"] < 4
    ]
    kept = {(run["task"], share(run)) for run in new}
    every = new + [run for run in old if (run["task"], share(run)) in kept]
    every.sort(key=lambda run: (run["task"], -share(run), run["seeds"][0], list(NAMES).index(run["method"])))
    head = ["task", "p", "method", "seeds from", "true cost per 1,000 steps, training", "less MAPPO-L's [95 %]"]
    head += ["true cost at the end", "reward"]
    body = []
    for run in every:
        own = measures(run, until[run["task"]])
        base = baseline(run, every)
        less = "-" if base is None or base is run else difference(own, measures(base, until[run["task"]]))
        line = [
            run["task"],
            f"{share(run):g}",
            label(run, [x for x in every if x["task"] == run["task"]]),
            str(run["seeds"][0]),
            mean_sd(own["training"]),
            less,
        ]
        body.append([*line, mean_sd(own["end"]), mean_sd(own["reward"])])
    return markdown(head, body)


def baseline(run: runs.Run, every: Sequence[runs.Run]) -> runs.Run | None:
    """MAPPO-L at the same task and p, of the same seeds if there is one."""
    same = [x for x in every if x["method"] == "mappo_l" and (x["task"], share(x)) == (run["task"], share(run))]
    return next((x for x in same if x["seeds"][0] == run["seeds"][0]), same[0] if same else None)


def difference(own: dict[str, Scores], base: dict[str, Scores]) -> str:
    middle, half = welch(own["training"], base["training"])
    return f"{middle:+.1f} [{middle - half:.1f}, {middle + half:.1f}]"


def welch(x: Scores, y: Scores, level: float = 0.95) -> tuple[float, float]:
    """Difference of means of x [n] and y [m], and the half-width of Welch's interval."""
    low, high = difference_interval(x, y, level)
    return (low + high) / 2, (high - low) / 2


def as_equivalence(file: pathlib.Path) -> str:
    """Question c, first part: R4SG less MAPPO-L at p = 1, next to half of MAPPO-L's standard deviation."""
    return _equivalence({run["method"]: measures(run) for run in runs.load(file) if share(run) == 1})


def as_equivalence_pooled(files: pathlib.Path) -> str:
    """Question c on the grid under noise: all seeds of several studies with the same settings; a + joins files."""
    found = [run for name in files.stem.split("+") for run in runs.load(files.with_stem(name))]
    usual = {"cost_seen": 0.05, "lambda_lr": 12.0, "lambda_init": 0.78, "lambda_kp": 0.0}
    usual |= {"lr_half_life": np.inf, "regret_response": "letter", "kappa": 0.5, "surrogate_weight": 1.0}
    cells: dict[str, dict[str, Scores]] = {}
    seeds = []  # how many of each method
    for method in ("mappo_l", "r4sg"):
        wanted = usual | {"method": method}
        same = [run for run in found if run["task"] == "voltage_33" and settings(run).items() >= wanted.items()]
        cells[method] = pooled([measures(run) for run in same])
        seeds.append(f"{len(cells[method]['end'])} of {NAMES[method]}")
    return f"{' and '.join(seeds)}:\n\n{_equivalence(cells)}"


def _equivalence(cells: Mapping[str, dict[str, Scores]]) -> str:
    """R4SG less MAPPO-L in each measure, with what it says."""
    body = []
    for name, measure in {"reward": "reward", "true cost at the end": "end", "true cost, training": "training"}.items():
        middle, half = welch(cells["r4sg"][measure], cells["mappo_l"][measure], level=0.9)
        bound = float(cells["mappo_l"][measure].std(ddof=1)) / 2
        inside = abs(middle) + half <= bound
        p = u_test(cells["r4sg"][measure], cells["mappo_l"][measure])
        answer = "equivalent" if inside else "different" if p < 0.05 else "not distinguished"
        body.append(
            [name, f"{middle:+.2f} [{middle - half:.2f}, {middle + half:.2f}]", f"+- {bound:.2f}", p_value(p), answer]
        )
    return markdown(["measure", "R4SG less MAPPO-L [90 %]", "bounds", "p", "answer"], body)


def as_probe(file: pathlib.Path) -> str:
    """Probes of F4SG against MAPPO-L with the same settings, at the same p and limit.

    p of each comparison is corrected over all comparisons of the file, those of the three measures together.
    """
    found = sorted(runs.load(file), key=lambda run: (share(run), -_limit(run), _recipe(run), _rank(run)))
    scores = [measures(run) for run in found]
    pairs = [(i, j) for j, run in enumerate(found) if (i := _same_settings(found, run)) is not None]
    order = ("training", "end", "reward")
    p = holm([u_test(scores[j][name], scores[i][name]) for i, j in pairs for name in order])
    corrected = {j: p[3 * k : 3 * k + 3] for k, (_, j) in enumerate(pairs)}
    body = []
    for j, (run, own) in enumerate(zip(found, scores, strict=True)):
        line = [f"{share(run):g}", f"{_limit(run):g}", f"{NAMES[run['method']]}, {RECIPES[_recipe(run)]}"]
        line += [mean_sd(own["training"]), mean_sd(own["end"]), f"{np.median(own['end']):.1f}", mean_sd(own["reward"])]
        body.append([*line, unsafe(run, own), ", ".join(map(p_value, corrected[j])) if j in corrected else "-"])
    head = ["p", "limit", "method, settings", "true cost per 1,000 steps, training", "true cost at the end", "median"]
    return markdown([*head, "reward", "seeds beyond the limit", "corrected p: training, end, reward"], body)


RECIPES = (
    "as in the study",
    "`max_grad_norm` inf",
    "`cost_value_clip` inf",
    "`cost_value_clip` and `max_grad_norm` inf",
    "PID for tight limits",
)


def _recipe(run: runs.Run) -> int:
    """Which of RECIPES the run has."""
    mine = settings(run)
    uncut, unclipped = (np.isinf(mine[name]) for name in ("max_grad_norm", "cost_value_clip"))
    return 4 if mine["lambda_rule"] == "pid" else 2 * int(unclipped) + int(uncut)


def _limit(run: runs.Run) -> float:
    """The limit of true costs: the team notices a share of them."""
    return run["cost_limit"] / share(run)


def _rank(run: runs.Run) -> int:
    return list(NAMES).index(run["method"])


def _same_settings(found: Sequence[runs.Run], run: runs.Run) -> int | None:
    """Where the MAPPO-L is that an F4SG is compared with."""
    wanted = "mappo_l", share(run), _limit(run), _recipe(run)
    like = [i for i, x in enumerate(found) if (x["method"], share(x), _limit(x), _recipe(x)) == wanted]
    return like[0] if like and run["method"] == "f4sg" else None


def as_weights(file: pathlib.Path) -> str:
    """How far regret's weight on the ratio is from 1: a row for each run with regret, means over its seeds."""
    body = []
    for run in sorted(runs.load(file), key=lambda run: (-share(run), list(NAMES).index(run["method"]))):
        mean, std = (np.array(run["diagnostics"].get(f"regret/weight_{x}", ())) for x in ("mean", "std"))
        if std.size:
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


def as_why(file: pathlib.Path) -> str:
    """What the policy learned from: how well the cost critic explains its targets, how fear tells danger from safety.

    Means over seeds and over the chunks of the first and of the second half of training. Targets are observed
    costs, with F4SG and Mixed fear.
    """
    body = []
    every = sorted(runs.load(file), key=lambda run: (-share(run), list(NAMES).index(run["method"])))
    for run in every:
        found = {name: np.array(x, float) for name, x in run["diagnostics"].items()}
        explained = found["cost_critic/explained_variance"]
        halves = [f"{np.nanmean(half):.2f}" for half in np.array_split(explained, 2)]
        line = [f"{share(run):g}", label(run, [x for x in every if share(x) == share(run)]), *halves]
        fear = [
            np.nanmean(found[f"fear/{name}"]) for name in ("on_costly", "on_safe", "ece") if f"fear/{name}" in found
        ]
        shown = (
            [f"{fear[0]:.3f}", f"{fear[1]:.4f}", f"{fear[0] / fear[1]:.0f}", f"{fear[2]:.4f}"] if fear else ["-"] * 4
        )
        body.append([*line, *shown])
    head = ["p", "method", "explained variance of the cost critic, first half", "second half"]
    head += ["fear of a step that is observed as costly", "of others", "ratio", "calibration error (ECE)"]
    return markdown(head, body)


def as_noise(file: pathlib.Path) -> str:
    """Noise of the cost advantage with the critic's values set aside: of observed costs and of fear, a row for each p.

    Means and standard deviations over seeds; docs/figures/noise.py defines the measures.
    """
    rows = records.load(file)[file.stem]["rows"]

    def cell(p: float, measure: str, signal: str) -> str:
        seeds = np.array([row[measure] for row in matching(rows, p=p, signal=signal, values="zero")])
        return f"{seeds.mean():.2f} +- {seeds.std(ddof=1):.2f}"

    columns = [(measure, signal) for measure in ("noise_share", "correlation") for signal in ("cost", "fear")]
    shares = dict.fromkeys(row["p"] for row in rows)
    head = ["p", "noise share, observed cost", "noise share, fear"]
    head += ["correlation with the advantage of the true cost, observed cost", "the same, fear"]
    return markdown(head, [[f"{p:g}", *(cell(p, *column) for column in columns)] for p in shares])


def mean_sd(x: Scores) -> str:
    spec = ".0f" if abs(x.mean()) >= 100 else ".1f"
    return f"{x.mean():{spec}} +- {x.std(ddof=1):{spec}}"


def p_value(value: float) -> str:
    return "< .001" if value < 0.001 else f"{value:.3f}".lstrip("0") if value < 1 else "1"


KINDS: dict[str, Callable[[pathlib.Path], str]] = {
    "study": as_study,
    "lag": as_lag,
    "equivalence": as_equivalence,
    "equivalence_pooled": as_equivalence_pooled,
    "weights": as_weights,
    "why": as_why,
    "noise": as_noise,
    "probe": as_probe,
}
