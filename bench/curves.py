"""Training curves of run folders as a compact JSON and a picture: mean over seeds, band from lowest to highest.

python -m bench.curves runs/ant --json bench/results/ant_2x4_mappo_l.json --png docs/ant_2x4_mappo_l.png
python -m bench.curves --from bench/results/ant_2x4_mappo_l.json --png docs/ant_2x4_mappo_l.png
"""

from __future__ import annotations

import argparse
import json
import pathlib
from typing import Any

import numpy as np

POINTS = 100
FIGURES = ("episode_reward", "episode_cost", "violation_rate", "lambda", "episode_length")


def read(folder: pathlib.Path) -> dict[str, Any]:
    """A run's figures per seed, averaged into at most POINTS points: {name: [seeds][points]}, nan where unknown."""
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    seeds = sorted({row["seed"] for row in rows})
    steps = np.array([row["step"] for row in rows if row["seed"] == seeds[0]])
    groups = np.array_split(np.arange(len(steps)), min(POINTS, len(steps)))
    result: dict[str, Any] = {"steps": [int(steps[g[-1]]) for g in groups], "seeds": seeds}
    for name in FIGURES:
        series = [[row[name] for row in rows if row["seed"] == seed] for seed in seeds]
        values = np.array([[np.nan if x is None else x for x in one] for one in series])
        means = [[float(np.nanmean(one[g])) if np.isfinite(one[g]).any() else None for g in groups] for one in values]
        result[name] = [[None if x is None else round(x, 4) for x in one] for one in means]
    last = rows[-1]
    result |= {"task": last["task"], "method": last["method"], "cost_limit": last["cost_limit"]}
    result["seconds"] = max(row["seconds"] for row in rows)
    result["versions"] = json.loads((folder / "versions.json").read_text())
    result["config"] = (folder / "config.toml").read_text()
    return result


def draw(runs: list[dict[str, Any]], png: pathlib.Path) -> None:
    """Reward, cost against its limit, and the multiplier, one colour a run."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    titles = {
        "episode_reward": "episode reward",
        "episode_cost": "episode cost (dashed: limit)",
        "lambda": "multiplier",
    }
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.2), constrained_layout=True)
    for axis, (name, title) in zip(axes, titles.items(), strict=True):
        for run in runs:
            steps = np.array(run["steps"])
            values = np.array([[np.nan if x is None else x for x in one] for one in run[name]], float)
            known = np.isfinite(values).any(0)
            low, mid, high = (f(values[:, known], axis=0) for f in (np.nanmin, np.nanmean, np.nanmax))
            (line,) = axis.plot(steps[known] / 1e6, mid, label=run["method"])
            axis.fill_between(steps[known] / 1e6, low, high, alpha=0.2, color=line.get_color(), lw=0)
        axis.set(title=title, xlabel="million environment steps")
        axis.grid(alpha=0.3)
    axes[1].axhline(runs[0]["cost_limit"], color="k", ls="--", lw=1)
    axes[1].set_yscale("symlog", linthresh=10)
    axes[1].set_ylim(bottom=0)
    axes[0].legend(frameon=False)
    figure.suptitle(f"{runs[0]['task']}, {len(runs[0]['seeds'])} seeds (mean, lowest and highest)")
    figure.savefig(png, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=pathlib.Path)
    parser.add_argument("--from", dest="source", type=pathlib.Path, help="a JSON file written earlier")
    parser.add_argument("--json", type=pathlib.Path)
    parser.add_argument("--png", type=pathlib.Path)
    arguments = parser.parse_args()
    runs = json.loads(arguments.source.read_text()) if arguments.source else [read(f) for f in arguments.folders]
    if arguments.json:
        arguments.json.write_text(json.dumps(runs) + "\n")
    if arguments.png:
        draw(runs, arguments.png)


if __name__ == "__main__":
    main()
