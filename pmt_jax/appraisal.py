"""Threat appraisal: how likely a state is to be costly (fear), and how much an action is to be regretted."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp

from .types import Metrics

SMOOTHING = 0.01
BINS = 10

FearLoss = Literal["ce", "gumbel_fwd", "gumbel_rev"]


def bernoulli_kl(p: jax.Array, q: jax.Array) -> jax.Array:
    """KL(Bernoulli(p) || Bernoulli(q)) in nats, elementwise; both are kept off 0 and 1 by 1e-6."""
    p, q = jnp.clip(p, 1e-6, 1 - 1e-6), jnp.clip(q, 1e-6, 1 - 1e-6)
    return p * jnp.log(p / q) + (1 - p) * jnp.log((1 - p) / (1 - q))


def relaxed_bernoulli(logits: jax.Array, noise: jax.Array, temperature: jax.Array | float) -> jax.Array:
    """The two-class Gumbel-softmax sigmoid((l + noise) / tau) in (0, 1), through which gradients flow.

    `noise` [...] is a draw of the standard logistic distribution, which is the difference of two Gumbels.
    """
    return jax.nn.sigmoid((logits + noise) / temperature)


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
        return jax.nn.softplus(logits) - target * logits
    sample = relaxed_bernoulli(logits, noise, temperature)
    target = target * (1 - 2 * SMOOTHING) + SMOOTHING
    return bernoulli_kl(target, sample) if loss == "gumbel_fwd" else bernoulli_kl(sample, target)


def appraisal_loss(
    distance: jax.Array, logits: jax.Array, old: jax.Array, weight: jax.Array, l2: jax.Array | float
) -> jax.Array:
    """Mean over weighted entries of the distance from the target plus `l2` times the change of mind (Eq. 4, 14).

    Fear's target is the observed cost, regret's is how deliberate a costly action was; nothing else differs.

    Args:
      distance: [...] `divergence` of the logits from the target.
      logits: [...] of the appraisal now; old: [...] the appraisal remembered from collection, in [0, 1].
      weight: [...] 1 where the entry counts; with no weight at all the loss and its gradient are exactly 0.

    Returns:
      [] scalar.
    """
    each = distance + l2 * (jax.nn.sigmoid(logits) - old) ** 2
    return jnp.sum(weight * each) / jnp.maximum(jnp.sum(weight), 1.0)


def regret(logits: jax.Array, cost: jax.Array) -> jax.Array:
    """Regret per action entry, felt only where the step was costly: sigmoid(l) 1[C > 0] (Eq. 13).

    Args:
      logits: [..., A]; cost: [..., K] in [0, 1]; with several costs any of them will do.
    """
    return jax.nn.sigmoid(logits) * (cost.max(-1, keepdims=True) > 0)


def deliberateness(z: jax.Array, target: Literal["mode", "tail"]) -> jax.Array:
    """How much the policy meant an action entry `z` [...] deviations from its mean: what regret learns to predict.

    `mode`: density relative to the mode, exp(-z^2 / 2). `tail`: the probability of something even further out. A
    costly action that was meant is regretted, an accident of exploration is not.
    """
    return jnp.exp(-0.5 * z**2) if target == "mode" else 2 * jax.scipy.stats.norm.sf(jnp.abs(z))


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
