"""The one epochs-and-minibatches scan that every network is trained with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from . import fused, sharding
from .types import Metrics, Params, TrainState

ADAM_EPS = 1e-5
_ADAM = optax.scale_by_adam(eps=ADAM_EPS)

Loss = Callable[[Params, Any], tuple[jax.Array, Metrics]]


def init_train_state(params: Params) -> TrainState:
    """`params` with a fresh optimiser."""
    return TrainState(params, _ADAM.init(params))


def shuffled(key: jax.Array, count: int) -> jax.Array:
    """The numbers 0 to `count` - 1 in random order, [count] uint32.

    They are the low bits of random words, and the words are sorted: one array of single words, which XLA sorts several
    times faster than the pairs of `jax.random.permutation`. Rows whose high bits agree keep their order. That decides
    nothing but the few rows at a minibatch's edge.
    """
    bits = max(1, (count - 1).bit_length())
    words = jax.random.bits(key, (count,), jnp.uint32) >> bits << bits
    return jnp.sort(words | jnp.arange(count, dtype=jnp.uint32)) & (2**bits - 1)


def descend(
    net: TrainState, gradient: Params, learning_rate: jax.Array | float, max_grad_norm: jax.Array | float
) -> tuple[TrainState, jax.Array]:
    """A step of Adam along `gradient`, scaled down to the norm `max_grad_norm`; also the norm that it had."""
    if fused.available() and fused.takes(net.params):
        params, opt_state, norm = fused.adam(net.params, net.opt_state, gradient, learning_rate, max_grad_norm)
        return TrainState(params, opt_state), norm
    norm = optax.tree.norm(gradient)
    shrink = jnp.minimum(1.0, max_grad_norm / jnp.maximum(norm, 1e-12))
    direction, opt_state = _ADAM.update(jax.tree.map(lambda g: g * shrink, gradient), net.opt_state)
    params = jax.tree.map(lambda p, d: p - learning_rate * d, net.params, direction)
    return TrainState(params, opt_state), norm


def fit(
    net: TrainState,
    loss: Loss,
    rows: Any,
    key: jax.Array,
    *,
    learning_rate: jax.Array | float,
    max_grad_norm: jax.Array | float,
    epochs: int,
    minibatches: int,
) -> tuple[TrainState, Metrics]:
    """Minimises `loss` by Adam over shuffled minibatches: `epochs` passes of `minibatches` steps each.

    Args:
      net: weights and optimiser state.
      loss: (params, minibatch) -> scalar and metrics; sees rows [R / minibatches, ...].
      rows: pytree of [R, ...], R divisible by `minibatches`.
      key: shuffles the rows anew in every epoch.

    Returns:
      The trained network, and the loss (`loss`) with its metrics, means over the last epoch.
    """
    count = jax.tree.leaves(rows)[0].shape[0]
    shuffle = jax.vmap(lambda k: shuffled(k, count))(jax.random.split(key, epochs))

    def step(net: TrainState, index: jax.Array) -> tuple[TrainState, Metrics]:
        # Said in the scan: what is said before it does not reach all rows, and devices then exchange some at each step.
        minibatch = sharding.shard(jax.tree.map(lambda x: x[index], sharding.replicate(rows)))
        (value, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(net.params, minibatch)
        net, norm = descend(net, gradient, learning_rate, max_grad_norm)
        return net, {"loss": value, "grad_norm": norm, **metrics}

    net, metrics = jax.lax.scan(step, net, shuffle.reshape(epochs * minibatches, -1))
    return net, jax.tree.map(lambda x: x[-minibatches:].mean(0), metrics)
