"""Methods learn: small networks reach the optima of the toys, within what 16 seeds have shown.

Each figure stands beside the mean and standard deviation of 16 seeds (of one seed's figure), and every bound is at least
three standard deviations away from the mean.
"""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from pmt_jax import load_config, make_train

TINY = {"num_envs": 16, "hidden": (16,), "steps": 40_000}
SEEDS = 3


@functools.cache
def learned(task: str, method: str, seeds: int = SEEDS, **changes: str) -> tuple[np.ndarray, np.ndarray]:
    """Every seed's mean episode cost and reward of the last 15 of 100 updates."""
    keys = jax.random.split(jax.random.key(1), seeds)
    _, metrics = jax.jit(jax.vmap(make_train(load_config(task, method=method, **TINY, **changes))))(keys)
    return tuple(np.asarray(metrics[name])[:, -15:].mean(1) for name in ("episode_cost", "episode_reward"))
