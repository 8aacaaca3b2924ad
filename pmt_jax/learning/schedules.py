"""What falls during a run: learning rates, and the trust region."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ..config.settings import Config
from .maths.pytree import pytree
from .types import Hyper

# Learning rate of fear in the first update, or ten times emotion_lr if that is less. In update t it is this over t,
# while above emotion_lr.
FEAR_LR_START = 1e-2


@pytree
class Schedule:
    """The values of one update, scalars; all else is in `Hyper`, which stays what the user set.

    Attributes:
      actor_lr, critic_lr: learning rates; emotion_lr, fear_lr: those of regret and of fear.
      kl_limit: the trust region, in nats.
    """

    actor_lr: jax.Array
    critic_lr: jax.Array
    emotion_lr: jax.Array
    fear_lr: jax.Array
    kl_limit: jax.Array


def at(config: Config, hyper: Hyper, update: jax.Array) -> Schedule:
    """The schedules' values in an update, counted from 0: learning rates fall exponentially to `lr_end` of themselves.

    A step's divergence is the square of its length, so the trust region falls by the square.
    """
    left = hyper.lr_end ** (update.astype(jnp.float32) / config.num_updates)
    emotion_lr = hyper.emotion_lr * left
    return Schedule(
        actor_lr=hyper.actor_lr * left,
        critic_lr=hyper.critic_lr * left,
        emotion_lr=emotion_lr,
        # A network that knows nothing yet learns faster, so that fear does not lag where danger is dense at once.
        fear_lr=jnp.maximum(emotion_lr, jnp.minimum(FEAR_LR_START, 10 * hyper.emotion_lr) / (update + 1) * left),
        kl_limit=hyper.kl_limit * left**2,
    )
