"""The critics of reward and of cost: their values, and their fit to the returns (Eq. 12)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .maths import gru, running_moments
from .maths.losses import huber, value_loss
from .networks import Networks
from .optimise import Loss, fit
from .rollout import rows, sequences
from .schedules import Schedule
from .setup import Setup
from .types import (
    Batch,
    Critic,
    Hyper,
    LearnerState,
    Memory,
    Metrics,
    Params,
    Remembered,
    RolloutState,
    Sequences,
)

ValueFn = Callable[[Params, Any], jax.Array]  # of states or observations, see `types.Seen`


class Valued(NamedTuple):
    """What a critic sees, states [T, B, S] or observations [T, B, N, O], or sequences of them if it is recurrent; and
    the values of that and of what it sees next, [T, B, ...] in the signal's unit."""

    seen: jax.Array | Sequences
    value: jax.Array
    next_value: jax.Array


def appraise(
    setup: Setup, state: LearnerState, batch: Batch, memory: Memory | None
) -> tuple[Valued, Valued, RolloutState]:
    """The values of a batch by the critics of reward and of cost, which see states, or own observations (IPPO).

    Args:
      memory: before the batch; None of critics that are not recurrent.

    Returns:
      both, and the rollout's state with what these critics remember after the batch.
    """
    seen = (batch.state, batch.next_state) if batch.next_obs is None else (batch.obs, batch.next_obs)
    nets, rollout = setup.nets, state.rollout
    if memory is None or rollout.memory is None:
        valued = _values(state.critic, nets.value, seen)
        return valued, _values(state.cost_critic, nets.cost_value, seen), rollout
    valued, critic = _recalled(nets, state.critic, nets.value, seen, memory.critic, batch.done)
    cost_valued, cost = _recalled(nets, state.cost_critic, nets.cost_value, seen, memory.cost_critic, batch.done)
    after = dataclasses.replace(rollout.memory, critic=critic, cost_critic=cost)
    return valued, cost_valued, dataclasses.replace(rollout, memory=after)


def _values(critic: Critic, value_fn: ValueFn, seen: tuple[jax.Array, jax.Array]) -> Valued:
    both = value_fn(critic.net.params, jnp.stack(seen))
    value, next_value = running_moments.denormalise(critic.returns, both)
    return Valued(seen[0], value, next_value)


def _recalled(
    nets: Networks,
    critic: Critic,
    value_fn: ValueFn,
    seen: tuple[jax.Array, jax.Array],
    hidden: jax.Array,
    done: jax.Array,
) -> tuple[Valued, jax.Array]:
    """As `_values`, and the hidden state after the batch; the state before a reset is of the episode that ends there.

    Args:
      hidden: [B, ..., H] before the batch; done: [T, B].
    """
    now, params = sequences(seen[0], hidden, done), critic.net.params
    states = nets.remember(params, now)
    ahead = nets.advance(params, seen[1].swapaxes(0, 1), states)
    both = value_fn(params, Remembered(jnp.stack((states, ahead)).swapaxes(1, 2)))
    value, next_value = running_moments.denormalise(critic.returns, both)
    return Valued(now, value, next_value), gru.reset(states[:, -1], now.done[:, -1])


def fit_critic(
    setup: Setup,
    hyper: Hyper,
    now: Schedule,
    critic: Critic,
    value_fn: ValueFn,
    clip: jax.Array | float,
    samples: tuple[jax.Array | Sequences, jax.Array, jax.Array],
    key: jax.Array,
) -> tuple[Critic, Metrics]:
    """Updates the moments of the returns once, then fits the critic to them in the new units.

    With the letter, as in the paper, there are no moments, and errors are squared.

    Args:
      clip: half-width of the interval of values, in those units.
      samples: what the critic sees, states [T, B, S] or observations [T, B, N, O], or sequences of them; values when
        they were collected and returns, both [T, B, ...] in the signal's unit.
    """
    state, old_value, returns = samples
    letter, moments = setup.method.letter, critic.returns
    if not letter:
        moments = running_moments.update_ema(moments, returns, running_moments.RETURNS_DECAY)
    normalised = (state, running_moments.normalise(moments, old_value), running_moments.normalise(moments, returns))

    passes = {"epochs": setup.config.epochs, "minibatches": setup.config.minibatches}
    limits = {"learning_rate": now.critic_lr, "max_grad_norm": hyper.max_grad_norm}
    loss = loss_of(value_fn, clip, jnp.square if letter else huber)
    net, metrics = fit(critic.net, loss, rows(normalised), key, **limits, **passes)
    unexplained = jnp.var(returns - old_value) / jnp.maximum(jnp.var(returns), 1e-8)
    return Critic(net, moments), {**metrics, "explained_variance": 1 - unexplained}


def clip_of_costs(setup: Setup, hyper: Hyper) -> jax.Array:
    """How far a cost value may profit from moving, in normalised units: at will, but with the letter.

    The paper's clip lets a value move by little more than itself in an update, too slowly for rare costs. Without it
    teams had a third to two fifths less cost while they learned, and no other difference was found
    (docs/results/limits.md).
    """
    return jnp.asarray(hyper.clip if setup.method.letter else jnp.inf)


def loss_of(value_fn: ValueFn, clip: jax.Array | float, penalty: Callable[[jax.Array], jax.Array] = huber) -> Loss:
    """The mean of `value_loss` over rows of states, old values and targets, these in normalised units."""

    def loss(params: Params, minibatch: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, old, target = minibatch
        return value_loss(value_fn(params, state), old, target, clip, penalty).mean(), {}

    return loss
