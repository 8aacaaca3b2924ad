"""The policy's distribution: a diagonal Gaussian whose padded action entries are masked out."""

from __future__ import annotations

import jax
import jax.numpy as jnp

STD_MAX = 0.5
LOG_TWO_PI = 1.8378770664093453


def std(parameter: jax.Array) -> jax.Array:
    """Standard deviation 0.5 sigmoid(l), in (0, 0.5); l = 1 gives 0.3655 (the references' parametrisation)."""
    return STD_MAX * jax.nn.sigmoid(parameter)


def log_prob(action: jax.Array, mean: jax.Array, std: jax.Array, mask: jax.Array) -> jax.Array:
    """Log-density of `action` [..., A] in nats, summed over unmasked entries: [...]."""
    z = (action - mean) / std
    return jnp.sum(mask * (-0.5 * z**2 - jnp.log(std) - 0.5 * LOG_TWO_PI), axis=-1)


def entropy(std: jax.Array, mask: jax.Array) -> jax.Array:
    """Differential entropy in nats, summed over unmasked entries: [...]."""
    return jnp.sum(mask * (0.5 + 0.5 * LOG_TWO_PI + jnp.log(std)), axis=-1)


def kl(mean0: jax.Array, std0: jax.Array, mean: jax.Array, std: jax.Array, mask: jax.Array) -> jax.Array:
    """KL(N(mean0, std0) || N(mean, std)) in nats, summed over unmasked entries: [...]."""
    each = jnp.log(std / std0) + (std0**2 + (mean0 - mean) ** 2) / (2 * std**2) - 0.5
    return jnp.sum(mask * each, axis=-1)
