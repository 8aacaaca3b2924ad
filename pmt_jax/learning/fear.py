"""Fear: how likely a state is to be costly, learned by a prior network (Eq. 3 and 4), in place of the cost signal."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from .. import tasks
from ..errors import UsageError
from .maths.losses import appraisal_loss, cross_entropy
from .optimise import fit
from .rollout import flatten_steps
from .schedules import Schedule
from .setup import Setup
from .types import Batch, Hyper, Metrics, Params, TrainState

BINS = 10


def appraise_fear(
    setup: Setup,
    hyper: Hyper,
    now: Schedule,
    net: TrainState | None,
    batch: Batch,
    largest: jax.Array,
    key: jax.Array,
) -> tuple[TrainState | None, jax.Array, Metrics]:
    """Learns from the observed costs first, then computes the fear of every step: [T, B, N, K], an expected cost.

    The network's outputs are shares of the `largest` cost so far [N, K], which is 1 where a step costs 0 or 1. So what
    it learns does not depend on the unit of costs. Before the first cost there is no fear.

    Without a fear prior network the signal is the cost itself, or what the method makes of the batch. Calibration is
    that of the network before it has seen the batch.
    """
    if net is None:
        signal = setup.method.cost_signal
        return None, own_signal(signal, batch) if callable(signal) else batch.cost, {}
    seen = batch.next_state if setup.config.fear_time == "next" else batch.state
    share = batch.cost / jnp.where(largest > 0, largest, 1.0)
    net = dataclasses.replace(net, params=setup.nets.set_fear_to_cost_rate(net.params, share.mean((0, 1))))
    remembered = jax.nn.sigmoid(setup.nets.fear(net.params, seen))
    samples = jax.tree.map(flatten_steps, (seen, share, remembered))

    def loss(params: Params, samples: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, cost, old = samples
        logits = setup.nets.fear(params, state)
        distance = cross_entropy(logits, cost)  # Eq. 3 forward: its minimiser is the probability itself
        return appraisal_loss(distance, logits, old, jnp.ones_like(cost), hyper.emotion_l2), {}

    passes = {"epochs": setup.config.emotion_epochs, "minibatches": setup.config.minibatches}
    limits = {"learning_rate": now.fear_lr, "max_grad_norm": hyper.max_grad_norm}
    net, metrics = fit(net, loss, samples, key, **limits, **passes)
    fear = jax.nn.sigmoid(setup.nets.fear(net.params, seen))
    return net, largest * fear, {**metrics, **calibration(remembered, share)}


def own_signal(signal: Callable[[Batch], jax.Array], batch: Batch) -> jax.Array:
    """What a method's own function makes of a batch: [T, B, N, K].

    Raises:
      UsageError: it fails, or returns something else.
    """
    name = f"the method's cost_signal {getattr(signal, '__name__', '')}".strip()
    found = tasks.guard(f"{name} fails", lambda: jnp.asarray(signal(batch)))
    if found.shape != batch.cost.shape:
        raise UsageError(f"{name} must return an array [T, B, N, K], here {batch.cost.shape}, not {found.shape}")
    return found


def calibration(probability: jax.Array, outcome: jax.Array) -> Metrics:
    """How far predicted probabilities [...] can be trusted against outcomes [...] in [0, 1].

    brier: mean squared error. ece: expected calibration error, the mean over predictions of the distance between the
    mean prediction and the mean outcome in each of ten equal bins. on_costly, on_safe: mean prediction where the
    outcome was above 0 and where it was not (nan where there was none).
    """
    p, y = probability.ravel(), outcome.ravel()
    bins = jnp.clip((p * BINS).astype(int), 0, BINS - 1)
    gap = jnp.zeros(BINS).at[bins].add(p - y)
    costly = y > 0
    return {
        "brier": jnp.mean((p - y) ** 2),
        "ece": jnp.sum(jnp.abs(gap)) / p.size,
        "on_costly": jnp.sum(p * costly) / costly.sum(),
        "on_safe": jnp.sum(p * ~costly) / (~costly).sum(),
    }
