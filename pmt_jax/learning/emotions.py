"""Threat appraisal: how likely a state is to be costly (fear), and how much an action is to be regretted."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp

from ..config.settings import Hyper
from .optimise import fit
from .rollout import flatten_steps
from .setup import Setup
from .types import Batch, Metrics, Params, TrainState

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
    """Mean over weighted entries: distance from the target plus `l2` times the squared change since collection.

    This is Eq. 4 for fear and Eq. 14 for regret.

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
    """How much the policy meant an action entry, `z` [...] standard deviations from its mean: the target of regret.

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


def regret_weight(
    new: jax.Array,
    old: jax.Array,
    mask: jax.Array,
    *,
    choose: Literal["top", "threshold", "none"],
    omega: jax.Array | float,
    regret_max: jax.Array | float,
    bound: jax.Array | float,
) -> jax.Array:
    """The logarithm of the weight that regret puts on the probability ratio: log prod (1 - r) / (1 - r_old) (Eq. 15).

    Below 0 where regret has risen since the action was taken; exactly 0 where there is none, or it has not changed.

    Args:
      new, old: [..., A] regret now and when the action was taken; mask: [..., A] 1 for real action entries.
      choose: which entries count, by the regret now and for both alike: the `top` ceil(omega A) of them (ties all
        count), those at or above the `threshold` omega, or all.
      regret_max: regret is cut here, so that a single entry moves the ratio at most tenfold at 0.9.
      bound: the weight stays within [1 - bound, 1 + bound], so that it alone never leaves the clip interval, which
        would kill the row's gradient; inf for none.

    Returns:
      [...]; a constant of the policy's weights.
    """
    new, old = jnp.minimum(new, regret_max) * mask, jnp.minimum(old, regret_max) * mask
    if choose == "top":
        above = jnp.sum((new[..., None, :] > new[..., :, None]) * mask[..., None, :], axis=-1)
        chosen = above < jnp.ceil(omega * mask.sum(-1, keepdims=True))
    else:
        chosen = (new >= omega) | (choose == "none")
    log_weight = jnp.sum(chosen * (jnp.log1p(-new) - jnp.log1p(-old)), axis=-1)
    return jnp.clip(log_weight, jnp.log(jnp.maximum(1 - bound, 0.0)), jnp.log1p(bound))


def appraise_fear(
    setup: Setup, hyper: Hyper, net: TrainState | None, batch: Batch, key: jax.Array
) -> tuple[TrainState | None, jax.Array, Metrics]:
    """Learns from the observed costs first, then computes the fear of every step: [T, B, N, K] in (0, 1).

    Without a fear prior network the signal is the cost itself, or what the method makes of the batch. Calibration is
    that of the network before it has seen the batch.
    """
    if net is None:
        signal = setup.method.cost_signal
        return None, signal(batch) if callable(signal) else batch.cost, {}
    seen = batch.next_state if setup.config.fear_time == "next" else batch.state
    net = dataclasses.replace(net, params=setup.nets.awaken_fear(net.params, batch.cost.mean((0, 1))))
    remembered = jax.nn.sigmoid(setup.nets.fear(net.params, seen))
    rows = jax.tree.map(flatten_steps, (seen, batch.cost, remembered))
    if setup.config.fear_history == "random":
        rows = (*rows[:2], rows[2][jax.random.permutation(jax.random.fold_in(key, 1), rows[2].shape[0])])
    noise = jax.random.logistic(jax.random.fold_in(key, 2), rows[1].shape)

    def loss(params: Params, rows: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, cost, old, noise = rows
        logits = setup.nets.fear(params, state)
        distance = divergence(logits, cost, setup.config.fear_loss, noise, hyper.temperature)
        return appraisal_loss(distance, logits, old, jnp.ones_like(cost), hyper.fear_l2), {}

    # A network that knows nothing yet learns faster, so that fear does not lag where danger is dense from the start.
    hyper = dataclasses.replace(hyper, emotion_lr=jnp.maximum(hyper.emotion_lr, hyper.fear_lr_start))
    net, metrics = fit(net, loss, (*rows, noise), key, **_fit_options(setup, hyper))
    fear = jax.nn.sigmoid(setup.nets.fear(net.params, seen))
    return net, fear, {**metrics, **calibration(remembered, batch.cost)}


def appraise_regret(
    setup: Setup, hyper: Hyper, net: TrainState | None, batch: Batch, key: jax.Array
) -> tuple[TrainState | None, jax.Array, Metrics]:
    """Learns how deliberate the costly actions were, then weighs every step's ratio by how regret has changed.

    Returns:
      the networks of all agents, log w [T, B, N] (0 without regret), and metrics: mean regret per action entry on
      costly steps, what it would be on safe ones were they costly, and the weight w over all rows.
    """
    if net is None:
        return None, jnp.zeros_like(batch.log_prob), {}
    mask = jnp.asarray(setup.vector.spec.action_mask)
    state = jnp.broadcast_to(batch.state[:, :, None], (*batch.log_prob.shape, batch.state.shape[-1]))
    logits = jax.vmap(setup.nets.regret, (0, 2, 2), 2)
    before = logits(net.params, state, batch.action)
    target = deliberateness((batch.action - batch.mean) / batch.std, setup.config.regret_target)
    target = target * (1 - 2 * SMOOTHING) + SMOOTHING
    costly = (batch.cost.max(-1, keepdims=True) > 0) * mask
    rows = (state, batch.action, target, jax.nn.sigmoid(before), costly)
    rows = jax.tree.map(lambda x: jnp.moveaxis(flatten_steps(x), 1, 0), rows)

    def loss(params: Params, rows: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, action, target, old, weight = rows
        logits = setup.nets.regret(params, state, action)
        distance = divergence(logits, target, "ce", jnp.zeros_like(logits), 1.0)
        return appraisal_loss(distance, logits, old, weight, hyper.regret_l2), {}

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(setup.nets.num_agents))
    learned, metrics = jax.vmap(lambda *each: fit(each[0], loss, each[1], each[2], **_fit_options(setup, hyper)))(
        net, rows, keys
    )
    # Adam's momentum would move a network that had nothing to learn from.
    learned = jax.tree.map(lambda new, old: jnp.where(costly.any(), new, old), learned, net)
    after = logits(learned.params, state, batch.action)
    new, old = regret(after, batch.cost), regret(before, batch.cost)
    bound = hyper.kappa * hyper.clip
    if setup.config.regret_response != "letter":  # the other responses answer to regret itself, not to its change
        old = jnp.zeros_like(new)
    if setup.config.regret_response == "advantage":  # no ratio is touched, so there is no clip interval to leave
        bound = hyper.regret_max
    log_weight = regret_weight(
        new,
        old,
        mask,
        choose=setup.config.regret_mask,
        omega=hyper.omega,
        regret_max=hyper.regret_max,
        bound=bound,
    )
    weight = jnp.exp(log_weight)
    diagnostics = {
        "on_costly": (new * mask).sum() / costly.sum(),
        "on_safe": (jax.nn.sigmoid(after) * (mask - costly)).sum() / (mask - costly).sum(),
        "weight_mean": weight.mean(),
        "weight_std": weight.std(),
    }
    return learned, log_weight, {**{k: x.mean(0) for k, x in metrics.items()}, **diagnostics}


def _fit_options(setup: Setup, hyper: Hyper) -> dict[str, Any]:
    return {
        "learning_rate": hyper.emotion_lr,
        "max_grad_norm": hyper.max_grad_norm,
        "epochs": setup.config.emotion_epochs,
        "minibatches": setup.config.minibatches,
    }
