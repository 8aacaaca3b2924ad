"""Settings of a run: one flat frozen dataclass, no JAX.

`Hyper` holds the numbers that may differ between runs of one compiled program; `Config` adds everything static. The
metadata of a field define a setting, and `pmt train --help` prints them. `load` reads them from files and words.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from typing import Any, Literal

from ..errors import UsageError
from .fields import (
    AT_LEAST_ONE,
    COUNT,
    FLOAT32_MAX,
    INT32_MAX,
    NOT_NEGATIVE,
    NOT_NEGATIVE_OR_INF,
    POSITIVE,
    POSITIVE_OR_INF,
    SHARE,
    STEPS_OR_INF,
    Bound,
    common,
    constraint,
    emotion,
    learning,
    output,
    simulation,
    sizes,
)


def _is_limit(value: float | tuple[float, ...]) -> bool:
    """Whether `value` is a limit, a nan that leaves it to the task, or a limit for each cost."""
    if isinstance(value, tuple):
        return all(0 <= x <= FLOAT32_MAX for x in value)
    return math.isnan(value) or 0 <= value <= FLOAT32_MAX


@dataclasses.dataclass(frozen=True)
class Hyper:
    """Numbers that are traced: they change or sweep without another compile."""

    actor_lr: float = learning(3e-4, "learning rate of the actors (Adam)", NOT_NEGATIVE)
    critic_lr: float = learning(1e-3, "learning rate of the reward critic and of the cost critic (Adam)", NOT_NEGATIVE)
    lr_half_life: float = learning(
        math.inf,
        "environment steps of a seed in which all learning rates halve; inf keeps them",
        STEPS_OR_INF,
    )
    kl_max: float = learning(
        math.inf,
        "bound on how far an update by clipped epochs moves a policy, mean KL in nats; a longer step is shortened",
        Bound("be a number of nats above 0, or inf", lambda x: x > 0),
    )
    kl_half_life: float = learning(
        math.inf,
        "environment steps of a seed in which kl_max and kl_limit halve; inf keeps them. A step's divergence is the "
        "square of its length, so half of lr_half_life shrinks both alike",
        STEPS_OR_INF,
    )
    std_half_life: float = learning(
        math.inf,
        "environment steps of a seed in which the noise of actions, their standard deviation, halves after "
        "std_decay_start, on top of what the policies learn of it; inf leaves it to them",
        STEPS_OR_INF,
    )
    std_decay_start: float = learning(
        0.0,
        "environment steps of a seed after which std_half_life and actor_lr_half_life count: a policy needs noise to "
        "learn, so late is better",
        NOT_NEGATIVE,
    )
    actor_lr_half_life: float = learning(
        math.inf,
        "environment steps of a seed in which the steps of policies halve after std_decay_start: actor_lr and, by its "
        "square, kl_limit; inf keeps them. Ratios count a step of the mean action in units of the noise: take the "
        "length of std_half_life",
        STEPS_OR_INF,
    )
    max_grad_norm: float = learning(
        10.0,
        "gradients are scaled down to this global norm; inf leaves them. Those of a policy grow with its multiplier",
        POSITIVE_OR_INF,
    )
    gamma: float = learning(0.99, "discount per control step, for reward and cost alike", SHARE)
    gae_lambda: float = learning(0.95, "lambda of generalised advantage estimation, for reward and cost alike", SHARE)
    clip: float = learning(
        0.2, "half-width of the interval to which probability ratios and values are clipped", POSITIVE
    )
    cost_value_clip: float = learning(
        math.nan,
        "half-width of the interval of cost values alone, in standard deviations of the returns; nan takes that of "
        "clip. A clipped value moves by little more than this an update, too slowly for rare costs; inf clips none",
        Bound("be a number above 0, inf, or nan for that of clip", lambda x: math.isnan(x) or x > 0),
    )
    entropy_coef: float = learning(
        0.0,
        "weight of the policy's entropy, in nats summed over action dimensions; below 0 the noise of actions falls "
        "faster",
        Bound("be a number that fits 32 bits", lambda x: -FLOAT32_MAX <= x <= FLOAT32_MAX),
    )
    value_norm_decay: float = learning(0.995, "share of the running moments of returns that survives an update", SHARE)
    cost_limit: float | tuple[float, ...] = constraint(
        math.nan,
        "allowed undiscounted cost of one agent per episode, one number for every cost or a list with one for each; "
        "nan takes the task's own",
        Bound("be a cost per episode of at least 0 that fits 32 bits", lambda x: _is_limit(x)),
    )
    cost_margin: float = constraint(
        0.0,
        "safety margin, a share of the limit: the learner holds costs to (1 - cost_margin) * cost_limit; tables use "
        "cost_limit",
        Bound("lie in [0, 1)", lambda x: 0 <= x < 1),
    )
    cost_seen: float = constraint(
        1.0,
        "probability that the learner notices the cost of a costly step; it scales the task's own limit, too",
        Bound("be a probability above 0", lambda x: 0 < x <= 1),
    )
    lambda_init: float = constraint(0.78, "multiplier before the first update", NOT_NEGATIVE)
    lambda_lr: float = constraint(
        0.1, "step of the multiplier per update, for an excess of 1 in `lambda_unit`", NOT_NEGATIVE
    )
    lambda_kp: float = constraint(
        0.0,
        "PID: weight of the excess, in `lambda_unit`, that is added to the multiplier; 0 for the integral alone",
        NOT_NEGATIVE,
    )
    lambda_kd: float = constraint(
        0.0,
        "PID: weight of the excess's rise since the last update, added as well",
        NOT_NEGATIVE,
    )
    lambda_max: float = constraint(20.0, "upper bound of the multiplier, and P3O's weight of the penalty", NOT_NEGATIVE)
    surrogate_weight: float = constraint(
        1.0,
        "weight of the mean of ratio * cost advantage in the multiplier's step; nan means rollout_length, which "
        "makes the mean over steps a sum",
        NOT_NEGATIVE,
    )
    cost_std_floor: float = constraint(
        0.05, "cost advantages are divided by their standard deviation, but never by less than this", NOT_NEGATIVE
    )
    emotion_lr: float = emotion(1e-3, "learning rate of the fear and regret networks (Adam)", NOT_NEGATIVE)
    fear_lr_start: float = emotion(
        1e-2,
        "learning rate of the fear network in the first update, if above emotion_lr; in update t it is this over t, "
        "until it reaches emotion_lr",
        NOT_NEGATIVE,
    )
    fear_start: float = emotion(
        math.nan,
        "fear before any experience, as a logit: -4 is a probability of 0.018; nan takes the cost rate of the first "
        "batch",
        Bound("be a logit between -20 and 20, or nan", lambda x: math.isnan(x) or -20 <= x <= 20),
    )
    fear_l2: float = emotion(
        1.0, "weight of fear's squared change since collection (its cognitive error)", NOT_NEGATIVE
    )
    regret_l2: float = emotion(1.0, "weight of regret's squared change since collection", NOT_NEGATIVE)
    temperature: float = emotion(0.5, "temperature of the relaxed samples of the gumbel fear losses", POSITIVE)
    omega: float = emotion(
        0.5,
        "share of an action's entries that count, those with the most regret",
        NOT_NEGATIVE_OR_INF,
    )
    regret_max: float = emotion(
        0.9,
        "upper bound of regret; with regret_response = advantage the weight is at most 1 / (1 - regret_max)",
        Bound("lie in [0, 1)", lambda x: 0 <= x < 1),
    )
    kappa: float = emotion(
        0.5, "the weight on the ratio stays within 1 +- kappa * clip; inf for no bound", NOT_NEGATIVE_OR_INF
    )
    limit_lr: float = constraint(
        0.0, "step by which MACPO lowers its limit per update, as a share of the cost beyond it", SHARE
    )
    limit_windup: float = constraint(
        1.0,
        "the most that limit_lr lowers the limit by, in multiples of what a step can take off the cost, and at most "
        "what a step of the first kl_limit could; above 1 more steps only lower the cost as kl_half_life shortens them",
        POSITIVE_OR_INF,
    )
    kl_limit: float = constraint(
        0.01, "size of MACPO's trust region, mean KL in nats, and FOCOPS's bound on the KL of each sample", POSITIVE
    )
    damping: float = constraint(0.1, "added to the Fisher matrix", NOT_NEGATIVE)
    first_step: float = constraint(1.0, "first step of MACPO's line search, as a share of the full step", NOT_NEGATIVE)
    step_decay: float = constraint(0.8, "factor between one step of the line search and the next", NOT_NEGATIVE)
    kl_slack: float = constraint(1.5, "a step is accepted up to this multiple of kl_limit", NOT_NEGATIVE_OR_INF)


@dataclasses.dataclass(frozen=True)
class Config(Hyper):
    """All settings of a run.

    A number that means another setting (`surrogate_weight = nan`, `trust_steps = 0`) is replaced by that setting's
    value when the Config is made.
    """

    task: str = common("lane", "what to train on: a task (pmt envs lists them) or a Python file of your own")
    method: str = common("mappo_l", "which method learns: a row of the table in pmt_jax/config/methods.py")
    steps: int = common(
        1_000_000,
        "environment steps per seed, over all its environments; rounded up to whole updates",
        AT_LEAST_ONE,
    )
    seeds: int = common(1, "number of seeds that train side by side in one program", COUNT)
    seed: int = common(
        0, "the first seed; the others count up from it. Runs repeat bit for bit, but for the hands on a GPU"
    )
    init: str = common("", "run folder or pretrained policy; the run starts from its networks and running moments")
    num_envs: int = sizes(64, "environments per seed, B", COUNT)
    rollout_length: int = sizes(64, "control steps of each environment between updates, T", COUNT)
    epochs: int = sizes(5, "passes over the batch per update, for actors and critics", COUNT)
    minibatches: int = sizes(8, "equal parts into which each pass cuts the batch", COUNT)
    hidden: tuple[int, ...] = sizes(
        (128, 128),
        "widths of the hidden layers of every network",
        Bound("name at least one layer of at least one unit", lambda x: x and 1 <= min(x) and max(x) <= INT32_MAX),
    )
    activation: Literal["relu", "tanh", "elu"] = sizes("relu", "activation function of the hidden layers")
    layer_norm: bool = sizes(True, "layer normalisation after each hidden layer")
    recurrent: Literal["none", "gru"] = sizes(
        "none",
        "gru: the last hidden layer of actors and critics is a gated recurrent unit, which remembers an episode; "
        "minibatches are then whole sequences, equal parts of num_envs",
    )
    obs_norm: Literal["running", "layernorm", "none"] = learning(
        "running", "observations are scaled by running moments, by layer normalisation, or not at all"
    )
    time_limit: Literal["truncate", "terminate"] = learning(
        "truncate",
        "an episode cut by its time limit bootstraps from the state it was cut in, or ends there as if by the task's "
        "own rule (SafePO)",
    )
    episode_starts: Literal["together", "spread"] = learning(
        "together",
        "environments begin their first episodes at once, or spread over the time limit, so that a batch has all parts "
        "of an episode even where only the time limit ends one",
    )
    cost_estimate: Literal["episode", "rate", "average", "critic"] = constraint(
        "episode",
        "estimate of the episode cost for the multiplier: mean of the episodes that finished in this update, the cost "
        "rate of this update's steps times the horizon, that rate's moving average over an episode's time, or the rate "
        "of the cost critic's values",
    )
    lambda_unit: Literal["step", "limit", "relative"] = constraint(
        "step",
        "unit of the excess that changes the multiplier: cost per step, or share of the limit, cut at 1, so that one "
        "lambda_lr fits all limits and horizons; relative: share of the limit less the margin, and the multiplier "
        "changes in proportion to itself, so that it becomes large soon where a tight limit needs it, down to a "
        "hundredth of `lambda_init`",
    )
    fear_time: Literal["next", "current"] = emotion(
        "next", "fear of the state to which an action leads, or of the state in which it is taken"
    )
    fear_loss: Literal["ce", "gumbel_fwd", "gumbel_rev"] = emotion(
        "ce", "cross entropy, or relaxed samples with the divergence from the observed cost forward or reversed"
    )
    regret_response: Literal["letter", "one_sided", "advantage"] = emotion(
        "letter",
        "letter: the change of regret weights the ratio, as in the paper; one_sided: regret itself weakens updates "
        "that repeat the action and strengthens those that avoid it; advantage: regret weights the cost advantage",
    )
    init_fear: str = emotion(
        "", "run folder whose fear network is the start, as a prior; agents of another team start with its mean"
    )
    emotion_epochs: int = emotion(4, "passes over the batch for the fear and regret networks", COUNT)
    trust_steps: int = constraint(
        1,
        "trust-region steps of MACPO per update, each on its part of the batch; 0 means as many as minibatches",
        COUNT,
    )
    physics: Literal["auto", "fused", "mjx", "warp", "mujoco"] = simulation(
        "auto", "simulation engine; auto takes the fastest for the device"
    )
    env: tuple[tuple[str, Any], ...] = simulation((), "the task's own options (pmt envs TASK lists them)")
    log_interval: int = output(1, "updates per row of metrics.jsonl; the last row may have fewer", COUNT)
    eval_interval: int = output(
        0,
        "updates between evaluations under mean actions, rounded up to whole rows; 0 for none",
        Bound("be a number of updates, or 0 for none", lambda x: 0 <= x <= INT32_MAX),
    )
    eval_episodes: int = output(32, "episodes per seed of an evaluation during training", COUNT)

    def __post_init__(self) -> None:
        if math.isnan(self.surrogate_weight):
            object.__setattr__(self, "surrogate_weight", float(self.rollout_length))
        for name in ("fear_start", "cost_value_clip"):
            if math.isnan(getattr(self, name)):  # always the same nan, so that equal settings compare equal
                object.__setattr__(self, name, math.nan)
        if self.trust_steps == 0:
            object.__setattr__(self, "trust_steps", self.minibatches)
        _validate(self)

    @property
    def batch_size(self) -> int:
        """Environment steps of one update of one seed."""
        return self.num_envs * self.rollout_length

    @property
    def num_updates(self) -> int:
        """Updates that cover `steps`."""
        return -(-self.steps // self.batch_size)

    def replace(self, **changes: Any) -> Config:
        """A copy with some fields changed, checked like a new one."""
        return dataclasses.replace(self, **changes)


def differences(old: Config, new: Config) -> dict[str, str]:
    """{field: 'old -> new'} of the settings that are not the same; a nan is the same as a nan."""

    def shown(config: Config, name: str) -> str:
        value = getattr(config, name)
        return ", ".join(f"{option}={x}" for option, x in value) or "none" if name == "env" else repr(value)

    pairs = {f.name: (shown(old, f.name), shown(new, f.name)) for f in dataclasses.fields(Config)}
    return {name: f"{a} -> {b}" for name, (a, b) in pairs.items() if a != b}


FIELDS: dict[str, Any] = typing.get_type_hints(Config)
HYPER_FIELDS: tuple[str, ...] = tuple(f.name for f in dataclasses.fields(Hyper))


def _validate(config: Config) -> None:
    for field in dataclasses.fields(config):
        bound, value, kind = field.metadata["bound"], getattr(config, field.name), FIELDS[field.name]
        if typing.get_origin(kind) is Literal and value not in typing.get_args(kind):
            choices = " | ".join(typing.get_args(kind))
            raise UsageError(f"{field.name} = {value!r} does not fit: expected {choices}")
        if bound and not bound.holds(value):
            shown = list(value) if isinstance(value, tuple) else value
            raise UsageError(f"{field.name} must {bound.words}, not {shown}")
    if config.seed < 0 or config.seed + config.seeds > 2**31:
        raise UsageError(f"seed must lie between 0 and 2**31 - seeds, not {config.seed}")
    if config.lambda_init > config.lambda_max:
        raise UsageError(f"lambda_init = {config.lambda_init} lies above lambda_max = {config.lambda_max}")
    if config.lambda_unit == "relative" and not config.lambda_init:
        raise UsageError("with lambda_unit = relative a multiplier of 0 never moves; set lambda_init above 0")
    for option, hint in ("physics", "set physics = ... (--physics)"), ("name", "name the task itself"):
        if option in dict(config.env):
            raise UsageError(f"'{option}' is no option of a task; {hint} and leave it out of env")
    if config.cost_estimate == "critic" and config.gamma == 1:
        raise UsageError(
            "cost_estimate = critic takes (1 - gamma) times the value for the cost of a step, which is 0; set gamma "
            "below 1 or take another cost_estimate"
        )
    _validate_sizes(config)


def _validate_sizes(config: Config) -> None:
    batch = f"{config.num_envs} * {config.rollout_length} = {config.batch_size}"
    if config.batch_size > INT32_MAX:
        raise UsageError(
            f"one batch of num_envs * rollout_length = {batch} steps does not fit 32 bits; ask for a smaller batch"
        )
    if config.steps < config.batch_size:
        raise UsageError(
            f"steps = {config.steps} is less than one batch of num_envs * rollout_length = {batch} steps; "
            "ask for more steps or a smaller batch"
        )
    if config.num_updates > INT32_MAX:
        raise UsageError(f"steps = {config.steps} is more than 2**31 updates of {config.batch_size} steps")
    for parts, what in ((config.minibatches, "equal minibatches"), (config.trust_steps, "trust steps")):
        if config.batch_size % parts:
            raise UsageError(f"a batch of {config.batch_size} steps cannot be cut into {parts} {what}; take a divisor")
        if config.recurrent != "none" and config.num_envs % parts:
            raise UsageError(
                f"with recurrent = {config.recurrent} the sequences of num_envs = {config.num_envs} environments "
                f"cannot be cut into {parts} {what}; take a divisor"
            )
