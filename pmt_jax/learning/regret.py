"""Regret: how much a costly action was meant, learned by a prior network (Eq. 13 and 14), and the ratio's weight."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from .maths.losses import appraisal_loss, cross_entropy, smoothed
from .optimise import fit
from .rollout import flatten_steps
from .schedules import Schedule
from .setup import Setup
from .types import Batch, Hyper, Metrics, Params, TrainState

REGRET_MAX = 0.9  # regret is cut here, so that a single entry moves the ratio at most tenfold


def appraise_regret(
    setup: Setup, hyper: Hyper, now: Schedule, net: TrainState | None, batch: Batch, key: jax.Array
) -> tuple[TrainState | None, jax.Array, Metrics]:
    """Learns how deliberate the costly actions were, then weighs every step's ratio by how regret has changed.

    Returns:
      the networks of all agents, log w [T, B, N] (0 without regret), and metrics: mean regret per action entry on
      costly steps, what it would be on safe ones were they costly, and the weight w over all samples.
    """
    if net is None:
        return None, jnp.zeros_like(batch.log_prob), {}
    mask, before, costly, samples = samples_of_agents(setup, net, batch, smoothed)

    def loss(params: Params, samples: tuple[jax.Array, ...]) -> tuple[jax.Array, Metrics]:
        state, action, target, old, weight = samples
        logits = setup.nets.regret(params, state, action)
        return appraisal_loss(cross_entropy(logits, target), logits, old, weight, hyper.emotion_l2), {}

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(setup.nets.num_agents))
    passes = {"epochs": setup.config.emotion_epochs, "minibatches": setup.config.minibatches}
    limits = {"learning_rate": now.emotion_lr, "max_grad_norm": hyper.max_grad_norm}
    learned, metrics = jax.vmap(lambda *each: fit(each[0], loss, *each[1:], **limits, **passes))(net, samples, keys)
    learned = where_costly(costly, learned, net)
    after = logits_of_agents(setup, learned.params, batch)
    new, old = regret(after, batch.cost), regret(before, batch.cost)
    log_weight = regret_weight(new, old, mask, omega=hyper.omega, bound=hyper.kappa * hyper.clip)
    shown = diagnostics(after, new, mask, costly, jnp.exp(log_weight))
    return learned, log_weight, {**{k: x.mean(0) for k, x in metrics.items()}, **shown}


def where_costly(costly: jax.Array, learned: TrainState, net: TrainState) -> TrainState:
    """The networks that have `learned`, but those of agents without a costly entry [T, B, N, A] as they were.

    Adam's momentum would move a network that had nothing to learn from.
    """
    had = costly.any((0, 1, 3))
    return jax.tree.map(lambda new, old: jnp.where(had.reshape(-1, *[1] * (new.ndim - 1)), new, old), learned, net)


def samples_of_agents(
    setup: Setup, net: TrainState, batch: Batch, of_density: Callable[[jax.Array], jax.Array]
) -> tuple[jax.Array, jax.Array, jax.Array, tuple[jax.Array, ...]]:
    """What the agents' networks learn from.

    Args:
      of_density: what is made of `deliberateness` [T, B, N, A] for a target.

    Returns:
      which action entries are real [N, A]; logits before [T, B, N, A]; where an entry was costly [T, B, N, A], 0 or 1;
      and samples with leading [N, R]: states, actions, targets, regret before, and costly.
    """
    mask = jnp.asarray(setup.vector.spec.action_mask)
    before = logits_of_agents(setup, net.params, batch)
    target = of_density(deliberateness((batch.action - batch.mean) / batch.std))
    costly = (batch.cost.max(-1, keepdims=True) > 0) * mask
    samples = (_states(batch), batch.action, target, jax.nn.sigmoid(before), costly)
    return mask, before, costly, jax.tree.map(lambda x: jnp.moveaxis(flatten_steps(x), 1, 0), samples)


def logits_of_agents(setup: Setup, params: Params, batch: Batch) -> jax.Array:
    """Logits [T, B, N, A] of each agent's network, weights with a leading [N], of what it did."""
    return jax.vmap(setup.nets.regret, (0, 2, 2), 2)(params, _states(batch), batch.action)


def _states(batch: Batch) -> jax.Array:
    return jnp.broadcast_to(batch.state[:, :, None], (*batch.log_prob.shape, batch.state.shape[-1]))


def diagnostics(after: jax.Array, new: jax.Array, mask: jax.Array, costly: jax.Array, weight: jax.Array) -> Metrics:
    """What an update reports of regret, of logits `after` and regret `new` [T, B, N, A] and the weight on the ratio."""
    return {
        "on_costly": (new * mask).sum() / costly.sum(),
        "on_safe": (jax.nn.sigmoid(after) * (mask - costly)).sum() / (mask - costly).sum(),
        "weight_mean": weight.mean(),
        "weight_std": weight.std(),
    }


def regret(logits: jax.Array, cost: jax.Array) -> jax.Array:
    """Regret per action entry, where the step was costly: sigmoid(l) 1[C > 0] (Eq. 13).

    Args:
      logits: [..., A]; cost: [..., K] in [0, 1]; with several costs any of them will do.
    """
    return jax.nn.sigmoid(logits) * (cost.max(-1, keepdims=True) > 0)


def deliberateness(z: jax.Array) -> jax.Array:
    """How much the policy meant an action entry, `z` [...] standard deviations from its mean: the target of regret.

    It is the density relative to the mode, exp(-z^2 / 2). A costly action that was meant is regretted, an accident of
    exploration is not.
    """
    return jnp.exp(-0.5 * z**2)


def regret_weight(
    new: jax.Array,
    old: jax.Array,
    mask: jax.Array,
    *,
    omega: jax.Array | float,
    bound: jax.Array | float,
) -> jax.Array:
    """The logarithm of the weight that regret puts on the probability ratio: log prod (1 - r) / (1 - r_old) (Eq. 15).

    Below 0 where regret has risen since the action was taken; exactly 0 where there is none, or it has not changed.

    Args:
      new, old: [..., A] regret now and when the action was taken; mask: [..., A] 1 for real action entries.
      omega: the share of entries that count, by the regret now and for both alike: the ceil(omega A) with the most
        (ties all count).
      bound: the weight stays within [1 - bound, 1 + bound], so that it alone never leaves the clip interval, which
        would kill the row's gradient; inf for none.

    Returns:
      [...]; a constant of the policy's weights.
    """
    new, old = jnp.minimum(new, REGRET_MAX) * mask, jnp.minimum(old, REGRET_MAX) * mask
    chosen = most_regretted(new, mask, omega)
    log_weight = jnp.sum(chosen * (jnp.log1p(-new) - jnp.log1p(-old)), axis=-1)
    return jnp.clip(log_weight, jnp.log(jnp.maximum(1 - bound, 0.0)), jnp.log1p(bound))


def most_regretted(regret: jax.Array, mask: jax.Array, omega: jax.Array | float) -> jax.Array:
    """Which action entries count, [..., A] bool: the ceil(omega A) with the most regret (ties all count).

    Args:
      regret: [..., A], 0 where mask [..., A] is.
    """
    above = jnp.sum((regret[..., None, :] > regret[..., :, None]) * mask[..., None, :], axis=-1)
    return above < jnp.ceil(omega * mask.sum(-1, keepdims=True))
