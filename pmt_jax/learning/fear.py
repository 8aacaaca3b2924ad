"""Fear: how likely a state is to be costly, learned by a prior network (Eq. 3 and 4), in place of the cost signal."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp

from .maths.losses import appraisal_loss, bernoulli_kl, cross_entropy, smoothed
from .optimise import fit
from .rollout import flatten_steps
from .schedules import Schedule
from .setup import Setup
from .types import Batch, Hyper, Metrics, Params, TrainState

BINS = 10

FearLoss = Literal["ce", "gumbel_fwd", "gumbel_rev"]


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
        return None, signal(batch) if callable(signal) else batch.cost, {}
    seen = batch.next_state if setup.config.fear_time == "next" else batch.state
    share = batch.cost / jnp.where(largest > 0, largest, 1.0)
    net = dataclasses.replace(net, params=setup.nets.set_fear_to_cost_rate(net.params, share.mean((0, 1))))
    remembered = jax.nn.sigmoid(setup.nets.fear(net.params, seen))
    samples = jax.tree.map(flatten_steps, (seen, share, remembered))
    noise = jax.random.logistic(jax.random.fold_in(key, 2), samples[1].shape)

    def loss(params: Params, samples: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, cost, old, noise = samples
        logits = setup.nets.fear(params, state)
        distance = divergence(logits, cost, setup.config.fear_loss, noise, hyper.temperature)
        return appraisal_loss(distance, logits, old, jnp.ones_like(cost), hyper.fear_l2), {}

    passes = {"epochs": setup.config.emotion_epochs, "minibatches": setup.config.minibatches}
    limits = {"learning_rate": now.fear_lr, "max_grad_norm": hyper.max_grad_norm}
    net, metrics = fit(net, loss, (*samples, noise), key, **limits, **passes)
    fear = jax.nn.sigmoid(setup.nets.fear(net.params, seen))
    return net, largest * fear, {**metrics, **calibration(remembered, share)}


def divergence(
    logits: jax.Array, target: jax.Array, loss: FearLoss, noise: jax.Array, temperature: jax.Array | float
) -> jax.Array:
    """How far an appraisal is from what was observed, elementwise (Eq. 3, without its term that no weight moves).

    `ce` is the forward divergence without sampling: its minimiser is the probability itself. `gumbel_fwd` is the same
    of a relaxed sample. `gumbel_rev` is the letter of the paper, with the sample in front: it is nearly linear in the
    probability, so its minimiser is the more likely of 0 and 1, and a cost rarer than one half is not feared at all.

    Args:
      logits: [...]; target: [...] in [0, 1], smoothed by 0.01 for the sampled divergences.
      noise: [...] logistic, for the sampled divergences; temperature: tau.
    """
    if loss == "ce":
        return cross_entropy(logits, target)
    sample, target = relaxed_bernoulli(logits, noise, temperature), smoothed(target)
    return bernoulli_kl(target, sample) if loss == "gumbel_fwd" else bernoulli_kl(sample, target)


def relaxed_bernoulli(logits: jax.Array, noise: jax.Array, temperature: jax.Array | float) -> jax.Array:
    """The two-class Gumbel-softmax sigmoid((l + noise) / tau) in (0, 1), through which gradients flow.

    `noise` [...] is a draw of the standard logistic distribution, which is the difference of two Gumbels.
    """
    return jax.nn.sigmoid((logits + noise) / temperature)


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
