"""The geoms of each agent that count for contacts, and what they touch."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from . import touching
from .kinematics import Pose, legs, pose
from .models import VASE
from .touching import Boxes, Capsules, Group

_BALL, _ARROW, _TORSO, _LEG = 0.1, 0.05, 0.0625, 0.02  # m: radii, and half the side of an arrow


def groups_of(robot: str, qpos: jax.Array, whole: bool) -> Group:
    """Each agent's group, with a leading [N], from the robots' qpos [N, nq].

    `whole` or of points: all geoms of the agent's own robot. Else as the reference cuts the ants' geoms: agent 0 has
    the torso and the first part of leg 1 of ant 0, agent 1 the rest of that leg.
    """
    if robot == "point":
        return jax.vmap(_point)(qpos)
    ants = jax.vmap(_ant)(qpos)
    if whole:
        return ants
    first = jax.tree.map(lambda x: x[0, :4].reshape(2, 2, *x.shape[2:]), ants.capsules)
    return Group(first, ants.boxes)


def _point(qpos: jax.Array) -> Group:
    body = pose("point", qpos)
    ahead = body.place + body.rotation[:, 0] * 0.1
    ball = Capsules(body.place[None], body.place[None], jnp.full(1, _BALL, qpos.dtype))
    arrow = Boxes(Pose(ahead[None], body.rotation[None]), jnp.full((1, 3), _ARROW, qpos.dtype))
    return Group(ball, arrow)


def _ant(qpos: jax.Array) -> Group:
    start, end = (jnp.concatenate([qpos[None, :3], x.reshape(-1, 3)]) for x in legs(qpos))
    radius = jnp.asarray(np.array([_TORSO] + [_LEG] * 12), qpos.dtype)
    return Group(Capsules(start, end, radius), Boxes(Pose(start[:0], jnp.zeros((0, 3, 3), qpos.dtype)), start[:0]))


def touched_vases(groups: Group, vases: jax.Array) -> jax.Array:
    """[N, V] bool: which agents touch which vases, from the vases' qpos [V, 7]."""
    if not len(vases):
        return jnp.zeros((len(groups.capsules.radius), 0), bool)
    boxes = Boxes(jax.vmap(lambda qpos: pose("vase", qpos))(vases), jnp.full((len(vases), 3), VASE, vases.dtype))
    return jax.vmap(touching.group_touches, (0, None))(groups, boxes)


def touched_robots(groups: Group) -> jax.Array:
    """[N] bool: which agents touch another's robot."""
    agents = range(len(groups.capsules.radius))
    each = [jax.tree.map(lambda x, i=i: x[i], groups) for i in agents]
    touches = {(i, j): touching.groups_touch(each[i], each[j]) for i in agents for j in agents if i < j}
    return jnp.stack([jnp.stack([hit for pair, hit in touches.items() if i in pair]).any() for i in agents])
