"""Settings of a run: one flat frozen dataclass, TOML in, TOML out, no JAX.

`Hyper` holds the numbers that may differ between runs of one compiled program; `Config` adds everything static.
A file in `configs/` holds what all methods of a task share, then a `[method.NAME]` table of what differs.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
import re
import tomllib
import types
import typing
from typing import Any, Literal

from ..errors import UsageError
from ..tasks import absolute, did_you_mean, is_file
from .methods import METHODS

_PACKAGE = pathlib.Path(__file__).parents[1]
CONFIG_DIR = _PACKAGE / "configs" if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent / "configs"


@dataclasses.dataclass(frozen=True)
class Hyper:
    """Numbers that are traced: change or sweep them without compiling again.

    Attributes:
      actor_lr: Adam step size of the actors.
      critic_lr: Adam step size of the reward critic and the cost critic.
      lr_half_life: environment steps of a seed in which all Adam step sizes halve; inf keeps them.
      kl_max: how far an update by clipped epochs may move a policy, mean KL in nats; beyond it the step is shortened.
      max_grad_norm: gradients are scaled down to this global norm.
      gamma: per control step, for reward and cost alike.
      gae_lambda: lambda of generalised advantage estimation, for reward and cost alike.
      clip: half-width of the interval the probability ratio is clipped to, and of the value clip.
      entropy_coef: weight of the policy's entropy, in nats summed over action dimensions.
      value_norm_decay: how much of the running moments of returns survives an update.
      cost_limit: allowed undiscounted cost of one agent per episode; nan takes the task's own limit.
      cost_seen: probability that a costly step is felt by the learner; the task's own limit is scaled with it.
      cost_false: probability that a safe step is felt as costly.
      lambda_init: multiplier before the first update.
      lambda_lr: step of the multiplier per update, for a violation in cost per step.
      lambda_max: upper bound of the multiplier.
      surrogate_weight: weight of the mean of ratio * cost advantage in the multiplier's step.
      cost_std_floor: cost advantages are divided by their deviation, but never by less than this.
      emotion_lr: Adam step size of the fear and regret prior networks.
      fear_l2: weight of fear's squared change of mind since collection (its cognitive error).
      regret_l2: the same for regret.
      temperature: of the relaxed samples of the gumbel fear losses.
      omega: share of an action's entries whose regret counts, or the threshold of regret from which it counts.
      regret_max: regret is cut here; where it weighs on the cost advantage, by at most 1 / (1 - regret_max).
      kappa: the weight on the ratio stays within 1 +- kappa * clip; inf for no bound.
      kl_limit: size of MACPO's trust region, mean KL in nats.
      damping: added to the Fisher matrix.
      first_step: first step of MACPO's line search, as a share of the full step.
      step_decay: each further step of the line search is this much shorter.
      kl_slack: a step is accepted up to this multiple of kl_limit.
    """

    actor_lr: float = 3e-4
    critic_lr: float = 1e-3
    lr_half_life: float = math.inf
    kl_max: float = math.inf
    max_grad_norm: float = 10.0
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy_coef: float = 0.0
    value_norm_decay: float = 0.995
    cost_limit: float = math.nan
    cost_seen: float = 1.0
    cost_false: float = 0.0
    lambda_init: float = 0.78
    lambda_lr: float = 0.1
    lambda_max: float = 20.0
    surrogate_weight: float = 1.0
    cost_std_floor: float = 0.05
    emotion_lr: float = 1e-3
    fear_l2: float = 1.0
    regret_l2: float = 1.0
    temperature: float = 0.5
    omega: float = 0.5
    regret_max: float = 0.9
    kappa: float = 0.5
    kl_limit: float = 0.01
    damping: float = 0.1
    first_step: float = 1.0
    step_decay: float = 0.8
    kl_slack: float = 1.5


@dataclasses.dataclass(frozen=True)
class Config(Hyper):
    """A run in full.

    Attributes:
      task: what to train on; `pmt envs` lists them, and a Python file may hold one of your own.
      method: who learns; a row of the table in pmt_jax/config/methods.py.
      steps: environment steps to train for, per seed, over all its environments; rounded up to whole chunks.
      seeds: how many seeds train side by side in one program.
      seed: the first seed; the others count up from it. It names a run to the last bit, but on physics warp.
      num_envs: environments per seed, B.
      rollout_length: control steps each environment takes between updates, T.
      epochs: passes over the batch per update, for every network.
      minibatches: parts the batch is cut into in each pass.
      hidden: widths of the hidden layers of every network.
      activation: of the hidden layers.
      layer_norm: layer normalisation after each hidden layer.
      obs_norm: running moments over the whole run, layer normalisation of the input, or nothing.
      cost_estimate: how the episode cost is estimated for the multiplier: mean of the episodes that finished in this
        update, the cost rate of this update's steps times the horizon, or the same of the cost critic's values.
      cost_advantage: standardised (with a floor) or only centred in the policy's loss.
      fear_time: fear of the state that an action leads to, or of the one it is taken in.
      fear_loss: cross entropy, or relaxed samples with the divergence from the observed cost forward or reversed.
      fear_history: which remembered fear a change of mind is measured from: of the same state, or of a random one.
      regret_mask: which action entries count: the share omega with most regret, those from omega on, or all.
      regret_target: how deliberate an action was: density relative to the mode, or tail probability.
      regret_response: what regret does to the ratio: the paper's letter (its change weighs on it), one-sided (regret
        itself weakens what would repeat the action and strengthens what avoids it), or regret weighs the cost
        advantage instead.
      emotion_epochs: passes over the batch for the fear and regret prior networks.
      trust_steps: trust-region steps per update, each on its part of the batch.
      physics: which engine simulates; auto takes the fastest for the device.
      env: the task's own options, as name=value.
      log_interval: updates per row of metrics.jsonl.
      eval_interval: updates between evaluations under mean actions, rounded up to whole rows; 0 for none.
      eval_episodes: episodes per seed of such an evaluation.
    """

    task: str = "lane"
    method: str = "mappo_l"
    steps: int = 1_000_000
    seeds: int = 1
    seed: int = 0
    num_envs: int = 64
    rollout_length: int = 64
    epochs: int = 5
    minibatches: int = 8
    hidden: tuple[int, ...] = (128, 128)
    activation: Literal["relu", "tanh", "elu"] = "relu"
    layer_norm: bool = True
    obs_norm: Literal["running", "layernorm", "none"] = "running"
    cost_estimate: Literal["episode", "rate", "critic"] = "episode"
    cost_advantage: Literal["std", "center"] = "std"
    fear_time: Literal["next", "current"] = "next"
    fear_loss: Literal["ce", "gumbel_fwd", "gumbel_rev"] = "ce"
    fear_history: Literal["rollout", "random"] = "rollout"
    regret_mask: Literal["top", "threshold", "none"] = "top"
    regret_target: Literal["mode", "tail"] = "mode"
    regret_response: Literal["letter", "one_sided", "advantage"] = "letter"
    emotion_epochs: int = 4
    trust_steps: int = 1
    physics: Literal["auto", "mjx", "warp", "mujoco"] = "auto"
    env: tuple[tuple[str, Any], ...] = ()
    log_interval: int = 1
    eval_interval: int = 0
    eval_episodes: int = 32

    def __post_init__(self) -> None:
        _validate(self)

    @property
    def batch_size(self) -> int:
        """Environment steps of one update of one seed."""
        return self.num_envs * self.rollout_length

    @property
    def num_chunks(self) -> int:
        """Chunks of `log_interval` updates that cover `steps`."""
        return math.ceil(self.steps / (self.batch_size * self.log_interval))

    @property
    def num_updates(self) -> int:
        """Updates that cover `steps`, in whole chunks."""
        return self.num_chunks * self.log_interval

    def replace(self, **changes: Any) -> Config:
        """A copy with some fields changed, checked like a new one; values may be strings, as on a command line."""
        return dataclasses.replace(self, **{k: convert(k, v) for k, v in changes.items()})


def differences(old: Config, new: Config) -> dict[str, str]:
    """{field: 'old -> new'} of the settings that are not the same; a nan is the same as a nan."""
    pairs = {f.name: (repr(getattr(old, f.name)), repr(getattr(new, f.name))) for f in dataclasses.fields(Config)}
    return {name: f"{a} -> {b}" for name, (a, b) in pairs.items() if a != b}


FIELDS: dict[str, Any] = typing.get_type_hints(Config)
HYPER_FIELDS: tuple[str, ...] = tuple(f.name for f in dataclasses.fields(Hyper))


PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    # What the equations literally say; it runs, it need not learn.
    "paper_letter": {
        "cost_estimate": "critic",
        "surrogate_weight": "rollout_length",
        "fear_time": "current",
        "fear_loss": "gumbel_rev",
        "kappa": math.inf,
    },
    # What the published baselines' code did: a multiplier that stands still, unfloored standardisation, and a short
    # trust-region step per minibatch.
    "reference": {
        "lambda_lr": 0.0,
        "cost_std_floor": 0.0,
        "obs_norm": "layernorm",
        "kl_limit": 0.0065,
        "first_step": 0.27,
        "step_decay": 0.5,
        "kl_slack": 1.0,
        "trust_steps": "minibatches",
    },
}  # a setting's name as a value stands for that setting's value


def load_config(
    source: str | pathlib.Path, method: str | None = None, preset: str = "default", **overrides: Any
) -> Config:
    """Settings of a task: defaults, then the file, its [method.NAME] table, the preset, then `overrides`.

    Args:
      source: a name in configs/, the path of a TOML file (a run's own config.toml included), or a Python file with an
        environment of your own (`my_env.py`, `my_env.py:Name`).
      method: a name in METHODS; the file's own choice if None.
      preset: a name in PRESETS.
      **overrides: any field of Config.

    Raises:
      UsageError: no such file, an unknown field, or a value of the wrong type or range.

    Example:
      >>> load_config("lane", method="happo", num_envs=8).num_envs
      8
    """
    table = _read(source)
    tables = table.pop("method", {})
    if isinstance(tables, str):  # a run's own config.toml names its one method
        method, tables = method or tables, {}
    method = method or str(Config.method)
    if not isinstance(tables, dict) or not all(isinstance(t, dict) for t in tables.values()):
        raise UsageError(f"{source}: 'method' must be a name, or [method.NAME] tables")
    for name in (*tables, method):
        if name not in METHODS:
            raise UsageError(f"unknown method '{name}'{did_you_mean(name, METHODS)}")
    if preset not in PRESETS:
        raise UsageError(f"unknown preset '{preset}'{did_you_mean(preset, PRESETS)}")
    values = {**table, **tables.get(method, {}), **overrides, "method": method}
    for name, value in PRESETS[preset].items():
        other = values.get(value, getattr(Config, value)) if value in FIELDS else value
        values = {**values, name: overrides.get(name, other)}
    if "task" in values:
        values["task"] = absolute(str(values["task"]))
    return Config(**{k: convert(k, v) for k, v in values.items()})


def _read(source: str | pathlib.Path) -> dict[str, Any]:
    if is_file(str(source)):
        return {"task": str(source)}
    known = sorted(p.stem for p in CONFIG_DIR.glob("*.toml"))
    path = CONFIG_DIR / f"{source}.toml" if str(source) in known else pathlib.Path(source)
    if not path.is_file():
        if path.suffix == ".toml":
            raise UsageError(f"there is no configuration file {path}")
        raise UsageError(f"unknown task '{source}'{did_you_mean(str(source), known)} (pmt envs lists all)")
    try:
        return tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path} is not valid TOML: {error}") from None


def convert(name: str, value: Any) -> Any:
    """`value` (from TOML, a keyword or a command line) as the type that field `name` has.

    Raises:
      UsageError: unknown field, or a value that does not fit.
    """
    if name not in FIELDS:
        raise UsageError(f"unknown setting '{name}'{did_you_mean(name, FIELDS)}")
    try:
        return _convert(FIELDS[name], value)
    except (ValueError, TypeError):
        hint = expectation(FIELDS[name])
        raise UsageError(f"{name} = {value!r} does not fit: expected {hint}") from None


def _convert(kind: Any, value: Any) -> Any:
    origin, parameters = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value in parameters:
            return value
    elif origin in (types.UnionType, typing.Union):
        return None if value in (None, "none") else _convert(next(p for p in parameters if p is not type(None)), value)
    elif kind is bool:
        words = {"true": True, "false": False}
        return value if isinstance(value, bool) else words[value] if value in words else _fail()
    elif kind is int:
        number = _fail() if isinstance(value, bool) else float(value)
        return int(number) if number == int(number) else _fail()
    elif kind is float:
        return _fail() if isinstance(value, bool) else float(value)
    elif kind is str:
        return value if isinstance(value, str) else _fail()
    elif parameters == (int, ...):
        parts = value.split(",") if isinstance(value, str) else value
        return tuple(_convert(int, part) for part in parts)
    else:  # the task's own options
        items = value.items() if isinstance(value, dict) else value
        pairs = [item.split("=", 1) if isinstance(item, str) else item for item in items]
        return tuple(sorted((str(k), _literal(v)) for k, v in pairs))
    return _fail()


def _literal(value: Any) -> Any:
    """A task option as TOML would read it: numbers and booleans are recognised, the rest are strings."""
    try:
        return tomllib.loads(f"x = {value}")["x"] if isinstance(value, str) else value
    except tomllib.TOMLDecodeError:
        return value


def _fail() -> typing.NoReturn:
    raise ValueError


def expectation(kind: Any) -> str:
    """What a field of type `kind` takes, in words."""
    if typing.get_origin(kind) is Literal:
        return " | ".join(typing.get_args(kind))
    if kind in (int, float, bool, str):
        return {int: "a whole number", float: "a number", bool: "true or false", str: "a word"}[kind]
    if typing.get_args(kind) == (int, ...):
        return "whole numbers, as 128,128"
    return "name=value"


def descriptions() -> dict[str, str]:
    """What each field means, read from the docstrings of Hyper and Config."""
    entry = re.compile(r"^      (\w+): (.*(?:\n        .*)*)", re.MULTILINE)
    return {
        name: re.sub(r"\s+", " ", text).strip()
        for cls in (Hyper, Config)
        for name, text in entry.findall((cls.__doc__ or "").split("Attributes:")[1])
    }


def to_toml(config: Config) -> str:
    """The run's settings as a file that `load_config` reads back to an equal Config."""
    fields = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    options = fields.pop("env")
    lines = [f"{name} = {_toml(value)}" for name, value in fields.items() if value is not None]
    return "\n".join([*lines, *(["", "[env]"] if options else []), *(f"{k} = {_toml(v)}" for k, v in options), ""])


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return f"[{', '.join(map(str, value))}]" if isinstance(value, tuple | list) else repr(value)


def _validate(config: Config) -> None:
    counts = ("steps", "seeds", "num_envs", "rollout_length", "epochs", "minibatches")
    counts += ("log_interval", "eval_episodes", "trust_steps")
    for name in counts:
        if getattr(config, name) < 1:
            raise UsageError(f"{name} must be at least 1, not {getattr(config, name)}")
    if config.eval_interval < 0:
        raise UsageError(f"eval_interval must be a number of updates, or 0 for none, not {config.eval_interval}")
    if config.seed < 0 or config.seed + config.seeds > 2**31:
        raise UsageError(f"seed must lie between 0 and 2**31 - seeds, not {config.seed}")
    if not config.hidden or min(config.hidden) < 1:
        raise UsageError(f"hidden must name at least one layer of at least one unit, not {list(config.hidden)}")
    if config.steps < config.batch_size:
        raise UsageError(
            f"steps = {config.steps} is less than one batch of num_envs * rollout_length = {config.num_envs} * "
            f"{config.rollout_length} = {config.batch_size} steps; ask for more steps or a smaller batch"
        )
    if config.batch_size % config.minibatches:
        raise UsageError(
            f"a batch of {config.batch_size} steps cannot be cut into {config.minibatches} equal minibatches"
        )
    for name in ("gamma", "gae_lambda", "value_norm_decay"):
        if not 0 <= getattr(config, name) <= 1:
            raise UsageError(f"{name} must lie in [0, 1], not {getattr(config, name)}")
    rates = ("actor_lr", "critic_lr", "emotion_lr", "fear_l2", "regret_l2", "lambda_init", "lambda_lr", "lambda_max")
    for name in (*rates, "entropy_coef", "clip", "max_grad_norm", "surrogate_weight", "cost_std_floor"):
        if not 0 <= getattr(config, name) < math.inf:
            raise UsageError(f"{name} must be a number that is not negative, not {getattr(config, name)}")
    for name in ("kappa", "omega", "temperature", "damping", "kl_limit", "first_step", "step_decay", "kl_slack"):
        if not getattr(config, name) >= 0:
            raise UsageError(f"{name} must be a number that is not negative, not {getattr(config, name)}")
    if not config.kl_max > 0:
        raise UsageError(f"kl_max must be a number of nats above 0, or inf, not {config.kl_max}")
    if not config.lr_half_life > 0:
        raise UsageError(f"lr_half_life must be a number of steps above 0, or inf, not {config.lr_half_life}")
    if not 0 < config.cost_seen <= 1:
        raise UsageError(f"cost_seen must be a probability above 0, not {config.cost_seen}")
    if not 0 <= config.cost_false < 1:
        raise UsageError(f"cost_false must lie in [0, 1), not {config.cost_false}")
    if not 0 <= config.regret_max < 1:
        raise UsageError(f"regret_max must lie in [0, 1), not {config.regret_max}")
    if config.batch_size % config.trust_steps:
        raise UsageError(f"a batch of {config.batch_size} steps cannot be cut into {config.trust_steps} trust steps")
    if config.cost_limit < 0 or math.isinf(config.cost_limit):
        raise UsageError(f"cost_limit must be a cost per episode of at least 0, not {config.cost_limit}")
