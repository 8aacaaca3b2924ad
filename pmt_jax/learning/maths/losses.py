"""Losses: of policies (Eq. 10), of values (Eq. 12), and of the emotions' prior networks (Eq. 4 and 14)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax

SMOOTHING = 0.01
FOCOPS_TEMPERATURE = 1.5  # the paper's, for all tasks


def hybrid_advantage(advantage: jax.Array, cost_advantage: jax.Array, multiplier: jax.Array) -> jax.Array:
    """Reward advantage less the weighted cost advantages: A - sum_k lambda_k A_c,k.

    Args:
      advantage: [..., N]; cost_advantage: [..., N, K]; multiplier: [N, K].

    Returns:
      [..., N].
    """
    return advantage - jnp.sum(multiplier * cost_advantage, axis=-1)


def clipped_surrogate(
    log_ratio: jax.Array, log_weight: jax.Array, advantage: jax.Array, factor: jax.Array, clip: jax.Array | float
) -> jax.Array:
    """PPO's pessimistic objective per row, to be maximised: M min(rho A, clip(rho, 1 - eps, 1 + eps) A) (Eq. 10).

    Args:
      log_ratio: [...] log pi(a|o) - log pi_old(a|o), summed over action entries.
      log_weight: [...] bias on the ratio (0 for all methods without regret): rho = exp(log_ratio + log_weight).
      advantage: [...] the hybrid advantage; factor: [...] M, the ratios of the agents updated before this one.
      clip: eps.

    Returns:
      [...]; its mean over rows is the objective.
    """
    ratio = jnp.exp(log_ratio + log_weight)
    return factor * jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage)


def clipped_penalty(
    log_ratio: jax.Array,
    log_weight: jax.Array,
    cost_advantage: jax.Array,
    factor: jax.Array,
    excess: jax.Array,
    clip: jax.Array | float,
) -> jax.Array:
    """P3O's exact penalty: sum_k max(0, mean(M max(rho A_c, clip(rho, 1 - eps, 1 + eps) A_c)) + S), [].

    The surrogate of a cost is clipped towards the worse, as the reward's is, and counts only where it is beyond the
    limit (Zhang et al., 2022, section 4; Theorem 1: exact once its weight is at least the optimal multiplier).

    Args:
      log_ratio, log_weight, factor: [...], see `clipped_surrogate`; clip: eps.
      cost_advantage: [..., K], centred; excess: [K], S; both in one unit, like a standard deviation.
    """
    ratio = jnp.exp(log_ratio + log_weight)[..., None]
    each = jnp.maximum(ratio * cost_advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * cost_advantage)
    return jnp.maximum((factor[..., None] * each).mean(tuple(range(factor.ndim))) + excess, 0.0).sum()


def first_order_surrogate(
    log_ratio: jax.Array,
    log_weight: jax.Array,
    advantage: jax.Array,
    factor: jax.Array,
    kl: jax.Array,
    kl_limit: jax.Array | float,
) -> jax.Array:
    """FOCOPS's objective per row, to be maximised: M rho A / tau - KL(pi || pi_old) where that is within the bound.

    Its gradient is that of the divergence from the best policy of a trust region without parameters, which is
    pi_old exp(A / tau) / Z (Zhang et al., 2020, Theorem 1 and Corollary 1, with tau their lambda). Rows whose policy
    has already moved by more than `kl_limit` have no gradient (the indicator of their Algorithm 1).

    Args:
      log_ratio, log_weight, factor: [R], see `clipped_surrogate`; advantage: [R], A = A_r - sum_k nu_k A_c,k.
      kl: [R], KL(pi || pi_old) in nats; kl_limit: their delta, in nats.
    """
    gain = factor * jnp.exp(log_ratio + log_weight) * advantage / FOCOPS_TEMPERATURE
    return jnp.where(kl <= kl_limit, gain - kl, 0.0)


def huber(error: jax.Array, delta: float = 10.0) -> jax.Array:
    """Quadratic e^2/2 up to `delta` on both sides, linear delta (|e| - delta/2) beyond."""
    return optax.losses.huber_loss(error, delta=delta)


def value_loss(
    value: jax.Array,
    old_value: jax.Array,
    target: jax.Array,
    clip: jax.Array | float,
    penalty: Callable[[jax.Array], jax.Array] = huber,
) -> jax.Array:
    """The worse of the losses of the prediction and of its clipped move (Eq. 12).

    Args:
      value, old_value, target: [...] in normalised units; clip: how far a value may profit from moving.
      penalty: of an error; the paper squares it.

    Returns:
      [...]; its mean is the loss.
    """
    clipped = old_value + jnp.clip(value - old_value, -clip, clip)
    return jnp.maximum(penalty(target - value), penalty(target - clipped))


def cross_entropy(logits: jax.Array, target: jax.Array) -> jax.Array:
    """-p log sigmoid(l) - (1 - p) log(1 - sigmoid(l)), elementwise: the logits [...], and p [...] in [0, 1].

    It is KL(p || sigmoid(l)) but for a term that no weight moves, and its minimiser is p itself.
    """
    return jax.nn.softplus(logits) - target * logits


def bernoulli_kl(p: jax.Array, q: jax.Array) -> jax.Array:
    """KL(Bernoulli(p) || Bernoulli(q)) in nats, elementwise; both are kept off 0 and 1 by 1e-6."""
    p, q = jnp.clip(p, 1e-6, 1 - 1e-6), jnp.clip(q, 1e-6, 1 - 1e-6)
    return p * jnp.log(p / q) + (1 - p) * jnp.log((1 - p) / (1 - q))


def smoothed(target: jax.Array) -> jax.Array:
    """A probability [...] kept off 0 and 1 by 0.01, so that a divergence from it stays finite."""
    return target * (1 - 2 * SMOOTHING) + SMOOTHING


def appraisal_loss(
    distance: jax.Array, logits: jax.Array, old: jax.Array, weight: jax.Array, l2: jax.Array | float
) -> jax.Array:
    """Mean over weighted entries: distance from the target plus `l2` times the squared change since collection.

    This is Eq. 4 for fear and Eq. 14 for regret.

    Fear's target is the observed cost, regret's is how deliberate a costly action was; nothing else differs.

    Args:
      distance: [...] of the logits from the target, `cross_entropy` or another divergence.
      logits: [...] of the appraisal now; old: [...] the appraisal remembered from collection, in [0, 1].
      weight: [...] 1 where the entry counts; with no weight at all the loss and its gradient are exactly 0.

    Returns:
      [] scalar.
    """
    each = distance + l2 * (jax.nn.sigmoid(logits) - old) ** 2
    return jnp.sum(weight * each) / jnp.maximum(jnp.sum(weight), 1.0)
