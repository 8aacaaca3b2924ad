"""A humanoid before any step: where its bodies are, how they move, and their inertias, as MuJoCo has them.

MJX has the same functions, unrolled over bodies: they take ten seconds to compile, a scan one.
"""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np


class _Bodies(NamedTuple):
    """Constants of the bodies below the root, in the model's order; slots of joints that a body lacks turn by 0.

    Attributes:
      parent: [n]; pos: [n, 3]; quat: [n, 4].
      axis, anchor: [n, J, 3] in the body's frame; dof: [n, J] of the joint, one behind the last if there is none.
    """

    parent: np.ndarray
    pos: np.ndarray
    quat: np.ndarray
    axis: np.ndarray
    anchor: np.ndarray
    dof: np.ndarray


def make_kinematics(model: mujoco.MjModel) -> Callable[[jax.Array, jax.Array], dict[str, jax.Array]]:
    """A function of qpos [nq] and qvel [nv] for a model of one tree of hinges on a free root.

    It returns `com` [3], `cinert` [nbody, 10] and `cvel` [nbody, 6] as `mj_comPos` and `mj_comVel` leave them.
    """
    bodies, mass = _constants(model), model.body_mass[:, None]

    def place_body(carry: tuple[jax.Array, ...], row: tuple[jax.Array, Any]) -> tuple[tuple[jax.Array, ...], None]:
        xpos, xquat, velocity, angle, speed = carry
        index, body = row
        quat, motion = _multiply(xquat[body.parent], body.quat), velocity[body.parent]
        pos = xpos[body.parent] + _rotate(xquat[body.parent], body.pos)
        for j in range(bodies.dof.shape[1]):
            axis, anchor = _rotate(quat, body.axis[j]), pos + _rotate(quat, body.anchor[j])
            half = angle[body.dof[j]] / 2
            quat = _multiply(quat, jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * body.axis[j]]))
            pos = anchor - _rotate(quat, body.anchor[j])
            motion += speed[body.dof[j]] * jnp.concatenate([axis, jnp.cross(anchor, axis)])
        xpos, xquat, velocity = xpos.at[index].set(pos), xquat.at[index].set(quat), velocity.at[index].set(motion)
        return (xpos, xquat, velocity, angle, speed), None

    def kinematics(qpos: jax.Array, qvel: jax.Array) -> dict[str, jax.Array]:
        dtype, nbody = qpos.dtype, model.nbody
        spin = _rotate(qpos[3:7], qvel[3:6])
        # A body's motion is its spin and the velocity of the point of it that passes the origin.
        root = jnp.concatenate([spin, qvel[:3] - jnp.cross(spin, qpos[:3])])
        xpos = jnp.zeros((nbody, 3), dtype).at[1].set(qpos[:3])
        xquat = jnp.zeros((nbody, 4), dtype).at[0, 0].set(1.0).at[1].set(qpos[3:7])
        velocity = jnp.zeros((nbody, 6), dtype).at[1].set(root)
        angle = jnp.pad(qpos[7:] - jnp.asarray(model.qpos0[7:], dtype), (6, 1))
        carry = (xpos, xquat, velocity, angle, jnp.pad(qvel, (0, 1)))
        rows = (jnp.arange(2, nbody), jax.tree.map(lambda x: jnp.asarray(x, None if x.dtype == int else dtype), bodies))
        (xpos, xquat, velocity, *_), _ = jax.lax.scan(place_body, carry, rows)
        xipos = xpos + jax.vmap(_rotate)(xquat, jnp.asarray(model.body_ipos, dtype))
        com = (mass * xipos).sum(0) / mass.sum()
        frame = jax.vmap(_matrix)(jax.vmap(_multiply)(xquat, jnp.asarray(model.body_iquat, dtype)))
        cvel = velocity.at[:, 3:].add(jnp.cross(velocity[:, :3], com))
        return {"com": com.astype(dtype), "cinert": _inertias(model, frame, xipos - com).astype(dtype), "cvel": cvel}

    return kinematics


def _constants(model: mujoco.MjModel) -> _Bodies:
    below = np.arange(2, model.nbody)
    slots = int(model.body_jntnum[below].max())
    axis, anchor = np.zeros((2, len(below), slots, 3))
    dof = np.full((len(below), slots), model.nv)
    for i, body in enumerate(below):
        for j in range(model.body_jntnum[body]):
            joint = model.body_jntadr[body] + j
            axis[i, j], anchor[i, j] = model.jnt_axis[joint], model.jnt_pos[joint]
            dof[i, j] = model.jnt_dofadr[joint]
    return _Bodies(
        model.body_parentid[below].astype(int), model.body_pos[below], model.body_quat[below], axis, anchor, dof
    )


def _inertias(model: mujoco.MjModel, frame: jax.Array, offset: jax.Array) -> jax.Array:
    """[nbody, 10]: xx yy zz xy xz yz about the centre of mass in the world's axes, mass times offset, mass."""
    mass = jnp.asarray(model.body_mass)[:, None]
    own = jnp.einsum("bij,bj,bkj->bik", frame, model.body_inertia, frame, precision="highest")
    outer = offset[:, :, None] * offset[:, None, :]
    moved = own + mass[:, :, None] * ((offset**2).sum(-1)[:, None, None] * jnp.eye(3) - outer)
    entries = moved[:, (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
    return jnp.concatenate([entries, mass * offset, mass], axis=1)


def _multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """The product of two quaternions [4], w first."""
    w = a[0] * b[0] - jnp.sum(a[1:] * b[1:])
    return jnp.concatenate([w[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])])


def _rotate(quat: jax.Array, vector: jax.Array) -> jax.Array:
    """`vector` [3] turned by the unit quaternion `quat` [4]."""
    twice = 2 * jnp.cross(quat[1:], vector)
    return vector + quat[0] * twice + jnp.cross(quat[1:], twice)


def _matrix(quat: jax.Array) -> jax.Array:
    """[3, 3] whose columns are the turned axes."""
    return jax.vmap(lambda axis: _rotate(quat, axis), out_axes=1)(jnp.eye(3, dtype=quat.dtype))
