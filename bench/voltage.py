"""All methods on voltage_33 at equal budget, beside policies that nobody had to learn.

    python -m bench.voltage --steps 3e5 --out bench/results/voltage_33.json    trains 7 methods x 5 seeds on a CPU
    python -m bench.voltage --from bench/results/voltage_33.json               prints the table

CR: controllable rate, the share of steps with every bus in the band. PL: losses in lines, MW. Means over the same
64 whole episodes for everybody; learned policies take their mean action; intervals are bootstrapped over seeds.
"""

from __future__ import annotations

import argparse
import pathlib
import time
from typing import Any

from pmt_jax import METHODS, load_config
from pmt_jax.policies.evaluate import evaluate_baseline

from . import records
from .search import search
from .tables import markdown
from .toys import interval

TASK, SEEDS, EPISODES = "voltage_33", 5, 64
FIGURES = {
    "CR": "info/totally_controllable_ratio",
    "PL": "info/total_line_loss",
    "q_loss": "info/q_loss",
    "reward": "episode_reward",
    "cost": "episode_cost",
}


def learned(method: str, steps: str, **changes: Any) -> dict[str, Any]:
    """One method's figures per seed, and how long it took."""
    config = load_config(TASK, method=method, steps=steps, seeds=SEEDS, log_interval=5, **changes)
    begin = time.monotonic()
    found = search({method: config}, episodes=EPISODES)
    figures = {name: found["evaluation_mean"][key] for name, key in FIGURES.items()}
    rates = {"seconds": round(time.monotonic() - begin, 1), "steps_per_second": round(found["steps_per_second"])}
    return {"policy": method, "steps": found["steps"][-1], **rates, **figures}


def given(policy: str) -> dict[str, Any]:
    """A baseline's figures over the same episodes."""
    results = evaluate_baseline(TASK, policy, EPISODES, {})
    return {"policy": policy, **{name: [results[key][0]] for name, key in FIGURES.items()}}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""

    def cell(values: list[float]) -> str:
        return f"{values[0]:.3f}" if len(values) == 1 else interval(values, 3)

    body = [
        [
            row["policy"],
            f"{row['steps']:,}" if "steps" in row else "-",
            *(cell(row[name]) for name in ("CR", "PL", "reward", "cost")),
        ]
        for row in rows
    ]
    return markdown(("policy", "steps a seed", "CR", "PL, MW", "episode reward", "episode cost"), body)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", default="3e5")
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--from", dest="source", type=pathlib.Path)
    parser.add_argument("fixed", nargs="*", metavar="SETTING=VALUE")
    arguments = parser.parse_intermixed_args()
    if arguments.source:
        print(table(records.read(arguments.source)))
        return
    changes = dict(pair.split("=", 1) for pair in arguments.fixed)
    rows = [given(policy) for policy in ("zero", "droop", "opf")]
    print(table(rows), flush=True)
    for method in arguments.methods:
        rows.append(learned(method, arguments.steps, **changes))
        print(table(rows[-1:]).splitlines()[-1], rows[-1]["seconds"], "s", flush=True)
        if arguments.out:
            records.write(arguments.out, rows, changes=changes)


if __name__ == "__main__":
    main()
