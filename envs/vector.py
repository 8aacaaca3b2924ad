"""Batch, time limit, auto-reset and quarantine: the one module that handles the ends of episodes."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from .base import Env, EnvSpec, State

ROUNDING = 1e-6  # of a cost: a mean of costs in 32 bits may be 1 + 1e-7


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class VectorState:
    """B environments, each at the moment before its next action.

    Attributes:
      env: State with a leading [B].
      elapsed: [B] int32, steps since the last reset.
      episode: [B] int32, resets so far; with `key` it names the randomness of the next one.
      key: [B] one key per environment, never used twice.
    """

    env: State
    elapsed: jax.Array
    episode: jax.Array
    key: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of one step, before any reset.

    Attributes:
      reward: [B]; cost: [B, N, K]; info: {name: [B]}.
      terminated: [B] bool, ended by the task's rule (or by broken physics): nothing lies beyond.
      truncated: [B] bool, cut by the time limit: bootstrap from the next state. Never both.
      next_obs, next_global_state: [B, N, O], [B, S] the true next observation and state.
      non_finite: [B] bool, the step was not finite and has been replaced (see `VectorEnv.step`).
      cost_out_of_range: [B] bool, a cost of the step is outside [0, 1]; it is kept as it is.
    """

    reward: jax.Array
    cost: jax.Array
    info: dict[str, jax.Array]
    terminated: jax.Array
    truncated: jax.Array
    next_obs: jax.Array
    next_global_state: jax.Array
    non_finite: jax.Array
    cost_out_of_range: jax.Array


class VectorEnv:
    """`num_envs` copies of an environment with a time limit and auto-reset.

    Args:
      env: the environment; num_envs: B.
      horizon: control steps of an episode; the task's own if None.
      limit_terminates: an episode that reaches the horizon counts as terminated, as it does in SafePO and others of its
        family, so that nothing bootstraps from what comes after.

    Examples:
      >>> import envs, jax
      >>> vector = VectorEnv(envs.make("lane"), num_envs=4)
      >>> state = vector.reset(jax.random.key(0))
      >>> state, outcome = vector.step(state, jax.numpy.zeros((4, 2, 2)))
      >>> outcome.reward.shape
      (4,)
    """

    def __init__(self, env: Env, num_envs: int, horizon: int | None = None, limit_terminates: bool = False) -> None:
        self.env = env
        self.num_envs = num_envs
        self.horizon = horizon or env.spec.horizon
        self._limit_terminates = limit_terminates
        self.resets_all = False  # in every step, whether any has ended or not

    @property
    def spec(self) -> EnvSpec:
        """The task's."""
        return self.env.spec

    def reset(self, key: jax.Array) -> VectorState:
        """Fresh episodes in all environments."""
        key = jax.random.split(key, self.num_envs)
        episode = jnp.zeros(self.num_envs, jnp.int32)
        env = jax.vmap(self.env.reset)(jax.vmap(jax.random.fold_in)(key, episode))
        return VectorState(env, jnp.zeros_like(episode), episode, key)

    def step(self, state: VectorState, action: jax.Array) -> tuple[VectorState, Outcome]:
        """Applies `action` [B, N, A]; environments that end are reset with a key they never used before.

        A step that leaves anything non-finite (or started from it) is quarantined: the episode terminates, its last
        step counts reward 0 and cost 1, the last finite observation replaces the next, and `non_finite` is set.
        `info` is only logged: what is not finite there stays as it is and changes nothing else.
        """
        before = state.env
        after = jax.vmap(self.env.step)(before, action)
        # The same as: not _finite of the state without `info`. So written, the programs of all tasks that were
        # compared keep their last bits, which depend on what XLA fuses.
        only_info = ~_finite(after.info) & _finite(dataclasses.replace(after, info={}))
        bad = ~(_finite(after) | only_info)
        terminated = after.terminated | bad
        elapsed = state.elapsed + 1
        truncated = (elapsed >= self.horizon) & ~terminated
        if self._limit_terminates:
            terminated, truncated = terminated | truncated, jnp.zeros_like(truncated)
        outcome = Outcome(
            reward=jnp.where(bad, 0, after.reward),
            cost=_where(bad, jnp.ones_like(after.cost), after.cost),
            info=_where(bad, before.info, after.info),
            terminated=terminated,
            truncated=truncated,
            next_obs=_where(bad, before.obs, after.obs),
            next_global_state=_where(bad, before.global_state, after.global_state),
            non_finite=bad,
            cost_out_of_range=out_of_range(after.cost).any((-2, -1)) & ~bad,
        )
        done = terminated | truncated
        episode = state.episode + done
        key = jax.vmap(jax.random.fold_in)(state.key, episode)
        env = restart(self.env, done, after, key, self.resets_all)
        return VectorState(env, jnp.where(done, 0, elapsed), episode, state.key), outcome


def restart(env: Env, done: jax.Array, state: State, key: jax.Array, resets_all: bool = False) -> State:
    """`state` with a leading [B], but where `done` [B] a fresh episode from `key` [B]; no bit depends on `resets_all`.

    A loop runs while anything that has ended is left. A condition would do the same for one seed, but a vmap over seeds
    takes both of its sides in every step, which costs a grid half of its steps on a GPU and two thirds on a CPU. There
    the loop takes some at a time, as few end at once. On a GPU more rows take hardly longer.
    """
    if resets_all:
        return _where(done, jax.vmap(env.reset)(key), state)
    batch = len(done)
    some = 8 * -(-batch // 128)  # whole vectors, or the bits would be those of a loop's remainder
    at_once = min(batch, some) if jax.default_backend() == "cpu" else batch

    def reset_some(left: tuple[jax.Array, State]) -> tuple[jax.Array, State]:
        done, state = left
        (index,) = jnp.nonzero(done, size=at_once, fill_value=batch)
        fresh = jax.vmap(env.reset)(key.at[index].get(mode="clip"))
        state = jax.tree.map(lambda old, new: old.at[index].set(new, mode="drop"), state, fresh)
        return done.at[index].set(False, mode="drop"), state

    return jax.lax.while_loop(lambda left: left[0].any(), reset_some, (done, state))[1]


def observed_cost(cost: jax.Array, key: jax.Array, cost_seen: jax.Array | float) -> jax.Array:
    """The cost that the learner observes: a step's cost with probability `cost_seen`, else 0.

    There is one draw an environment for the whole team. With 1 the result is `cost`, bit for bit.

    Args:
      cost: [B, N, K], the true cost of one step; key: of this step's draws.

    Returns:
      [B, N, K].
    """
    draw = jax.random.uniform(key, cost.shape[:1])
    return _where(draw >= cost_seen, jnp.zeros_like(cost), cost)


def out_of_range(cost: jax.Array) -> jax.Array:
    """Of costs [...] whether each is outside [0, 1] by more than rounding; [...] bool."""
    return (cost < -ROUNDING) | (cost > 1 + ROUNDING)


def _finite(tree: Any) -> jax.Array:
    """[B] bool (or [], of no numbers): every floating number of a tree with a leading [B] is finite."""
    checks = [
        jnp.isfinite(x).reshape(x.shape[0], -1).all(axis=1)
        for x in jax.tree.leaves(tree)
        if jnp.issubdtype(x.dtype, jnp.floating)
    ]
    return jnp.stack(checks).all(axis=0) if checks else jnp.asarray(True)


def _where(mask: jax.Array, chosen: Any, otherwise: Any) -> Any:
    """Per environment, `chosen` where `mask` [B], else `otherwise`; for any pytree with leading [B]."""

    def select(x: jax.Array, y: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim)), x, y)

    return jax.tree.map(select, chosen, otherwise)
