"""The `warp` engine: MJX with the MuJoCo-Warp implementation, for NVIDIA GPUs."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from . import warp_kernels
from .contract import PhysicsState, Readout, needs_post_constraint, rest_state
from .mjx_engine import load_state, read_state
from .mjx_patches import import_mjx


class WarpEngine:
    """MJX with the MuJoCo-Warp implementation. Its sums are atomic: runs do not repeat to the last bit.

    Buffers are sized by the model (`_room`) and the batch, and every step reports whether they were large enough.
    """

    name = "warp"

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout, contacts: int | None = None):
        mjx = import_mjx()
        _quieten()
        self._c_model, self._substeps, self._readout = model, substeps, dict(readout)
        self._contacts, self._rows = _room(model, contacts)
        settings = {"opt._impl.warn_overflow": 0}  # it would print from inside the kernels
        settings |= {"ncam": 0, "nlight": 0}  # unused here, and each costs a kernel a stage
        self._model = _constant(lambda: mjx.put_model(model, impl="warp").tree_replace(settings))
        # Forces after the constraints are read at the end of a control step only; Warp works them out in each of the
        # integrator's stages, so the substeps before the last go without.
        forces = {"opt._impl.run_rne_postconstraint": needs_post_constraint(readout)}
        self._last_model = self._model.tree_replace(forces)
        warp_kernels.engines.add(self)

    def start(self) -> PhysicsState:
        return rest_state(self._c_model)

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        # Controls that a scan takes straight from its inputs reached Warp as an illegal address (jax 0.11.2, H200;
        # computed ones did not): XLA hands such slices to a foreign call without a copy. Beyond mjMAXVAL nothing is
        # simulated anyway.
        ctrl = jnp.clip(ctrl, -mujoco.mjMAXVAL, mujoco.mjMAXVAL)
        single = jax.tree.map(lambda x: x[None], (state, ctrl))
        return jax.tree.map(lambda x: x[0], _flattened(self._step_all)(*single))

    def _step_all(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        """One control step of a batch: all arrays have a leading [B]."""
        mjx = import_mjx()
        data = self._make_data(len(ctrl))

        def one(state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
            own = load_state(data, state, ctrl)
            for _ in range(self._substeps - 1):
                own = mjx.step(self._model, own)
            own = mjx.step(self._last_model, own)
            after, out = read_state(own, self._readout)
            lost = (own._impl.overflow & _LOST) != 0
            return after, out | {"overflow": lost.astype(after.qpos.dtype)}

        return jax.vmap(one)(state, ctrl)

    def rehearse(self) -> None:
        """The launches of `step` for one world, without XLA; no batch changes them. See `warp_kernels`."""
        from mujoco.mjx.third_party import mujoco_warp

        model = mujoco_warp.put_model(self._c_model)
        if model.opt.broadphase != mujoco_warp.BroadphaseType.NXN or model.nflex:
            return  # its sorts are no kernels of Warp's: they would run, on what no kernel has written
        model.opt.warn_overflow, model.ncam, model.nlight = False, 0, 0
        model.opt.run_rne_postconstraint = needs_post_constraint(self._readout)
        model.opt.graph_conditional = False  # a loop in a graph asks the device when to end
        data = mujoco_warp.make_data(self._c_model, nworld=1, naconmax=self._contacts, njmax=self._rows)
        mujoco_warp.step(model, data)

    def _make_data(self, batch: int) -> Any:
        """Warp keeps the contacts of all worlds in one buffer, so its size depends on the batch."""
        mjx = import_mjx()
        size = self._contacts * batch
        data = _constant(lambda: mjx.make_data(self._c_model, impl="warp", naconmax=size, njmax=self._rows))

        def slim(leaf: Any) -> Any:  # the empty buffers are uniform: keep them out of the program's constants
            large = leaf.ndim > 0 and leaf.shape[0] == size and size > 1
            return jnp.broadcast_to(leaf[:1], leaf.shape) if large else leaf

        return jax.tree.map(slim, data)


def _quieten() -> None:
    """Prints Warp's lines about itself and every kernel only if this package's logger has level INFO."""
    import warp

    asked = logging.getLogger(__name__).isEnabledFor(logging.INFO)
    warp.config.log_level = warp.LOG_INFO if asked else warp.LOG_WARNING


def _constant(make: Callable[[], Any]) -> Any:
    """What `make` builds of JAX arrays, as NumPy's, wherever it is called from.

    MJX reads its arrays' shapes per shard, which are undefined inside a `shard_map`, so `make` runs outside of any
    mesh. An array that lies on one device cannot be a constant of a program for several.
    """
    with jax.ensure_compile_time_eval(), jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
        return jax.tree.map(np.asarray, make())


def _flattened(batched: Any) -> Any:
    """A function of arrays with a leading [B] for which `vmap`, however nested, only makes B larger."""

    @jax.custom_batching.custom_vmap
    def call(*args: Any) -> Any:
        return batched(*args)

    @call.def_vmap
    def rule(axis_size: int, in_batched: Any, *args: Any) -> tuple[Any, Any]:
        def spread(leaf: jax.Array, is_batched: bool) -> jax.Array:
            leaf = leaf if is_batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(-1, *leaf.shape[2:])

        out = _flattened(batched)(*jax.tree.map(spread, args, tuple(in_batched)))
        out = jax.tree.map(lambda leaf: leaf.reshape(axis_size, -1, *leaf.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return call


_MOST_CONTACTS = 64  # of one world; 30 were enough for the ant, 60 for two hands
_LOST = 0b11111  # MuJoCo-Warp's overflow bits that cost contacts or constraints; the others are of solvers and sensors


def _room(model: mujoco.MjModel, contacts: int | None = None) -> tuple[int, int]:
    """Contacts and constraint rows that one world of the model needs at most, for so many contacts if given."""
    first, second = np.triu_indices(model.ngeom, 1)
    wanted = (model.geom_contype[first] & model.geom_conaffinity[second]) | (
        model.geom_contype[second] & model.geom_conaffinity[first]
    )
    apart = model.body_weldid[model.geom_bodyid[first]] != model.body_weldid[model.geom_bodyid[second]]
    each = np.full(mujoco.mjtGeom.mjNGEOMTYPES, 4)  # contact points of a pair, by the type with the most
    each[mujoco.mjtGeom.mjGEOM_PLANE], each[mujoco.mjtGeom.mjGEOM_SPHERE], each[mujoco.mjtGeom.mjGEOM_CAPSULE] = 0, 1, 2
    points = np.maximum(each[model.geom_type[first]], each[model.geom_type[second]])
    most = int(points[(wanted != 0) & apart].sum()) + 4 * model.npair
    contacts = contacts or max(1, min(most, _MOST_CONTACTS))
    limits = int(model.jnt_limited.sum() + model.tendon_limited.sum())
    dry = int((model.dof_frictionloss > 0).sum() + (model.tendon_frictionloss > 0).sum())
    return contacts, 2 * (int(model.geom_condim.max()) - 1) * contacts + limits + dry + 6 * model.neq
