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
    lr_end: float = learning(
        1.0,
        "share of all learning rates that is left at the end of the run; they fall exponentially, and the trust region "
        "by the square",
        Bound("be a share above 0 and at most 1", lambda x: 0 < x <= 1),
    )
    kl_max: float = learning(
        math.inf,
        "bound on how far an update by clipped epochs moves a policy, mean KL in nats; a longer step is shortened",
        Bound("be a number of nats above 0, or inf", lambda x: x > 0),
    )
    max_grad_norm: float = learning(
        math.inf,
        "gradients are scaled down to this global norm; inf leaves them. Those of a policy grow with its multiplier",
        POSITIVE_OR_INF,
    )
    gamma: float = learning(0.99, "discount per control step, for reward and cost alike", SHARE)
    gae_lambda: float = learning(0.95, "lambda of generalised advantage estimation, for reward and cost alike", SHARE)
    clip: float = learning(
        0.2, "half-width of the interval to which probability ratios and values are clipped", POSITIVE
    )
    entropy_coef: float = learning(
        0.0,
        "weight of the policy's entropy, in nats summed over action dimensions; below 0 the noise of actions falls "
        "faster",
        Bound("be a number that fits 32 bits", lambda x: -FLOAT32_MAX <= x <= FLOAT32_MAX),
    )
    cost_limit: float | tuple[float, ...] = constraint(
        math.nan,
        "allowed undiscounted cost of one agent per episode, one number for every cost or a list with one for each; "
        "nan takes the task's own",
        Bound("be a cost per episode of at least 0 that fits 32 bits", lambda x: _is_limit(x)),
    )
    cost_margin: float = constraint(
        0.2,
        "safety margin, a share of the limit: the learner holds costs to (1 - cost_margin) * cost_limit; tables use "
        "cost_limit",
        Bound("lie in [0, 1)", lambda x: 0 <= x < 1),
    )
    cost_seen: float = constraint(
        1.0,
        "probability that the learner notices the cost of a costly step; it scales the task's own limit, too",
        Bound("be a probability above 0", lambda x: 0 < x <= 1),
    )
    lambda_init: float = constraint(2.0, "multiplier before the first update", NOT_NEGATIVE)
    lambda_lr: float = constraint(
        1.0,
        "how far costs of twice the limit in every update of the run move the multiplier: the logarithm of what it is "
        "multiplied by, and for mappo_pid what is added to it; with the letter the step in each update",
        NOT_NEGATIVE,
    )
    lambda_kp: float = constraint(
        0.5,
        "PID: weight of the excess, a share of the limit, that is added to the multiplier; 0 for the integral alone",
        NOT_NEGATIVE,
    )
    lambda_kd: float = constraint(
        0.0,
        "PID: weight of the excess's rise since the last update, added as well",
        NOT_NEGATIVE,
    )
    lambda_max: float = constraint(20.0, "upper bound of the multiplier, and P3O's weight of the penalty", NOT_NEGATIVE)
    emotion_lr: float = emotion(1e-3, "learning rate of the fear and regret networks (Adam)", NOT_NEGATIVE)
    emotion_l2: float = emotion(
        1.0, "weight of the squared change of fear and regret since collection (their cognitive error)", NOT_NEGATIVE
    )
    omega: float = emotion(
        0.5,
        "share of an action's entries that count, those with the most regret",
        NOT_NEGATIVE_OR_INF,
    )
    kappa: float = emotion(
        0.5, "the weight on the ratio stays within 1 +- kappa * clip; inf for no bound", NOT_NEGATIVE_OR_INF
    )
    limit_lr: float = constraint(
        0.1, "step by which MACPO lowers its limit per update, as a share of the cost beyond it", SHARE
    )
    kl_limit: float = constraint(
        0.01, "size of MACPO's trust region, mean KL in nats, and FOCOPS's bound on the KL of each sample", POSITIVE
    )


@dataclasses.dataclass(frozen=True)
class Config(Hyper):
    """All settings of a run."""

    task: str = common("lane", "what to train on: a task (pmt envs lists them) or a Python file of your own")
    method: str = common("mappo_l", "which method learns: a row of the table in pmt_jax/config/methods.py")
    steps: int = common(
        1_000_000,
        "environment steps per seed, over all its environments; rounded up to whole updates",
        AT_LEAST_ONE,
    )
    seeds: int = common(1, "number of seeds that train side by side in one program", COUNT)
    seed: int = common(
        0,
        "the first seed; the others count up from it. Runs repeat bit for bit, but not on the engine warp, which auto "
        "takes for the hands on a GPU",
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
        "spread",
        "environments begin their first episodes at once, or spread over the time limit, so that a batch has all parts "
        "of an episode even where only the time limit ends one",
    )
    fear_time: Literal["next", "current"] = emotion(
        "next", "fear of the state to which an action leads, or of the state in which it is taken"
    )
    emotion_epochs: int = emotion(4, "passes over the batch for the fear and regret networks", COUNT)
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
        _validate(self)

    @property
    def batch_size(self) -> int:
        """Environment steps of one update of one seed."""
        return self.num_envs * self.rollout_length

    @property
    def num_updates(self) -> int:
        """Updates that cover `steps`."""
        return -(-self.steps // self.batch_size)

    @property
    def total_steps(self) -> int:
        """Environment steps of a seed: `steps`, rounded up to whole updates."""
        return self.num_updates * self.batch_size

    def replace(self, **changes: Any) -> Config:
        """A copy with some fields changed, whose bounds are checked like a new one's; values need the fields' types."""
        return dataclasses.replace(self, **changes)


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
    for option, hint in ("physics", "set physics = ... (--physics)"), ("name", "name the task itself"):
        if option in dict(config.env):
            raise UsageError(f"'{option}' is no option of a task; {hint} and leave it out of env")
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
    parts = {f"a batch of {config.batch_size} steps": config.batch_size}
    if config.recurrent != "none":
        parts[f"the sequences of {config.num_envs} environments"] = config.num_envs
    for what, count in parts.items():
        if count % config.minibatches:
            raise UsageError(f"{what} cannot be cut into {config.minibatches} equal minibatches; take a divisor")
