"""What can be said before training: what is trained, where, and whether these settings can do what was asked for."""

from __future__ import annotations

import math
import os
import pathlib

import jax

from .. import tasks
from ..config.load import convert, read_preset
from ..config.settings import Config
from ..learning.setup import Setup
from ..limits import Limits
from ..output import Say

LITTLE = 1.5  # times what it began as: a multiplier that grows by less has hardly moved


def describe(setup: Setup, out: pathlib.Path, say: Say) -> None:
    """Prints what will be trained, with what, into which run folder, and the `notes` about it."""
    config, device = setup.config, jax.devices()[0]
    steps = config.total_steps
    threads = f", {len(os.sched_getaffinity(0))} CPUs" if hasattr(os, "sched_getaffinity") else ""
    seeds = f"{config.seeds} seed(s) from {config.seed}"
    if setup.trials:
        seeds = f"{config.seeds} runs, seeds {setup.trials.seed.min()} to {setup.trials.seed.max()}"
    say(f"pmt: {setup.label} on {config.task}, {seeds}, into {out}")
    say(f"device {device.device_kind} ({device.platform}{threads}), physics engine {setup.vector.env.engine}")
    if config.physics == "auto" and (advice := tasks.advice(setup.vector.env)):
        say(advice)
    if setup.mesh:
        parts, environments = setup.mesh.devices.shape
        say(
            f"{setup.mesh.size} devices in {jax.process_count()} process(es): seeds in {parts} part(s), "
            f"each seed's environments in {environments}"
        )
    if setup.workers > 1:
        say(f"{setup.workers} worker processes share the seeds and the CPUs")
    say(
        f"batch {config.num_envs} environments x {config.rollout_length} steps = {config.batch_size:,} a seed, "
        f"{config.num_updates:,} updates = {steps:,} steps a seed"
    )
    for line in notes(setup):
        say(line)


def notes(setup: Setup) -> list[str]:
    """What a user should know of a run before it trains, a sentence each."""
    return [*_of_letter(setup), *_of_limit(setup)]


def _of_letter(setup: Setup) -> list[str]:
    """That a method of the paper's equations as printed runs with other settings than the preset's."""
    config = setup.config
    if not setup.method.letter:
        return []
    preset = {name: convert(name, value) for name, value in read_preset("letter").items()}
    sizes = {"num_envs": 1, "minibatches": 1, "rollout_length": config.rollout_length, "steps": config.rollout_length}
    printed = Config(**sizes, **preset)
    values = {name: (repr(getattr(config, name)), repr(getattr(printed, name))) for name in preset}
    other = [f"{name} = {ours} (the paper: {theirs})" for name, (ours, theirs) in values.items() if ours != theirs]
    if not other:
        return []
    more = f" and {len(other) - 3} more" if len(other) > 3 else ""
    return [
        f"note: {setup.label} has the paper's equations, and these settings differ from its text: "
        f"{', '.join(other[:3])}{more}; --preset letter has them all"
    ]


def _of_limit(setup: Setup) -> list[str]:
    """A sentence for each reason why the limit that was asked for may not be kept; none if the task's own is used."""
    config = setup.config
    given, method = setup.asked_limits, setup.label
    if given is None or setup.trials is not None:
        return []
    if setup.method.constraint == "none":
        return [f"note: {method} has no constraint, so cost_limit = {given} is only reported; take mappo_l or f4sg"]
    found = []
    if 0 in given.each:
        found.append(
            f"note: no cost is below a limit of 0, so what {method} does against costs can only grow and the "
            "reward will suffer; a small limit above 0 can be met from below"
        )
    steps, horizon = config.num_updates * config.rollout_length, setup.vector.horizon
    if steps < horizon:
        found.append(
            f"note: {config.num_envs} environments make {steps:,} steps each, less than the {horizon:,} of an episode, "
            "so its cost is hardly measured; raise --steps or lower --num-envs"
        )
    elif setup.method.constraint == "lagrangian" and not setup.method.letter and min(given.each) > 0:
        found += _of_multiplier(config, given)
    return found


def _of_multiplier(config: Config, given: Limits) -> list[str]:
    """Whether costs of twice the limit, in every update of the run, would move the multiplier."""
    begin, rate = config.lambda_init, config.lambda_lr
    end = min(begin * math.exp(min(50.0, rate)), config.lambda_max)
    if end + config.lambda_kp >= LITTLE * begin:
        return []
    if config.lambda_max < LITTLE * begin:
        return [f"note: the multiplier begins at {begin:g} and may not exceed lambda_max = {config.lambda_max:g}"]
    return [
        f"note: with costs of twice the limit of {given}, the multiplier would move from {begin:g} to {end:.3g} in the "
        f"whole run, too little to matter; raise --lambda-lr (now {rate:g}) to {math.log(LITTLE):.2g} or more"
    ]
