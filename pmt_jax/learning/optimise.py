"""The one epochs-and-minibatches scan that every network is trained with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

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


def _as_vector(net: TrainState, loss: Loss) -> tuple[TrainState, Loss, Callable[[TrainState], TrainState]]:
    """A network whose layers' weights are one vector, as are Adam's moments; its loss; what makes a tree of it again.

    The standard deviation stays apart: XLA would sum its gradient over the rows anew for every number of the vector.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(net.params)
    is_std = [path[-1].key == "std" for path, _ in leaves]
    _, unravel = ravel_pytree([leaf for (_, leaf), std in zip(leaves, is_std, strict=True) if not std])

    def vector_of(tree: Params) -> Params:
        each = list(zip(jax.tree.leaves(tree), is_std, strict=True))
        return ravel_pytree([leaf for leaf, std in each if not std])[0], [leaf for leaf, std in each if std]

    def tree_of(params: Params) -> Params:
        weights, stds = iter(unravel(params[0])), iter(params[1])
        return jax.tree.unflatten(structure, [next(stds if std else weights) for std in is_std])

    def mapped(net: TrainState, change: Callable[[Params], Params]) -> TrainState:
        mu, nu = change(net.opt_state.mu), change(net.opt_state.nu)
        return TrainState(change(net.params), net.opt_state._replace(mu=mu, nu=nu))

    return mapped(net, vector_of), lambda params, rows: loss(tree_of(params), rows), lambda net: mapped(net, tree_of)


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
    net, loss, tree_of = _as_vector(net, loss) if fused.steps_vectors() else (net, loss, lambda net: net)
    shuffle = jax.vmap(lambda k: shuffled(k, count))(jax.random.split(key, epochs))

    def step(net: TrainState, index: jax.Array) -> tuple[TrainState, Metrics]:
        # Said in the scan: what is said before it does not reach all rows, and devices then exchange some at each step.
        minibatch = sharding.shard(jax.tree.map(lambda x: x[index], sharding.replicate(rows)))
        (value, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(net.params, minibatch)
        net, norm = descend(net, gradient, learning_rate, max_grad_norm)
        return net, {"loss": value, "grad_norm": norm, **metrics}

    net, metrics = jax.lax.scan(step, net, shuffle.reshape(epochs * minibatches, -1))
    net = tree_of(net)
    return net, jax.tree.map(lambda x: x[-minibatches:].mean(0), metrics)
