"""Whether a run fits into memory, asked before anything is compiled."""

from __future__ import annotations

import itertools
import math
import os

import jax

from ..errors import UsageError
from ..learning.setup import Setup

FLOAT = 4  # bytes


def check(setup: Setup) -> None:
    """Refuses a run that cannot fit: observations of one batch, or weights and Adam's moments, exceed the memory.

    Raises:
      UsageError: names what is too large.
    """
    config, spec = setup.config, setup.vector.spec
    memory = _device_memory() * (setup.mesh.size if setup.mesh else 1)
    batch = config.batch_size * (spec.num_agents * spec.obs_dim + spec.state_dim)
    widths = (spec.obs_dim, *config.hidden, spec.action_dim)
    networks = 3 * spec.num_agents * sum(x * y for x, y in itertools.pairwise(widths))
    for what, floats in (
        (f"a batch of num_envs * rollout_length = {config.num_envs} * {config.rollout_length} steps", batch),
        (f"networks with hidden = {list(config.hidden)}", networks),
    ):
        needed = config.seeds * floats * FLOAT
        if needed > memory:
            raise UsageError(
                f"{what} needs at least {needed / 1e9:,.0f} GB for {config.seeds} seed(s), but there are "
                f"{memory / 1e9:,.0f} GB here; ask for less"
            )


def _device_memory() -> float:
    """Bytes of one device, or of the machine if devices share its memory."""
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in stats or not hasattr(os, "sysconf"):  # Windows has none
        return stats.get("bytes_limit", math.inf)
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
