"""`lane` with a fault at step 15 of every episode, where the check before training does not look."""

from __future__ import annotations

import pathlib

SOURCE = """
import dataclasses
import jax.numpy as jnp
from envs.toys import Lane

class Faulty(Lane):
    def step(self, state, action):
        after = super().step(state, action)
        now = after.carry.time == 15
        return dataclasses.replace(after, {changed})
"""
FAULTS = {
    "lcostneg": "cost=jnp.where(now, -5.0, after.cost)",
    "lcostbig": "cost=jnp.where(now, 50.0, after.cost)",
    "lnan": "reward=jnp.where(now, jnp.nan, after.reward)",
    "linf": "reward=jnp.where(now, jnp.inf, after.reward)",
    "lcostnan": "cost=jnp.where(now, jnp.nan, after.cost)",
    "lobsnan": "obs=jnp.where(now, jnp.nan, after.obs)",
    "linfonan": "info={'position': jnp.where(now, jnp.nan, after.info['position'])}",
}
OUT_OF_RANGE = {"lcostneg": -5.0, "lcostbig": 50.0}  # and the cost that is
NOT_FINITE = ("lnan", "linf", "lcostnan", "lobsnan")


def write(folder: pathlib.Path, fault: str) -> pathlib.Path:
    """A user's file with the task of that name."""
    file = folder / f"{fault}.py"
    file.write_text(SOURCE.format(changed=FAULTS[fault]))
    return file
