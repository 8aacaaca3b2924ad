"""What is fixed before training begins."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import numerics, tasks
from ..config.methods import Method, find, label
from ..config.settings import HYPER_FIELDS, Config, Hyper
from ..errors import UsageError
from ..limits import Limits
from . import networks
from .maths import running_moments
from .types import RunningMoments


@dataclasses.dataclass(frozen=True)
class Trials:
    """What trains side by side in one program if it is more than the seeds of one run: a part of a sweep.

    Attributes:
      hyper: every lane's own settings, leaves [L], or [] if all share them, limits of K costs [L, K] or [K].
      seed: [L] int32.
      index: [L] int, which of its run's seeds a lane is.
    """

    hyper: Hyper
    seed: jax.Array
    index: jax.Array


@dataclasses.dataclass(frozen=True)
class Setup:
    """What is fixed before training: settings, a row of the method table, the task and the networks' functions.

    With `trials`, config.seeds counts these, and they take the place of the config's traced numbers and seeds.
    With `mesh`, it is split over several devices (see sharding.py). With more than one of `workers`, so many worker
    processes share its seeds. With `debug`, its program checks that all it computes is finite (see debug.py).
    """

    config: Config
    method: Method
    vector: tasks.VectorEnv
    nets: networks.Networks
    trials: Trials | None = None
    mesh: jax.sharding.Mesh | None = None
    workers: int = 1
    debug: bool = False

    @property
    def label(self) -> str:
        """What rows, tables and folders call the method."""
        return label(self.config.method)

    @property
    def asked_limits(self) -> Limits | None:
        """The limits that the settings name; None if they leave them to the task."""
        return Limits.configured(self.config, self.vector.spec.num_costs)

    @property
    def limits(self) -> Limits:
        """What the learner holds the costs of every agent to, as it observes them."""
        return Limits.of_run(self.config, self.vector.spec)

    @property
    def limits_of_seeds(self) -> list[Limits]:
        """`limits` of everything that trains side by side, `config.seeds` of them."""
        if self.trials is None:
            return [self.limits] * self.config.seeds
        count = self.vector.spec.num_costs
        each = np.asarray(self.trials.hyper.cost_limit).reshape(-1, count)
        return [Limits(tuple(one)) for one in np.broadcast_to(each, (self.config.seeds, count)).tolist()]

    @property
    def own_critics(self) -> bool:
        """Whether critics see each agent's own observation in place of the state."""
        return self.method.critic == "observation"

    @property
    def shares_cost(self) -> bool:
        """Whether the task declares that each step costs all its agents the same."""
        return tasks.shares_cost(self.vector.env)

    @property
    def overflow(self) -> str | None:
        """The metric that is above 0 if the physics lost contacts; None if the task declares none."""
        name = tasks.declarations(self.vector.env).overflow
        return None if name is None else f"info/{name}"

    def scale(self, moments: RunningMoments, x: jax.Array) -> jax.Array:
        """Observations or states as the networks see them: scaled by running `moments` if the config asks for it."""
        return running_moments.normalise_obs(moments, x) if self.config.obs_norm == "running" else x

    @property
    def hyper(self) -> Hyper:
        """The numbers of `config` that are traced, as f32 scalars; of several costs, the limits are one array [K]."""
        limits = self.limits.each if self.vector.spec.num_costs > 1 else self.limits.total
        values = {name: getattr(self.config, name) for name in HYPER_FIELDS} | {"cost_limit": limits}
        traced: dict[str, Any] = {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}
        return Hyper(**traced)

    @property
    def vmap_arguments(self) -> tuple[Hyper, jax.Array, tuple[int | None, int]]:
        """What one program trains: settings (leaves [] or [seeds]), keys [seeds], and the axes that vmap maps over."""
        keys = jax.vmap(jax.random.key)
        if self.trials is None:
            return self.hyper, keys(jnp.arange(self.config.seed, self.config.seed + self.config.seeds)), (None, 0)
        return self.trials.hyper, keys(self.trials.seed), (0 if jnp.ndim(self.trials.hyper.clip) else None, 0)


def limit_less_margin(hyper: Hyper, margin: jax.Array | float) -> jax.Array:
    """The limits [] or [K] of an episode's costs less a margin, a share of them; traced."""
    return jnp.asarray(hyper.cost_limit) * (1 - margin)


def make_setup(
    config: Config,
    env: tasks.Env | None = None,
    *,
    trials: Trials | None = None,
    mesh: jax.sharding.Mesh | None = None,
    workers: int = 1,
    debug: bool = False,
) -> Setup:
    """Builds the task and the networks of a run.

    Args:
      env: an environment of your own, in place of `config.task`.
      trials, mesh, workers, debug: as in `Setup`.

    Raises:
      UsageError: a `config` that is no Config, unknown task or task option, an engine that cannot run here, an `env`
        that breaks the contract, `debug` on several devices, or a setting of JAX that no program runs with.
    """
    if debug and mesh:
        raise UsageError("--debug runs on one device in one process; leave out --devices")
    if found := numerics.obstacle():
        raise UsageError(found)
    if not isinstance(config, Config):
        raise UsageError(f"settings must be a Config, as load_config('lane') returns, not {config!r}")
    if isinstance(env, str):
        raise UsageError(f"env must be an environment, as envs.make('{env}') returns, not the name '{env}'")
    method = find(config.method)
    if env is not None:
        tasks.check(env)
    else:
        env = tasks.make(config.task, config.physics, **dict(config.env))
    count, given = env.spec.num_costs, np.size(config.cost_limit)
    if given not in (1, count):
        wanted = "one number" if count == 1 else f"one number, or {count}"
        raise UsageError(
            f"cost_limit has {given} numbers, but task '{env.spec.name}' has {count} cost(s); give {wanted}"
        )
    if method.letter and config.recurrent != "none":
        raise UsageError(
            f"{label(config.method)} has the paper's networks, which remember nothing; leave out recurrent"
        )
    if method.letter and config.gamma == 1:
        raise UsageError(
            f"{label(config.method)} judges costs by 1 - gamma times their value, which is 0 at gamma = 1; take less"
        )
    if method.constraint == "lagrangian" and not method.letter and config.lambda_max and not config.lambda_init:
        raise UsageError(
            "a multiplier of 0 never moves, for it changes in proportion to itself; set lambda_init above 0"
        )
    nets = networks.build(config, env.spec, method)
    vector = tasks.VectorEnv(env, config.num_envs, limit_terminates=config.time_limit == "terminate")
    return Setup(config, method, vector, nets, trials, mesh, workers, debug)
