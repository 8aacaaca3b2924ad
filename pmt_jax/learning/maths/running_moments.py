"""Running moments: of observations (everything seen so far) and of returns (with forgetting)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from .pytree import pytree

MIN_WEIGHT = 1e-5
RETURNS_DECAY = 0.995  # share of the moments of returns that survives an update
MIN_RETURN_VARIANCE = 1e-2
MIN_OBS_VARIANCE = 1e-8
OBS_CLIP = 10.0


@pytree
class RunningMoments:
    """Running first and second moments; `weight` is how much has been seen (a count, or the debiasing term)."""

    mean: jax.Array
    second: jax.Array
    weight: jax.Array


def init(shape: tuple[int, ...]) -> RunningMoments:
    """Moments of nothing; they normalise as the identity until the first update (see `obs_scaling`)."""
    return RunningMoments(jnp.zeros(shape), jnp.zeros(shape), jnp.zeros(()))


def accumulate(moments: RunningMoments, x: jax.Array) -> RunningMoments:
    """Adds all rows of `x` [..., *shape]; every row ever seen weighs the same."""
    rows = x.reshape(-1, *moments.mean.shape)
    weight = moments.weight + rows.shape[0]
    share = rows.shape[0] / weight
    mean = moments.mean + share * (rows.mean(0) - moments.mean)
    # Second *central* moments: their parallel update does not cancel digits as E[x^2] - E[x]^2 would.
    between = share * (1 - share) * (rows.mean(0) - moments.mean) ** 2
    return RunningMoments(mean, (1 - share) * moments.second + share * rows.var(0) + between, weight)


def obs_scaling(moments: RunningMoments) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean, scale and bound of observations: x becomes clip((x - mean) / scale, -bound, bound).

    While nothing has been seen these are 0, 1 and inf: the identity.
    """
    seen = moments.weight > 0
    scale = jnp.sqrt(jnp.maximum(moments.second, MIN_OBS_VARIANCE))
    # Not `mean * seen`: where the moments are constants, jax.export 0.9.2 takes a true for 255.
    return jnp.where(seen, moments.mean, 0.0), jnp.where(seen, scale, 1.0), jnp.where(seen, OBS_CLIP, jnp.inf)


def normalise_obs(moments: RunningMoments, x: jax.Array) -> jax.Array:
    """`x` [..., *shape] centred, scaled and clipped to +-10; unchanged while nothing has been seen."""
    mean, scale, bound = obs_scaling(moments)
    return jnp.clip((x - mean) / scale, -bound, bound)


def update_ema(moments: RunningMoments, x: jax.Array, decay: jax.Array | float) -> RunningMoments:
    """Exponentially forgetting raw moments of `x` [..., *shape], for returns (PopArt; van Hasselt et al., 2016)."""
    rows = x.reshape(-1, *moments.mean.shape)
    return RunningMoments(
        decay * moments.mean + (1 - decay) * rows.mean(0),
        decay * moments.second + (1 - decay) * (rows**2).mean(0),
        decay * moments.weight + (1 - decay),
    )


def centre_and_scale(moments: RunningMoments) -> tuple[jax.Array, jax.Array]:
    """Debiased mean and standard deviation of forgetting moments; (0, 1) while nothing has been seen."""
    weight = jnp.maximum(moments.weight, MIN_WEIGHT)
    mean = moments.mean / weight
    variance = jnp.maximum(moments.second / weight - mean**2, MIN_RETURN_VARIANCE)
    seen = moments.weight > 0
    return mean * seen, jnp.where(seen, jnp.sqrt(variance), jnp.ones_like(variance))


def normalise(moments: RunningMoments, x: jax.Array) -> jax.Array:
    """Returns `x` [..., *shape] in the normalised units a critic predicts."""
    mean, scale = centre_and_scale(moments)
    return (x - mean) / scale


def denormalise(moments: RunningMoments, x: jax.Array) -> jax.Array:
    """The inverse of `normalise`."""
    mean, scale = centre_and_scale(moments)
    return x * scale + mean
