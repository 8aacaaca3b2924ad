"""Makes a pretrained policy of a run folder: the best seed's best or last state, judged by a fresh evaluation.

`python -m bench publish RUN...` does this in a checkout. All values are means over whole episodes with mean actions;
the published ones are from other starts than those that chose the policy. A policy is better by the rule that
`best` checkpoints are kept by (docs/howto/evaluate.md); for methods without a constraint reward alone counts.
"""

from __future__ import annotations

import functools
import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import tasks
from ..config.methods import METHODS
from ..errors import UsageError
from ..files import read_rows
from ..learning import rollout
from ..learning.evaluation import is_better
from ..learning.setup import Setup
from ..learning.types import ActingState, TrainState
from ..limits import KEY, base, of_agents
from ..training.metrics import judged_cost
from ..training.run_folder import load_saved
from . import hub
from .evaluate import evaluate_states
from .load import WHICH, check_trusted


def publish(folder: pathlib.Path, episodes: int) -> dict[str, Any]:
    """Makes the best policy of a run the pretrained one of its task and method; returns what is known about it.

    Args:
      folder: the run; or the name of a pretrained policy, which is measured again.

    Raises:
      UsageError: no run to be loaded, or one of a task that is not the package's own.
    """
    if hub.is_name(folder):
        return _measure(str(folder), episodes)
    run, which, row, state = choose(folder, episodes)
    config = run.config
    if config.task not in tasks.names() or config.method not in METHODS:
        raise UsageError(
            f"{folder} is of a task or a method of your own, which the package does not have; use pmt export"
        )
    packed = hub.rounded(state)
    facts = {
        "task": config.task,
        "method": config.method,
        "seed": row["seed"],
        "which": which,
        "step": row["step"],
        **run.limits.columns,
        "unpacked": _chosen_by(row),
        "packed": _chosen_by(evaluate_states(run, packed, episodes, deterministic=True, fresh=False)[0]),
        "action_change": action_change(run, packed, state),
        "trained": trained(folder, row["seed"]),
        "training": json.loads((folder / "versions.json").read_text()),
    }
    name = f"{hub.PREFIX}{config.task}/{config.method}"
    hub.save(name, config, state, facts)
    return _measure(name, episodes)


def _measure(name: str, episodes: int) -> dict[str, Any]:
    """Evaluates a pretrained policy from fresh starts; returns what is known about it now."""
    run, state = hub.load(name)
    (row,) = evaluate_states(run, state, episodes, deterministic=True, fresh=True)
    facts = hub.about(name) | {"episodes": episodes, "engine": run.vector.env.engine, "figures": figures(row)}
    hub.store_facts(name, facts)
    return facts


def choose(folder: pathlib.Path, episodes: int) -> tuple[Setup, str, dict[str, Any], ActingState]:
    """The best of all seeds, last and best, of a run.

    Returns:
      the run, `last` or `best`, the seed's row of `evaluate_run`, and what acts, with a leading [1].
    """
    check_trusted(folder)
    run, _, saved = load_saved(folder, "auto")
    states = [saved["last"], saved["best"].state]
    acting = [ActingState(TrainState(state.actor.params, None), state.obs_moments, state.update) for state in states]
    both = jax.tree.map(lambda *parts: jnp.concatenate(parts), *acting)
    rows = evaluate_states(run, both, episodes, deterministic=True, fresh=False)
    means = [{name: x[0] if isinstance(x, tuple) else x for name, x in row.items()} for row in rows]
    reward = np.array([row["episode_reward"] for row in means])
    cost, limit = np.array([judged_cost(row, "") for row in means]).T
    # A limit that training did not use does not count: MAPPO's best would be a policy that has hardly learned.
    limit = np.full_like(limit, np.inf) if run.method.constraint == "none" else limit
    chosen, reached = None, (np.array(-np.inf), np.array(np.inf))
    for i, new in enumerate(zip(reward, cost, strict=True)):
        if is_better(*new, *reached, limit[i]):
            chosen, reached = i, new
    if chosen is None:
        raise UsageError(f"no policy in {folder} has a finite reward and cost")
    which, seed = divmod(chosen, run.config.seeds)
    row = rows[chosen] | {"seed": run.config.seed + seed}
    return run, WHICH[which], row, jax.tree.map(lambda x: x[chosen : chosen + 1], both)


def trained(folder: pathlib.Path, seed: int) -> dict[str, Any] | None:
    """What a seed's training episodes, with noise, reached in the last tenth of the steps; None if no row says it.

    Returns:
      episode_reward, episode_cost (of the worst agent, where they differ) and whether that is `within` the limit.
    """
    rows = [row for row in read_rows(folder / "metrics.jsonl") if row.get("seed") == seed]
    steps = max((row["step"] for row in rows), default=0)
    last = [row for row in rows if row["step"] > 0.9 * steps and row.get("episode_reward") is not None]
    if not last:
        return None
    names = [name for name in last[0] if base(name) in ("episode_reward", "episode_cost", KEY)]
    means = {name: round(float(np.mean([row[name] for row in last])), 6) for name in names}
    cost, limit = judged_cost(means, "")
    worst = max(of_agents(means, "episode_cost") or [means["episode_cost"]])
    return {"episode_reward": means["episode_reward"], "episode_cost": worst, "within": bool(cost <= limit)}


def figures(row: dict[str, Any]) -> dict[str, list[float]]:
    """The means and half-widths of an evaluation's row."""
    return {name: [round(float(x), 6) for x in pair] for name, pair in row.items() if isinstance(pair, tuple)}


def _chosen_by(row: dict[str, Any]) -> dict[str, list[float]]:
    """The values that choose a policy, those of each agent and cost, too."""
    return {name: x for name, x in figures(row).items() if base(name) in ("episode_reward", "episode_cost")}


def action_change(run: Setup, packed: ActingState, original: ActingState, environments: int = 8) -> float:
    """How far packing moves the mean action, in the action's unit, mean over the entries that an agent has.

    Taken in the states of one episode of the packed policy, actions sampled, in each of a few environments.
    """
    vector = tasks.VectorEnv(run.vector.env, environments)

    def change(key: jax.Array, packed: ActingState, original: ActingState) -> jax.Array:
        normalisers = (functools.partial(run.scale, packed.obs_moments), lambda state: state)
        policy = functools.partial(run.nets.act, packed.actor.params)
        memory = run.nets.start(environments)
        start = rollout.start(vector, key, memory=memory)
        _, batch, _ = rollout.collect(vector, start, policy, normalisers, key, vector.horizon)
        seen = rollout.sequences(batch.obs, memory.actor, batch.done) if memory else batch.obs
        mean = run.nets.policies(original.actor.params, seen)[0]
        moved = jnp.abs((mean.swapaxes(0, 1) if memory else mean) - batch.mean)
        return (moved.mean((0, 1)) * vector.spec.action_mask).sum() / vector.spec.action_mask.sum()

    one = jax.tree.map(lambda x: x[0], (packed, original))
    return round(float(jax.jit(change)(jax.random.key(0), *one)), 6)


def rows() -> list[dict[str, Any]]:
    """What is known about every pretrained policy, and its size in bytes."""
    return [{"name": name, "bytes": hub.size(name), **hub.about(name)} for name in hub.names()]
