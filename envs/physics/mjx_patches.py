"""What of MJX is replaced while it is traced: contacts of capsules with planes and boxes, and the line search."""

from __future__ import annotations

import contextlib
import importlib
import io
import threading
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from ..errors import TaskError
from ..versions import installed_version
from .contract import INSTALL, MUJOCO_SERIES


def import_mjx() -> Any:
    """`mujoco.mjx`, imported on first use and without what it prints where the optional warp is missing."""
    with contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


def check_hooks() -> None:
    """Whether the private places of MJX that `patched` replaces are still there.

    Raises:
      TaskError: they are not; this MJX may differ from C.
    """
    import_mjx()
    from mujoco.mjx._src import collision_driver, solver

    table = getattr(collision_driver, "_COLLISION_FUNC", {})
    found = set(_contacts()) <= set(table) and callable(getattr(solver, "_while_loop_scan", None))
    if not found:
        raise no_hooks()


def no_hooks() -> TaskError:
    """What to raise where MJX, or the Warp in it, has no place for what is replaced."""
    found = installed_version("mujoco-mjx")
    return TaskError(f"mujoco-mjx {found} lacks the private hooks of {MUJOCO_SERIES}; {INSTALL}")


_HOOKING = threading.RLock()  # the hooks are module globals; two threads may trace at once


@contextlib.contextmanager
def patched() -> Iterator[None]:
    """While MJX is being traced: C's contacts of capsules with planes and of balls with boxes, a better line search.

    MJX's own is a scan over all iterations, for the sake of reverse-mode gradients, which are not taken through
    the physics here; a real loop is 1.6 times as fast at 50 iterations. And in float32 it at times stops a step early.
    """
    from mujoco.mjx._src import collision_driver, solver

    table, ours = collision_driver._COLLISION_FUNC, _contacts()
    with _HOOKING:
        stock = {pair: table[pair] for pair in ours}, solver._while_loop_scan
        table.update(ours)
        solver._while_loop_scan = _line_search
        try:
            yield
        finally:
            table.update(stock[0])
            solver._while_loop_scan = stock[1]


def _contacts() -> dict[Any, Any]:
    """Our functions for pairs of geoms."""
    from mujoco.mjx._src.types import GeomType

    return {
        (GeomType.PLANE, GeomType.CAPSULE): _plane_capsule,
        (GeomType.SPHERE, GeomType.BOX): _sphere_box,
        (GeomType.CAPSULE, GeomType.BOX): _capsule_box,
    }


def _line_search(cond: Any, body: Any, init: Any, max_iter: int) -> Any:
    """`body` while `cond`, at most `max_iter` times, on the bracket `lo` to `hi` of MJX's line search.

    MJX then takes the end with the lower cost, or stays where it was if neither is lower than there. In float32 the
    cost is too coarse to show what the last Newton step gains (1e-3 of 1e5, and 0.1 in qacc), whereas the slope still
    shows it. So if costs agree to rounding, the end with the smaller slope is given the lower cost.
    """

    def proceed(carry: Any) -> jax.Array:
        count, value = carry
        return (count < max_iter) & cond(value)

    init = jax.tree.map(jnp.asarray, init)
    found = jax.lax.while_loop(proceed, lambda carry: (carry[0] + 1, body(carry[1])), (jnp.int32(0), init))[1]
    lo, hi = found.lo, found.hi
    start = _either(init.lo.alpha == 0, init.lo, init.hi)
    flatter = _either(jnp.abs(lo.deriv_0) < jnp.abs(hi.deriv_0), lo, hi)
    rounding = 8 * jnp.finfo(start.cost.dtype).eps * jnp.abs(start.cost)
    unseen = (jnp.minimum(lo.cost, hi.cost) >= start.cost) & (flatter.cost <= start.cost + rounding)
    unseen &= jnp.abs(flatter.deriv_0) < jnp.abs(start.deriv_0)
    return found.replace(lo=_either(unseen, flatter.replace(cost=-jnp.inf), lo))


def _either(condition: jax.Array, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _plane_capsule(model: Any, data: Any, _: Any, geoms: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Contacts [2 pairs] of planes and capsules: distance, position and frame, in the layout MJX's driver expects.

    As in C, the first tangent is the capsule's axis projected on the plane, however steep the capsule; MJX's own
    function takes another one beyond 60 degrees, which changes friction, whose cone is a pyramid along the tangents.
    """

    def collide(plane: jax.Array, capsule: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        normal, axis = data.geom_xmat[plane][:, 2], data.geom_xmat[capsule][:, 2]
        radius, half_length = model.geom_size[capsule][0], model.geom_size[capsule][1]
        tangent = axis - normal * jnp.dot(normal, axis)
        length = jnp.linalg.norm(tangent)
        upright = length < 1e-6  # no direction to project: any tangent will do
        other = jnp.where(jnp.abs(normal[1]) < 0.5, jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
        other = other - normal * jnp.dot(normal, other)
        tangent = jnp.where(upright, other / jnp.linalg.norm(other), tangent / jnp.where(upright, 1.0, length))
        frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)])
        ends = data.geom_xpos[capsule] + jnp.array([[1.0], [-1.0]]) * half_length * axis
        distance = (ends - data.geom_xpos[plane]) @ normal - radius
        position = ends - normal * (radius + 0.5 * distance)[:, None]
        return distance, position, jnp.stack([frame, frame])

    return jax.tree.map(jnp.concatenate, jax.vmap(collide)(geoms[:, 0], geoms[:, 1]))


def _sphere_box(model: Any, data: Any, _: Any, geoms: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Contacts [pairs] of spheres and boxes, see `_ball_box`."""

    def collide(sphere: jax.Array, box: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        return _ball_box(data.geom_xpos[sphere], model.geom_size[sphere][0], data, box, model.geom_size[box])

    return jax.vmap(collide)(geoms[:, 0], geoms[:, 1])


def _capsule_box(model: Any, data: Any, _: Any, geoms: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Contacts [2 pairs] of the capsules' ends and boxes, see `_ball_box`.

    As in C, both ends may touch a face; unlike in C, an edge of the box between the ends is no contact. With MJX's own
    function ants that touch a wall were 5e-3 m off C after a control step (median), with this one 3e-6.
    """

    def collide(capsule: jax.Array, box: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        radius, half_length = model.geom_size[capsule][0], model.geom_size[capsule][1]
        ends = jnp.array([[1.0], [-1.0]]) * half_length * data.geom_xmat[capsule][:, 2] + data.geom_xpos[capsule]
        return jax.vmap(_ball_box, (0, None, None, None, None))(ends, radius, data, box, model.geom_size[box])

    return jax.tree.map(jnp.concatenate, jax.vmap(collide)(geoms[:, 0], geoms[:, 1]))


def _ball_box(
    centre: jax.Array, radius: jax.Array, data: Any, box: jax.Array, size: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distance, position and frame of a ball's contact with a box of half sizes `size` [3].

    The normal points to the box's nearest point; to the inside of the nearest face if the centre is in the box.
    """
    from mujoco.mjx._src.math import make_frame

    rotation = data.geom_xmat[box]
    place = (centre - data.geom_xpos[box]) @ rotation
    off = jnp.clip(place, -size, size) - place
    apart = jnp.linalg.norm(off)
    depth = size - jnp.abs(place)
    inside, nearest = jnp.equal(apart, 0), jnp.argmin(depth)
    inward = -jnp.sign(place[nearest]) * jax.nn.one_hot(nearest, 3, dtype=place.dtype)
    normal = rotation @ jnp.where(inside, inward, off / jnp.where(inside, 1.0, apart))
    distance = jax.lax.select(inside, -depth[nearest], apart) - radius
    return distance, centre + normal * (radius + 0.5 * distance), make_frame(normal)


for _function, _count in ((_plane_capsule, 2), (_sphere_box, 1), (_capsule_box, 2)):
    setattr(_function, "ncon", _count)  # noqa: B010  (contacts a pair, read by MJX's driver)
