"""Which bodies overlap, as functions of positions alone: the same on all engines, whatever contacts these list.

A sphere is a capsule without length. Distances are exact, not iterated.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .kinematics import Pose

_PARALLEL = 1e-6  # sine of an angle below which two edges of boxes, or two segments, count as parallel


class Capsules(NamedTuple):
    """M capsules: `start` and `end` [..., 3] m of their axes, `radius` [...] m."""

    start: jax.Array
    end: jax.Array
    radius: jax.Array


class Boxes(NamedTuple):
    """M boxes: `pose` of their centres with a leading [...], `half` [..., 3] m, half their sides."""

    pose: Pose
    half: jax.Array


class Group(NamedTuple):
    """What touches for one agent: [C] capsules and [D] boxes."""

    capsules: Capsules
    boxes: Boxes


def groups_touch(first: Group, second: Group) -> jax.Array:
    """[] bool: any geom of one group overlaps any of the other."""
    found = [
        _every(capsules_touch, first.capsules, second.capsules),
        _every(capsule_touches_box, first.capsules, second.boxes),
        _every(capsule_touches_box, second.capsules, first.boxes),
        _every(boxes_touch, first.boxes, second.boxes),
    ]
    return jnp.stack(found).any()


def group_touches(group: Group, boxes: Boxes) -> jax.Array:
    """[V] bool: for each of V boxes, whether any geom of the group overlaps it."""

    def one(box: Boxes) -> jax.Array:
        single = jax.tree.map(lambda x: x[None], box)
        return _every(capsule_touches_box, group.capsules, single) | _every(boxes_touch, group.boxes, single)

    if not boxes.half.shape[0]:
        return jnp.zeros(0, bool)
    return jax.vmap(one)(boxes)


def _every(test: Callable[[Any, Any], jax.Array], first: Any, second: Any) -> jax.Array:
    """[] bool: `test` holds for any pair of the two sets."""
    if not jax.tree.leaves(first)[0].shape[0] or not jax.tree.leaves(second)[0].shape[0]:
        return jnp.zeros((), bool)
    return jax.vmap(jax.vmap(test, (None, 0)), (0, None))(first, second).any()


def capsules_touch(a: Capsules, b: Capsules) -> jax.Array:
    """[] bool."""
    return _segments_distance2(a.start, a.end, b.start, b.end) < (a.radius + b.radius) ** 2


def capsule_touches_box(capsule: Capsules, box: Boxes) -> jax.Array:
    """[] bool. The squared distance of a point on the axis is piecewise quadratic and convex along it."""
    start = box.pose.rotation.T @ (capsule.start - box.pose.place)
    along = box.pose.rotation.T @ (capsule.end - capsule.start)
    safe = jnp.where(along == 0, 1.0, along)
    sides = jnp.concatenate([(-box.half - start) / safe, (box.half - start) / safe])
    ends = jnp.array([0.0, 1.0], start.dtype)
    knots = jnp.sort(jnp.concatenate([jnp.clip(sides, 0.0, 1.0), ends]))  # between two of them it is one quadratic

    def beyond(t: jax.Array) -> jax.Array:
        point = start + t * along
        return point - jnp.clip(point, -box.half, box.half)

    slope = jax.vmap(lambda t: jnp.dot(beyond(t), along))(knots)
    rise = slope[1:] - slope[:-1]
    share = jnp.clip(-slope[:-1] / jnp.where(rise > 0, rise, 1.0), 0.0, 1.0)
    lowest = knots[:-1] + share * (knots[1:] - knots[:-1])
    distance2 = jax.vmap(lambda t: jnp.sum(beyond(t) ** 2))(lowest)
    return distance2.min() < capsule.radius**2


def boxes_touch(a: Boxes, b: Boxes) -> jax.Array:
    """[] bool, by separating axes: the faces' normals and the products of edges."""
    turn = a.pose.rotation.T @ b.pose.rotation
    apart = a.pose.rotation.T @ (b.pose.place - a.pose.place)
    size = jnp.abs(turn)
    faces_a = a.half + size @ b.half - jnp.abs(apart)
    faces_b = b.half + size.T @ a.half - jnp.abs(turn.T @ apart)
    overlap = jnp.minimum(faces_a.min(), faces_b.min()) > 0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for m in range(3):
            n, o = (m + 1) % 3, (m + 2) % 3
            reach = a.half[j] * size[k, m] + a.half[k] * size[j, m] + b.half[n] * size[i, o] + b.half[o] * size[i, n]
            distance = jnp.abs(apart[k] * turn[j, m] - apart[j] * turn[k, m])
            parallel = turn[j, m] ** 2 + turn[k, m] ** 2 < _PARALLEL**2
            overlap &= parallel | (distance < reach)
    return overlap


def _segments_distance2(p: jax.Array, q: jax.Array, r: jax.Array, s: jax.Array) -> jax.Array:
    """Squared distance of segments pq and rs: of an end to the other segment, or of two points inside."""
    ends = [_point_distance2(p, r, s), _point_distance2(q, r, s), _point_distance2(r, p, q), _point_distance2(s, p, q)]
    u, v, w = q - p, s - r, p - r
    uu, vv, uv, uw, vw = jnp.dot(u, u), jnp.dot(v, v), jnp.dot(u, v), jnp.dot(u, w), jnp.dot(v, w)
    det = uu * vv - uv**2
    crossing = det > _PARALLEL**2 * uu * vv
    det = jnp.where(crossing, det, 1.0)
    at_u, at_v = (uv * vw - vv * uw) / det, (uu * vw - uv * uw) / det
    inside = crossing & (at_u >= 0) & (at_u <= 1) & (at_v >= 0) & (at_v <= 1)
    between = jnp.sum((w + at_u * u - at_v * v) ** 2)
    return jnp.minimum(jnp.stack(ends).min(), jnp.where(inside, between, jnp.inf))


def _point_distance2(point: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    along = end - start
    length2 = jnp.dot(along, along)
    t = jnp.clip(jnp.dot(point - start, along) / jnp.where(length2 > 0, length2, 1.0), 0.0, 1.0)
    return jnp.sum((start + t * along - point) ** 2)
