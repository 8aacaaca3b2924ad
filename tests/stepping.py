"""Models and their states, what MuJoCo's C engine makes of them, and how far another engine's rows are from that.

Shared by the tests of both schedules of `fused`: a process works out each robot's states and C's answers once.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import native
from envs.ant import corridor, walls
from envs.multi_goal import models as goals
from envs.physics.fused import model as tables_of
from envs.velocity import robots

compiled = pytest.mark.skipif(native.obstacle("fused") is not None, reason="no C++ compiler here")
ROBOTS = ("corridor", "hopper", "walls", "swimmer", "humanoid", "ant", "half_cheetah", "walker2d")
FULL = ("hopper", "walls", "humanoid")  # a planar robot, the corridor's ant next to solid walls, the largest robot


def by_robot(*default: str, full: Sequence[str] = FULL) -> list[Any]:
    """Parameters: of ROBOTS, those for the default tests, those for `-m full`, and the others, which run by hand."""
    late = [x for x in ROBOTS if x not in default]
    return [*default, *(pytest.param(x, marks=pytest.mark.full if x in full else pytest.mark.slow) for x in late)]


def sweep(robot: str) -> list[Any]:
    """Parameters (robot, kind, full): some states of one robot by default, many of each as `by_robot` says."""
    marks = {x: pytest.mark.full if x in FULL else pytest.mark.slow for x in ROBOTS}
    many = [pytest.param(x, kind, True, marks=marks[x]) for x in ROBOTS for kind in kinds(x)]
    return [*((robot, kind, False) for kind in kinds(robot)), *many]


Rows = dict[str, np.ndarray]  # qpos, qvel, warmstart, and the readouts by name


def exact(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose solver goes on to the end, where C would stop at an improvement of 1e-8."""
    model = copy.copy(model)
    model.opt.tolerance, model.opt.ls_tolerance = 0.0, 1e-6
    return model


def model_of(robot: str) -> tuple[mujoco.MjModel, int]:
    """A model and its substeps."""
    if robot in ("corridor", "walls"):
        return exact(walls.model("solid" if robot == "walls" else "reference")), corridor.SUBSTEPS
    return exact(robots.model(robot)), robots.ROBOTS[robot].substeps


def readout_of(model: mujoco.MjModel) -> dict:
    """Every field that the engine reads out, of all bodies (cinert and cfrc_ext: of those that something moves)."""
    moved = np.array([b for b in range(model.nbody) if b == 0 or model.body_weldid[b]])
    some = {field: (field, moved if field in ("cinert", "cfrc_ext") else slice(None)) for field in tables_of.FIELDS}
    return some | {"subtree_com": ("subtree_com", 1)}


def by_c(model: mujoco.MjModel, rows: np.ndarray, substeps: int, readout: dict, forward: bool = False) -> Rows:
    """What MuJoCo makes of rows [n, qpos qvel warm start ctrl].

    No substeps: `warmstart` is the rows' own qacc. `forward`: readouts are of a forward pass after the substeps.
    """
    data, found = mujoco.MjData(model), []
    ends = np.cumsum([model.nq, model.nv, model.nv])
    for row in rows:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = np.split(row, ends)
        if substeps:
            mujoco.mj_step(model, data, substeps)
        else:
            mujoco.mj_forward(model, data)
        if forward:
            mujoco.mj_forward(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        warm = data.qacc_warmstart if substeps else data.qacc
        out = {name: np.array(getattr(data, field)[index]) for name, (field, index) in readout.items()}
        found.append({"qpos": data.qpos.copy(), "qvel": data.qvel.copy(), "warmstart": warm.copy()} | out)
    return {name: np.stack([row[name] for row in found]) for name in found[0]}


def errors(found: np.ndarray, right: np.ndarray) -> np.ndarray:
    """[n], the largest of each row, relative to the row's largest number if that is above 1."""
    found, right = (np.reshape(x, (len(right), -1)) for x in (found, right))
    if not right.size:
        return np.zeros(len(right))
    return np.abs(found - right).max(1) / np.maximum(1.0, np.abs(right).max(1))


def check(found: Rows, right: Rows, tolerance: float, share: float) -> None:
    """All but a share of rows within the tolerance.

    MuJoCo jumps where a contact is at its margin within rounding, and C's jumps are at other bits than ours.
    """
    for name, expected in right.items():
        worst = np.sort(errors(found[name], expected))[-int(share * len(expected)) - 1]
        assert worst < tolerance, (name, worst)


# -- states: rows [n, qpos qvel warm start ctrl] --


def visited(model: mujoco.MjModel, substeps: int, count: int) -> np.ndarray:
    """States along rollouts with random controls from near the reference pose."""
    rng, data, rows = np.random.default_rng(0), mujoco.MjData(model), []
    while len(rows) < count:
        mujoco.mj_resetData(model, data)
        data.qpos[:] += rng.uniform(-0.1, 0.1, model.nq)
        data.qvel[:] = 0.1 * rng.normal(size=model.nv)
        if model.jnt_type[0] == 0:
            data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        size = rng.choice([0.1, 0.5, 1.0]) * model.actuator_ctrlrange[:, 1]
        for k in range(40):
            data.ctrl[:] = rng.uniform(-1.2, 1.2, model.nu) * size
            if k % 4 == 3:
                rows.append(np.concatenate([data.qpos, data.qvel, data.qacc_warmstart, data.ctrl]))
            mujoco.mj_step(model, data, substeps)
    return np.array(rows[:count])


def anywhere(model: mujoco.MjModel, count: int, low: float, high: float) -> np.ndarray:
    """States in any attitude, `low` to `high` m over the floor (of a free root), joints up to 0.2 beyond limits."""
    rng = np.random.default_rng(1)
    rows = np.zeros((count, model.nq + 2 * model.nv + model.nu))
    rows[:, : model.nq] = model.qpos0
    for j in range(model.njnt):
        a, kind = model.jnt_qposadr[j], model.jnt_type[j]
        if kind == 0:
            quat = rng.normal(size=(count, 4))
            rows[:, a + 2] = rng.uniform(low, high, count)
            rows[:, a + 3 : a + 7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        elif model.jnt_limited[j]:
            rows[:, a] = rng.uniform(model.jnt_range[j, 0] - 0.2, model.jnt_range[j, 1] + 0.2, count)
        else:
            reach = 1.5 if kind == 3 else 0.5
            rows[:, a] += rng.uniform(-reach, reach if kind == 3 else 0.2, count)
    rows[:, model.nq : model.nq + model.nv] = 2 * rng.normal(size=(count, model.nv))
    if model.nu:
        rows[:, -model.nu :] = rng.uniform(-1.2, 1.2, (count, model.nu))
    return rows


def crowded(robot: str, vases: int, count: int) -> np.ndarray:
    """MultiGoal's two robots and vases so close that they touch, along rollouts with random controls."""
    model, kind = exact(goals.model(robot, 2, vases, 1.5)), goals.ROBOTS[robot]
    rng, data, rows = np.random.default_rng(5), mujoco.MjData(model), []
    while len(rows) < count:
        mujoco.mj_resetData(model, data)
        turn, apart = rng.uniform(-np.pi, np.pi), rng.uniform(0.08, 0.16)
        for k in range(2 + vases):
            start = kind.nq * min(k, 2) + 7 * max(k - 2, 0)
            angle = turn + k * (np.pi if k < 2 else 1.5)
            reach = apart if k < 2 else rng.uniform(0.25, 0.4) + 0.25 * ((k - 2) // 4)
            data.qpos[start : start + 2] = reach * np.cos(angle), reach * np.sin(angle)
            heading = rng.uniform(-np.pi, np.pi)
            if robot == "point" and k < 2:
                data.qpos[start + 2] = heading
                continue
            data.qpos[start + 2] = 0.1 - 4e-5 if k >= 2 else rng.uniform(0.1, 0.2)
            data.qpos[start + 3 : start + 7] = np.cos(heading / 2), 0, 0, np.sin(heading / 2)
            if k < 2:
                data.qpos[start + 7 : start + 15] = rng.uniform(-1.5, 1.5, 8)
        data.qvel[: 2 * kind.nv] = 0.3 * rng.normal(size=2 * kind.nv)
        for _ in range(3):
            data.ctrl[:] = rng.uniform(-1, 1, model.nu)
            rows.append(np.concatenate([data.qpos, data.qvel, data.qacc_warmstart, data.ctrl]))
            mujoco.mj_step(model, data, goals.SUBSTEPS)
    return np.array(rows[:count])


def at_walls(model: mujoco.MjModel, count: int) -> np.ndarray:
    """Ants in any attitude at solid walls: before them, in them, on top of them, and at the folds."""
    rng, rows = np.random.default_rng(2), anywhere(model, count, 0.05, 1.6)
    for row in rows:
        fold = rng.choice([20.0, 60.0, 100.0]) + rng.uniform(-1, 1)
        row[0] = rng.choice([rng.uniform(-80, 130), fold])
        off = rng.choice([-1, 1]) * (5 + rng.uniform(-0.9, 0.3))
        row[1] = off - float(corridor.off_centre(np.float64(row[0]), np.float64(0.0)))
    return rows


def at_margins(model: mujoco.MjModel, rows: np.ndarray, coordinate: int, low: float, high: float) -> np.ndarray:
    """The rows, and each once more, a tenth of a micrometre before and behind where the contacts change in number.

    Args:
      coordinate: of qpos, between `low` (some contact) and `high` (none, or others).
    """
    data, out = mujoco.MjData(model), []

    def contacts(row: np.ndarray, place: float) -> int:
        data.qpos[:] = row[: model.nq]
        data.qpos[coordinate] = place
        mujoco.mj_forward(model, data)
        return data.ncon

    for row in rows:
        near, far, number = low, high, contacts(row, high)
        for _ in range(50):
            middle = (near + far) / 2
            near, far = (near, middle) if contacts(row, middle) == number else (middle, far)
        for place in (near - 1e-7, far + 1e-7):
            out.append(np.r_[row[:coordinate], place, row[coordinate + 1 :]])
    return np.array(out)


def at_floor_margins(model: mujoco.MjModel, count: int) -> np.ndarray:
    """States to either side of where the first contact with the floor appears."""
    return at_margins(model, anywhere(model, count, 1.0, 1.0), 2 if model.jnt_type[0] == 0 else 1, -3.0, 6.0)


def at_wall_margins(model: mujoco.MjModel, count: int) -> np.ndarray:
    """Ants in the air, to either side of where the first contact with a wall appears."""
    rows = anywhere(model, count, 1.2, 1.2)
    rows[:, 0] = np.random.default_rng(3).uniform(-15, 15, count)
    return np.concatenate([at_margins(model, rows[k : k + 1], 1, *_across(rows[k, 0])) for k in range(count)])


def _across(x: float) -> tuple[float, float]:
    """y behind the left wall's line and in the middle of the corridor."""
    middle = -float(corridor.off_centre(np.float64(x), np.float64(0.0)))
    return middle + 5.2, middle


@functools.cache
def states(robot: str, kind: str, full: bool = False) -> np.ndarray:
    """States of a kind of a robot; many if `full`."""
    model, substeps = model_of(robot)
    if kind == "visited":
        return visited(model, substeps, 600 if full else 100)
    if kind == "margins":
        return at_floor_margins(model, 100 if full else 20)
    if kind == "walls":
        return at_walls(model, 600 if full else 150)
    if kind == "walls' margins":
        return at_wall_margins(model, 100 if full else 20)
    low, high = {"random": (0.3, 1.5), "on the ground": (0.02, 0.3)}[kind]
    return anywhere(model, 300 if full else 60, low, high)


KINDS = ("visited", "random", "on the ground", "margins")


def kinds(robot: str) -> tuple[str, ...]:
    """Kinds of states that tell something of a robot."""
    if robot == "swimmer":  # which touches nothing
        return KINDS[:2]
    return ("walls", "walls' margins", *KINDS) if robot == "walls" else KINDS


@functools.cache
def answers(robot: str, kind: str, full: bool = False, acceleration: bool = False) -> Rows:
    """What C makes of `states`: a control step, or the states' own acceleration, and what is read then."""
    model, substeps = model_of(robot)
    return by_c(model, states(robot, kind, full), 0 if acceleration else substeps, readout_of(model))


# ---------------------------------------------------------------------------------------------------------------------
# What holds for the batches of every engine's step


def assert_same(a: Any, b: Any) -> None:
    """Two pytrees have the same bits."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def assert_batches_agree(step: Callable[..., Any], state: Any, ctrl: Any) -> None:
    """Six worlds step alike in one batch, in nested ones, with one control for all of them, and alone."""
    flat = jax.jit(jax.vmap(step))(state, ctrl)
    nested = jax.jit(jax.vmap(jax.vmap(step)))(*jax.tree.map(lambda x: x.reshape(2, 3, -1), (state, ctrl)))
    assert_same(flat, jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), nested))
    shared = jax.jit(jax.vmap(step, in_axes=(0, None)))(state, ctrl[0])
    assert_same(shared, jax.jit(jax.vmap(step))(state, jnp.tile(ctrl[0], (6, 1))))
    assert_same(step(*jax.tree.map(lambda x: x[0], (state, ctrl))), jax.tree.map(lambda x: x[0], flat))
