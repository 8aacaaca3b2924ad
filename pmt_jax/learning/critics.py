"""The critics of reward and of cost: their values, and their fit to the returns (Eq. 12)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from .maths import running_moments
from .maths.losses import huber, value_loss
from .optimise import Loss, fit
from .rollout import flatten_steps
from .schedules import Schedule
from .setup import Setup
from .types import Batch, Critic, Hyper, Metrics, Params

# Eq. 12's clip lets a value move by little more than `clip` an update, too slowly for rare costs. Without it teams had
# a third to two fifths less cost while they learned, and no other difference was found (docs/results/limits.md).
UNCLIPPED = jnp.inf

ValueFn = Callable[[Params, jax.Array], jax.Array]


def inputs(batch: Batch) -> tuple[jax.Array, jax.Array]:
    """What critics see and see next: states [T, B, S], or each agent's own observations [T, B, N, O] (IPPO)."""
    return (batch.state, batch.next_state) if batch.next_obs is None else (batch.obs, batch.next_obs)


def values(critic: Critic, value_fn: ValueFn, seen: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    """Values of what critics see and of what they see next [T, B, ...] (see `inputs`), in the signal's unit."""
    both = value_fn(critic.net.params, jnp.stack(seen))
    value, next_value = running_moments.denormalise(critic.returns, both)
    return value, next_value


def fit_critic(
    setup: Setup,
    hyper: Hyper,
    now: Schedule,
    critic: Critic,
    value_fn: ValueFn,
    clip: jax.Array | float,
    samples: tuple[jax.Array, jax.Array, jax.Array],
    key: jax.Array,
) -> tuple[Critic, Metrics]:
    """Updates the moments of the returns once, then fits the critic to them in the new units.

    With the letter, as in the paper, there are no moments, and errors are squared.

    Args:
      clip: half-width of the interval of values, in those units.
      samples: what the critic sees, states [T, B, S] or observations [T, B, N, O]; values when they were collected and
        returns, both [T, B, ...] in the signal's unit.
    """
    state, old_value, returns = samples
    letter, moments = setup.method.letter, critic.returns
    if not letter:
        moments = running_moments.update_ema(moments, returns, running_moments.RETURNS_DECAY)
    normalised = (state, running_moments.normalise(moments, old_value), running_moments.normalise(moments, returns))

    passes = {"epochs": setup.config.epochs, "minibatches": setup.config.minibatches}
    limits = {"learning_rate": now.critic_lr, "max_grad_norm": hyper.max_grad_norm}
    loss = loss_of(value_fn, clip, jnp.square if letter else huber)
    net, metrics = fit(critic.net, loss, jax.tree.map(flatten_steps, normalised), key, **limits, **passes)
    unexplained = jnp.var(returns - old_value) / jnp.maximum(jnp.var(returns), 1e-8)
    return Critic(net, moments), {**metrics, "explained_variance": 1 - unexplained}


def loss_of(value_fn: ValueFn, clip: jax.Array | float, penalty: Callable[[jax.Array], jax.Array] = huber) -> Loss:
    """The mean of `value_loss` over rows of states, old values and targets, these in normalised units."""

    def loss(params: Params, minibatch: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, old, target = minibatch
        return value_loss(value_fn(params, state), old, target, clip, penalty).mean(), {}

    return loss
