"""Run folders written by hand."""

from __future__ import annotations

import json
import pathlib

from pmt_jax import load_config
from pmt_jax.config.load import to_toml


def made(folder: pathlib.Path, task: str, method: str, seeds: dict[int, list[float | None]], **more: object) -> None:
    """A run of ten rows a seed, of which the last has the reward and the cost given.

    Args:
      more: settings of the run, or metrics of every row.
    """
    config = load_config(task, method=method, seeds=len(seeds), steps=24_000)
    changes = {name: more.pop(name) for name in list(more) if hasattr(config, name)}
    folder.mkdir(parents=True)
    (folder / "config.toml").write_text(to_toml(config.replace(**changes)))
    lines = []
    for step in range(1, 11):
        for seed, (reward, cost) in seeds.items():
            row = {"step": 1000 * step, "seed": seed, "task": task, "method": method, "cost_limit": 1.0}
            metrics = {"episode_reward": reward, "episode_cost": cost, "violation_rate": 0.25}
            lines.append(json.dumps({**row, **(metrics if step == 10 else dict.fromkeys(metrics, -99)), **more}) + "\n")
    (folder / "metrics.jsonl").write_text("".join(lines))


def written(folder: pathlib.Path, lines: list[str], config: str = 'task = "lane"\n') -> pathlib.Path:
    """A run of the lines given."""
    folder.mkdir(parents=True)
    (folder / "config.toml").write_text(config)
    (folder / "metrics.jsonl").write_text("".join(lines))
    return folder


def row(step: int, seed: int, reward: float | None, **more: object) -> str:
    """A line of metrics.jsonl."""
    metrics = {"task": "lane", "method": "mappo_l", "cost_limit": 1.0, "episode_reward": reward, **more}
    return json.dumps({"step": step, "seed": seed, **metrics}) + "\n"
