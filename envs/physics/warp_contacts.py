"""What of MuJoCo-Warp is replaced: its contact of a capsule with a plane. Only `warp_engine` imports this."""

# warp is not installed everywhere:
# pyright: reportMissingImports=false
from __future__ import annotations

import warp
from mujoco.mjx.third_party.mujoco_warp._src import collision_primitive, collision_primitive_core

from .mjx_patches import no_hooks


def install() -> None:
    """Puts `_plane_capsule` in the place of Warp's own, for all kernels that are compiled from now on.

    Raises:
      TaskError: this MuJoCo-Warp has no such place.
    """
    if not hasattr(collision_primitive, "plane_capsule"):
        raise no_hooks()
    collision_primitive.plane_capsule = _plane_capsule


@warp.func
def _plane_capsule(
    normal: warp.vec3, plane_pos: warp.vec3, capsule_pos: warp.vec3, axis: warp.vec3, radius: float, half_length: float
) -> tuple[warp.vec2, collision_primitive_core.mat23f, warp.mat33]:
    """Distances [2], positions [2, 3] and the frame of a capsule's two contacts with a plane.

    As in C, the first tangent is the capsule's axis projected on the plane, however steep the capsule; Warp's own
    function takes another one beyond 60 degrees, which changes friction, whose cone is a pyramid along the tangents.
    """
    tangent = axis - normal * warp.dot(normal, axis)
    if warp.length(tangent) < 1e-6:  # no direction to project: any tangent will do
        other = warp.vec3(0.0, 0.0, 1.0)
        if warp.abs(normal[1]) < 0.5:
            other = warp.vec3(0.0, 1.0, 0.0)
        tangent = other - normal * warp.dot(normal, other)
    tangent = warp.normalize(tangent)
    binormal = warp.cross(normal, tangent)
    end = axis * half_length
    first, first_pos = collision_primitive_core.plane_sphere(normal, plane_pos, capsule_pos + end, radius)
    second, second_pos = collision_primitive_core.plane_sphere(normal, plane_pos, capsule_pos - end, radius)
    return (
        warp.vec2(first, second),
        collision_primitive_core.mat23f(
            first_pos[0], first_pos[1], first_pos[2], second_pos[0], second_pos[1], second_pos[2]
        ),
        warp.matrix_from_rows(normal, tangent, binormal),
    )
