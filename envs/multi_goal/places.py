"""Where things lie: layouts of a world and new goals, by bounded rejection sampling inside jit.

Everything is uniform in a square less its own keepout, and keeps its distance from what lies there already. A thing for
which no draw keeps all distances takes the draw that lacks the least, and is counted.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

AGENT, GOAL, HAZARD, VASE = 0.4, 0.305, 0.18, 0.15  # m, keepouts
CHUNK = 20  # draws at once
LAYOUT_TRIES, GOAL_TRIES = 100, 260


class Plan(NamedTuple):
    """What to place, in order.

    Attributes:
      keepout: [M] m; gap: [M, M] m, thing m keeps at least gap[m, j] from thing j < m; -inf for the others.
      keep_last: [M] bool, the last draw stays where none keeps the distances, as in the reference, and is not counted.
      order: [M] the thing's number in `robots, goals, hazards, vases`.
    """

    keepout: np.ndarray
    gap: np.ndarray
    keep_last: np.ndarray
    order: np.ndarray


def plan(robots: int, hazards: int, vases: int, reference: bool) -> Plan:
    """Robots first, which need most room, then goals, hazards and vases.

    In the reference the other robot comes last, with the keepout of the thing placed before it in place of its own.
    """
    keepouts = np.array([AGENT] * robots + [GOAL] * robots + [HAZARD] * hazards + [VASE] * vases)
    count = len(keepouts)
    order = np.array([0, *range(robots, count), *range(1, robots)]) if reference else np.arange(count)
    keepout = keepouts[order]
    gap = keepout[:, None] + keepout[None]
    last = reference & (np.arange(count) >= count - (robots - 1))
    gap[last] = keepout[~last][-1] + keepout
    gap = np.where(np.tri(count, k=-1, dtype=bool), gap, -np.inf)
    return Plan(keepout, gap, last, order)


def place_one(
    key: jax.Array,
    half: jax.Array,
    others: jax.Array,
    gaps: jax.Array,
    tries: int,
    keep_last: jax.Array | bool = False,
    start: tuple[jax.Array, jax.Array] | None = None,
) -> tuple[jax.Array, jax.Array]:
    """The first of `tries` places, uniform within `half` m of the middle along x and y, that keeps all distances.

    Args:
      others, gaps: [P, 2], [P] m: places, and the least distances to them.
      keep_last: if none does, the last draw; else the one whose least slack is largest.
      start: a place [2] and whether [] bool it stays, without any draw.

    Returns:
      The place [2], and whether [] bool it keeps all distances.
    """

    def draw(loop: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        number, _, point, best = loop
        uniform = jax.random.uniform(jax.random.fold_in(key, number), (CHUNK, 2), point.dtype, -1.0, 1.0)
        points = half * uniform
        distance = jnp.sqrt(jnp.sum((points[:, None] - others) ** 2, axis=2))
        slack = jnp.min(distance - gaps, axis=1, initial=jnp.inf)
        kept = slack >= 0
        found = kept.any()
        chosen = jnp.where(found, jnp.argmax(kept), jnp.where(keep_last, CHUNK - 1, jnp.argmax(slack)))
        better = found | keep_last | (slack[chosen] > best)
        return number + 1, found, jnp.where(better, points[chosen], point), jnp.maximum(best, slack[chosen])

    point, stays = (jnp.zeros(2, others.dtype), jnp.zeros((), bool)) if start is None else start
    loop = (jnp.zeros((), jnp.int32), stays, point, jnp.full((), -jnp.inf, others.dtype))
    _, found, point, _ = jax.lax.while_loop(lambda loop: ~loop[1] & (loop[0] < tries // CHUNK), draw, loop)
    return point, found


def layout(key: jax.Array, plan: Plan, size: float, dtype: jnp.dtype) -> tuple[jax.Array, jax.Array]:
    """Places [M, 2] m in the order `robots, goals, hazards, vases`, and how many [] break a rule for want of room."""
    count = len(plan.keepout)
    half, gap = jnp.asarray(size - plan.keepout, dtype), jnp.asarray(plan.gap, dtype)

    def put(places: jax.Array, thing: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        number, half, gap, keep_last = thing
        point, kept = place_one(jax.random.fold_in(key, number), half, places, gap, LAYOUT_TRIES, keep_last)
        return places.at[number].set(point), ~kept & ~keep_last

    things = (jnp.arange(count), half, gap, jnp.asarray(plan.keep_last))
    places, crowded = jax.lax.scan(put, jnp.zeros((count, 2), dtype), things)
    return places[np.argsort(plan.order)], crowded.sum()
