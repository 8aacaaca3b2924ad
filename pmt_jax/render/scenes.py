"""An episode of MuJoCo bodies as scenes: geoms in space, moment by moment; only films of them need OpenGL."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from . import gl
from .episode import Episode, to_base64

POSE_FIELDS = ("qpos", "mocap_pos", "mocap_quat")
DECORATIONS = 1000  # geoms that an environment may append
SMOOTHING = 21  # moments over which the view's centre is averaged
KINDS = {"PLANE": "plane", "SPHERE": "ellipsoid", "ELLIPSOID": "ellipsoid", "CAPSULE": "capsule"}
KINDS |= {"CYLINDER": "cylinder", "BOX": "box"}
_SHAPES = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")): kind for name, kind in KINDS.items()}


def scenes(episode: Episode) -> Iterator[mujoco.MjvScene]:
    """The scene of each moment, decorated by the environment; the same object each time, so use it before the next."""
    model: mujoco.MjModel = episode.picture.model
    data, option, view = mujoco.MjData(model), mujoco.MjvOption(), camera(model)
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + DECORATIONS)
    for t in range(len(episode)):
        raw = episode.at(t)
        for name in POSE_FIELDS:
            if name in raw:
                getattr(data, name)[:] = raw[name]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mjv_updateScene(model, data, option, None, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
        episode.picture.decorate(scene, raw, float(episode.cost[t]))
        yield scene


def camera(model: mujoco.MjModel) -> mujoco.MjvCamera:
    """The model's first camera, or MuJoCo's default view of the whole if it has none."""
    view = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, view)
    if model.ncam:
        view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    return view


def tracks(episode: Episode) -> dict[str, Any]:
    """What the replay page draws: G geoms over T moments, as plain data for JSON.

    Returns:
      kinds: [G] plane, ellipsoid, capsule, cylinder or box (others, meshes for one, are left out); pose [T, G, 7]
      (position, quaternion), size [T, G, 3], rgba [T, G, 4], each packed by `pack`; centre: [T, 3], what moves, for
      the view to follow; eye: [3] the camera seen from the first centre; fovy in degrees.
    """
    slots: dict[tuple[Any, ...], int] = {}
    moments = []
    eye = np.zeros(3)
    for t, scene in enumerate(scenes(episode)):
        moments.append(_geoms(scene, slots))
        if t == 0:
            eye = np.mean([np.array(c.pos) for c in scene.camera], axis=0)
    pose, size, rgba = (_table(moments, len(slots), slice(*ends)) for ends in ((0, 7), (7, 10), (10, 14)))
    rgba[np.isnan(rgba)] = 0  # a geom that is not there is drawn as invisible
    for x in (pose, size):
        x[:] = np.where(np.isnan(x), np.nanmean(x, axis=0), x)
    centre = _centre(pose)
    return {
        "kinds": [key[1] for key in slots],
        "pose": pack(pose),
        "size": pack(size),
        "rgba": pack(np.round(255 * rgba).astype(np.uint8)),
        "centre": to_base64(centre),
        "eye": [round(float(x), 4) for x in eye - centre[0]],
        "fovy": _field_of_view(episode),
    }


def _geoms(scene: mujoco.MjvScene, slots: dict[tuple[Any, ...], int]) -> dict[int, np.ndarray]:
    """{slot: [14] pose, size, rgba} of a scene; a geom keeps its slot, a decoration is known by kind and count."""
    found: dict[int, np.ndarray] = {}
    decorations = dict.fromkeys(KINDS.values(), 0)
    quaternion = np.zeros(4)
    for geom in scene.geoms[: scene.ngeom]:
        kind = _SHAPES.get(geom.type)
        if kind is None:
            continue
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid >= 0:
            key = ("geom", kind, geom.objid)
        else:
            key = ("decoration", kind, decorations[kind])
            decorations[kind] += 1
        mujoco.mju_mat2Quat(quaternion, np.asarray(geom.mat, np.float64).reshape(9))
        found[slots.setdefault(key, len(slots))] = np.concatenate([geom.pos, quaternion, geom.size, geom.rgba])
    return found


def _table(moments: list[dict[int, np.ndarray]], count: int, columns: slice) -> np.ndarray:
    """[T, G, columns], nan where a geom is not there."""
    table = np.full((len(moments), count, columns.stop - columns.start), np.nan, np.float32)
    for row, found in zip(table, moments, strict=True):
        for slot, values in found.items():
            row[slot] = values[columns]
    return table


def _centre(pose: np.ndarray) -> np.ndarray:
    """[T, 3] the mean place of what moves, without its tremble."""
    moving = np.ptp(pose[..., :3], axis=0).max(-1) > 1e-6
    place = pose[:, moving, :3].mean(1) if moving.any() else np.zeros((len(pose), 3))
    half = min(SMOOTHING, len(place)) // 2
    padded = np.pad(place, ((half, half), (0, 0)), mode="edge")
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    return np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], axis=1)


def _field_of_view(episode: Episode) -> float:
    model = episode.picture.model
    return float(model.cam_fovy[0] if model.ncam else model.vis.global_.fovy)


def pack(x: np.ndarray) -> dict[str, Any]:
    """[T, G, d] as its first moment and, for the rows of G that ever change, all moments."""
    moves = (x != x[:1]).any(axis=(0, 2))
    return {
        "width": x.shape[2],
        "first": to_base64(x[0]),
        "moving": np.flatnonzero(moves).tolist(),
        "frames": to_base64(x[:, moves]),
    }


def frames(episode: Episode, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """[height, width, 3] pictures of an episode's moments, drawn by MuJoCo.

    Raises:
      UsageError: no OpenGL works here.
    """
    platform = gl.choose()
    model = episode.picture.model
    width, height = size
    window = importlib.import_module(f"mujoco.{platform}").GLContext(width, height)
    window.make_current()
    before = model.vis.global_.offwidth, model.vis.global_.offheight
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    model.vis.global_.offwidth, model.vis.global_.offheight = before
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    area = mujoco.MjrRect(0, 0, width, height)
    picture = np.zeros((height, width, 3), np.uint8)
    try:
        for scene in scenes(episode):
            mujoco.mjr_render(area, scene, context)
            mujoco.mjr_readPixels(picture, None, area, context)
            yield picture[::-1]
    finally:
        context.free()
        window.free()
