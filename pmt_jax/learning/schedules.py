"""What falls during a run: learning rates, bounds on a policy's step, and the noise of actions."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..config.settings import Config
from .maths.pytree import pytree
from .types import Hyper


@pytree
class Schedule:
    """The values of one update, scalars; all else is in `Hyper`, which stays what the user set.

    Attributes:
      actor_lr, critic_lr: learning rates; emotion_lr, fear_lr: those of regret and of fear.
      kl_max: bound on how far clipped epochs move a policy, in nats; kl_limit: the trust region, in nats.
      limit_windup: how far a limit may be lowered, in multiples of a step's reach.
      std_factor: what an update multiplies the policies' standard deviations by.
    """

    actor_lr: jax.Array
    critic_lr: jax.Array
    emotion_lr: jax.Array
    fear_lr: jax.Array
    kl_max: jax.Array
    kl_limit: jax.Array
    limit_windup: jax.Array
    std_factor: jax.Array


def at(config: Config, hyper: Hyper, update: jax.Array) -> Schedule:
    """The schedules' values in an update, counted from 0.

    Half-lives are traced, and optax's schedules branch on their parameters; hence `exp2`.
    """
    # Steps are counted in f32: as int32 they overflow after 2.1e9 steps of a seed.
    steps = update.astype(jnp.float32) * config.batch_size

    def left(half_life: jax.Array | float, start: jax.Array | float = 0) -> jax.Array:
        return jnp.exp2(-(jnp.maximum(steps - start, 0) / half_life))

    rate = left(hyper.lr_half_life)
    shorter = left(hyper.actor_lr_half_life, hyper.std_decay_start)
    kl_left = jnp.maximum(left(hyper.kl_half_life), 1e-30)  # no share of an infinite bound is 0 times it
    emotion_lr = hyper.emotion_lr * rate
    std_half_life = jnp.where(steps < hyper.std_decay_start, jnp.inf, hyper.std_half_life)
    return Schedule(
        actor_lr=hyper.actor_lr * rate * shorter,
        critic_lr=hyper.critic_lr * rate,
        emotion_lr=emotion_lr,
        # A network that knows nothing yet learns faster, so that fear does not lag where danger is dense at once.
        fear_lr=jnp.maximum(emotion_lr, hyper.fear_lr_start / (update + 1) * rate),
        kl_max=hyper.kl_max * kl_left,
        kl_limit=hyper.kl_limit * jnp.maximum(kl_left * shorter**2, 1e-30),
        # The reach of a step is the root of its bound, so this times the reach is at most that of a first step.
        limit_windup=jnp.minimum(hyper.limit_windup, 1 / jnp.sqrt(kl_left)),
        std_factor=jnp.exp2(-config.batch_size / std_half_life),
    )
