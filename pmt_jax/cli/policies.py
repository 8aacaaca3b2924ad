"""`pmt eval`, `pmt export`, `pmt hub`: what a trained team is used for."""

from __future__ import annotations

import argparse
import math
import pathlib
from typing import Any

from .. import numerics, tasks
from ..config.load import convert, expectation
from ..config.settings import FIELDS
from ..errors import UsageError
from ..files import to_stderr
from ..output import result, say
from .parser import RUN, add_deterministic, add_seed, add_trust, add_which, command, path, whole
from .process import interruptible


def add(commands: Any) -> None:
    """Adds the commands."""
    evaluation = command(
        commands,
        "eval",
        run_eval,
        "evaluate a trained run: pmt eval runs/x; or a baseline: pmt eval voltage_33 --policy droop",
        description="Reward, cost, violation rate and the task's own metrics over whole episodes with fixed keys.",
    )
    evaluation.add_argument("source", metavar="RUN|TASK", help=f"{RUN}; with --policy a task's name")
    evaluation.add_argument("--policy", metavar="WORD", help="a baseline: zero, random, droop or opf (voltage tasks)")
    evaluation.add_argument("--env", action="append", metavar="NAME=VALUE", help="with --policy: the task's options")
    evaluation.add_argument("--episodes", type=whole(1), default=32, metavar="N", help="episodes per seed (default 32)")
    add_deterministic(evaluation)
    add_which(evaluation)
    add_trust(evaluation)
    evaluation.add_argument(
        "--save",
        type=path,
        metavar="FILE.npz|minari:NAME-v0",
        help="also write every step of S seeds, E episodes, T steps and N agents, as a Minari data set or as arrays: "
        "seed [S], length [S, E], obs [S, E, T, N, O], final_obs [S, E, N, O], action [S, E, T, N, A], "
        "reward [S, E, T]; cost and true_cost [S, E, T, N, K]; terminated, truncated and info/NAME [S, E, T]; "
        "0 after the end of an episode",
    )
    engines = expectation(FIELDS["physics"])
    evaluation.add_argument("--physics", metavar="WORD", help=f"an engine other than the run's: {engines}")

    export = command(
        commands,
        "export",
        run_export,
        "write a trained policy as files: pmt export runs/x -o policy",
        description="Writes policy.stablehlo (jax.export), policy.npz (weights) and numpy_policy.py (their loader).",
    )
    export.add_argument("source", metavar="RUN", type=path, help=RUN)
    export.add_argument("-o", "--out", type=path, required=True, metavar="DIR", help="the folder to write")
    export.add_argument("--onnx", action="store_true", help="also policy.onnx; needs pip install 'pmt-jax[onnx]'")
    add_seed(export)
    add_which(export)
    add_trust(export)

    command(commands, "hub", run_hub, "list the pretrained policies with their evaluations")


@interruptible()
def run_eval(arguments: argparse.Namespace) -> int:
    """Prints what a run's policies, or a baseline, reach."""
    for flag in ("which", "physics") if arguments.policy else ("env",):
        if getattr(arguments, flag) is not None:
            why = "belongs to a run; leave out --policy" if arguments.policy else "needs --policy: a run keeps its task"
            raise UsageError(f"--{flag} {why}")
    _check_kind(arguments.source, arguments.policy)
    numerics.check()
    from ..policies import evaluate
    from ..trust import check_source, trusting

    episodes = arguments.episodes
    if arguments.policy:
        check_source(arguments.source, ())
        options = dict(convert("env", arguments.env or ()))
        rows = [evaluate.evaluate_baseline(arguments.source, arguments.policy, episodes, options, arguments.save)]
        how = f"policy {arguments.policy}"
    else:
        run, which = pathlib.Path(arguments.source), arguments.which or "last"
        with trusting(arguments.trust):
            chosen = (arguments.deterministic, which, arguments.physics)
            rows = evaluate.evaluate_run(run, episodes, *chosen, say=say, save=arguments.save)
        how = f"{'mean' if arguments.deterministic else 'sampled'} actions"
        how += " of the best policy" if which == "best" else ""
    shown = "mean +- half-width of the 95 % interval" if episodes > 1 else "one episode has no interval"
    count = f"{episodes} episode{'s' * (episodes > 1)}"
    result(f"{arguments.source}: {count} a seed, {how}; {shown}")
    for row in rows:
        say_row(row)
    if arguments.save:
        result(f"wrote every step to {arguments.save}")
    return 0


def _check_kind(source: str, policy: str | None) -> None:
    """Refuses a task where a run is expected, and a run where a task is."""
    is_run = source.startswith("hub:") or (pathlib.Path(source) / "config.toml").is_file()
    is_task = source in tasks.names() or tasks.is_file(source)
    if policy is None and is_task and not is_run:
        raise UsageError(
            f"{source} is a task and no run: name a folder that pmt train wrote; a baseline, which voltage and "
            "multi_goal tasks have, needs --policy"
        )
    if policy is not None and is_run and not is_task:
        raise UsageError(
            f"{source} is a run and no task: leave out --policy to evaluate it, or name a task, which pmt envs lists"
        )


def say_row(row: dict[str, Any]) -> None:
    """One seed's metrics, a line each."""
    from ..limits import Limits

    whose = f"seed {row['seed']} after {row['step']:,} steps " if "seed" in row else ""
    result(f"{whose}(cost limit {Limits.of_row(row)} an episode)")
    metrics = {name: x for name, x in row.items() if isinstance(x, tuple)}
    width = max(24, *map(len, metrics))
    for name, (mean, half) in metrics.items():
        result(f"  {name:{width}} {mean:12.4f}" + ("" if math.isnan(half) else f" +- {half:.4f}"))
    if row.get("faults"):
        result(f"  note: {row['faults']}")


def run_export(arguments: argparse.Namespace) -> int:
    """Writes a policy as files."""
    with interruptible():
        numerics.check()
        from ..policies.export import export_policy
        from ..trust import trusting

    with trusting(arguments.trust):
        chosen = (arguments.seed, arguments.which or "last")
        *names, last = export_policy(arguments.source, arguments.out, *chosen, onnx=arguments.onnx)
    say(f"wrote {', '.join(names)} and {last} into {arguments.out}")
    return 0


def _is_within(facts: dict[str, Any]) -> bool:
    """Whether the mean costs of a pretrained policy, of each agent and cost, are within its limit."""
    from ..training.metrics import judged_cost

    means = {name: mean for name, (mean, _) in facts["figures"].items()}
    limits = {name: x for name, x in facts.items() if name.startswith("cost_limit")}
    cost, limit = judged_cost(means | limits, "")
    return cost <= limit


@interruptible()
def run_hub(arguments: argparse.Namespace) -> int:
    """Lists the pretrained policies."""
    del arguments
    from ..limits import WORST
    from ..policies import hub

    result(
        "mean actions, per episode; +- half-width of the 95 % interval over episodes; training: reward / cost with "
        "noise, the last tenth of the steps (docs/howto/pretrained.md)"
    )
    width = max(map(len, hub.names()), default=0)
    for name in hub.names():
        try:
            facts = hub.about(name)
        except UsageError as error:  # the others are whole
            to_stderr(f"left out: {error}")
            continue
        figures, limit = facts["figures"], f"limit {facts['cost_limit']:g}"
        limit += ", within" if _is_within(facts) else ", beyond"
        if trained := facts.get("trained"):
            kept = "within" if trained["within"] else "beyond"
            limit += f"; training {trained['episode_reward']:.2f} / {trained['episode_cost']:.2f}, {kept}"
        reward, rewards = figures["episode_reward"]
        cost, costs = figures.get(f"episode_cost{WORST}", figures["episode_cost"])
        result(f"{name:{width}} reward {reward:9.2f} +- {rewards:<7.2f} cost {cost:7.2f} +- {costs:<6.2f} {limit}")
    return 0
