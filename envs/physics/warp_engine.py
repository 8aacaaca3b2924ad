"""The `warp` engine: MuJoCo-Warp, for NVIDIA GPUs."""

# mujoco is a binary module without stubs:
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import inspect
import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from . import warp_kernels
from .contract import PhysicsState, Readout, Remade, flattened, needs_post_constraint, rest_state
from .mjx_patches import import_mjx


class WarpEngine(Remade):
    """MuJoCo-Warp, whose kernels of a whole control step are one CUDA graph.

    MJX would make a foreign call of every substep and hand all of MuJoCo's arrays from one to the next. Here these
    arrays stay in Warp, and XLA sees the state, the controls and the readouts. Sums are atomic: runs do not repeat to
    the last bit. Buffers are sized by the model (`room`) and the batch, and every step reports whether they sufficed.
    """

    name = "warp"

    def __init__(self, model: mujoco.MjModel, substeps: int, readout: Readout, contacts: int | None = None):
        import_mjx()  # it brings MuJoCo-Warp, and prints where Warp is missing
        _quieten()
        from . import warp_contacts

        warp_contacts.install()
        self._c_model, self._substeps, self._readout = model, substeps, dict(readout)
        self._contacts, self._rows = room(model, contacts)
        self._held: dict[tuple[str, int], tuple[Any, Any]] = {}  # Warp's model and data, by device and batch
        self._call: Any = None
        self._stepping = threading.Lock()  # devices may call at once, and the CPU's share their data

    def start(self) -> PhysicsState:
        return rest_state(self._c_model)

    def step(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        # Controls that a scan takes straight from its inputs reached Warp as an illegal address (jax 0.11.2, H200;
        # computed ones did not): XLA hands such slices to a foreign call without a copy. Beyond mjMAXVAL nothing is
        # simulated anyway.
        ctrl = jnp.clip(ctrl, -mujoco.mjMAXVAL, mujoco.mjMAXVAL)
        single = jax.tree.map(lambda x: x[None], (state, ctrl))
        return jax.tree.map(lambda x: x[0], flattened(self._step_all)(*single))

    def _step_all(self, state: PhysicsState, ctrl: jax.Array) -> tuple[PhysicsState, dict[str, jax.Array]]:
        """One control step of a batch: all arrays have a leading [B]."""
        data = self._hold(len(ctrl))
        outputs = {name: getattr(data, name) for name in self._fields()}
        if self._call is None:
            self._call = _foreign(self._advance, _INPUTS, outputs)
        given = [x.astype(jnp.float32) for x in (state.qpos, state.qvel, state.warmstart, ctrl)]
        results = self._call(*given, output_dims={f"new_{name}": array.shape for name, array in outputs.items()})
        after = dict(zip(outputs, results, strict=True))
        out = {name: after[field][:, index] for name, (field, index) in self._readout.items()}
        out["overflow"] = ((after["overflow"] & _LOST) != 0).astype(jnp.float32)
        return PhysicsState(after["qpos"], after["qvel"], after["qacc_warmstart"]), out

    def _fields(self) -> tuple[str, ...]:
        """The arrays of Warp's data that a step returns."""
        read = (field for field, _ in self._readout.values())
        return tuple(dict.fromkeys(("qpos", "qvel", "qacc_warmstart", "overflow", *read)))

    def _hold(self, batch: int) -> Any:
        """Warp's data for a batch on the devices that may step it; none can be made while a graph is captured."""
        import warp

        devices = warp_kernels.devices()
        for device in devices:
            if (device.alias, batch) not in self._held:
                with warp.ScopedDevice(device):
                    self._held[device.alias, batch] = self.worlds(batch)
        return self._held[devices[0].alias, batch][1]

    def worlds(self, batch: int) -> tuple[Any, Any]:
        """Warp's model, and its data for so many worlds, on Warp's current device."""
        from mujoco.mjx.third_party import mujoco_warp

        model = mujoco_warp.put_model(self._c_model)
        model.opt.warn_overflow = 0  # it would print from inside the kernels
        model.opt.tolerance.fill_(self._c_model.opt.tolerance)  # Warp would raise it to 1e-6
        model.ncam = model.nlight = 0  # unused here, and each costs a kernel a stage
        # Warp keeps the contacts of all worlds in one buffer, so its size depends on the batch.
        size = self._contacts * batch
        return model, mujoco_warp.make_data(self._c_model, nworld=batch, naconmax=size, njmax=self._rows)

    def _advance(self, qpos: Any, qvel: Any, warmstart: Any, ctrl: Any, *outputs: Any) -> None:
        """One control step, in Warp's arrays of the batch; on a GPU it is captured as a graph."""
        import warp
        from mujoco.mjx.third_party import mujoco_warp

        model, data = self._held[ctrl.device.alias, ctrl.shape[0]]
        with self._stepping:
            for mine, given in (
                (data.qpos, qpos),
                (data.qvel, qvel),
                (data.qacc_warmstart, warmstart),
                (data.ctrl, ctrl),
            ):
                warp.copy(mine, given)
            data.overflow.zero_()
            for substep in range(self._substeps):
                # Forces after the constraints are read at the end of a control step only; Warp works them out in each
                # of the integrator's stages, so the substeps before the last go without.
                last = substep == self._substeps - 1
                model.opt.run_rne_postconstraint = last and needs_post_constraint(self._readout)
                mujoco_warp.step(model, data)
            for name, array in zip(self._fields(), outputs, strict=True):
                warp.copy(array, getattr(data, name))

    def kernels(self) -> list[Callable[[], Any]]:
        """What `step` launches; each entry compiles a part and loads it, on any thread."""
        return warp_kernels.of_launches(self._step_one)

    def _step_one(self) -> None:
        """Launches what `step` does, for one world and without XLA; no batch changes the kernels."""
        from mujoco.mjx.third_party import mujoco_warp

        model, data = self.worlds(1)
        if model.opt.broadphase != mujoco_warp.BroadphaseType.NXN or model.nflex:
            return  # its sorts are no kernels of Warp's: they would run, on what no kernel has written
        model.opt.run_rne_postconstraint = needs_post_constraint(self._readout)
        model.opt.graph_conditional = False  # a loop in a graph asks the device when to end
        mujoco_warp.step(model, data)


_INPUTS = ("qpos", "qvel", "warmstart", "ctrl")


def _foreign(function: Callable[..., None], inputs: Sequence[str], outputs: Mapping[str, Any]) -> Any:
    """`function(*inputs, *outputs)` of Warp's arrays as one of JAX's: [B, ...] float32 in, like `outputs` out."""
    import warp

    kinds = {name: warp.array(dtype=float, ndim=2) for name in inputs}
    kinds |= {f"new_{name}": warp.array(dtype=array.dtype, ndim=array.ndim) for name, array in outputs.items()}

    def call(*arrays: Any) -> None:
        function(*arrays)

    # Warp reads names and types of the arguments from the signature.
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    parameters = [inspect.Parameter(name, kind, annotation=array) for name, array in kinds.items()]
    call.__signature__, call.__annotations__ = inspect.Signature(parameters), kinds
    # Warp captures the graph: XLA's own captures take no loops, which the solver has.
    mode = warp.JaxCallableGraphMode.WARP if warp_kernels.devices()[0].is_cuda else warp.JaxCallableGraphMode.NONE
    return warp.jax_callable(call, num_outputs=len(outputs), graph_mode=mode)


def _quieten() -> None:
    """Prints Warp's lines about itself and every kernel only if this package's logger has level INFO."""
    import warp

    asked = logging.getLogger(__name__).isEnabledFor(logging.INFO)
    warp.config.log_level = warp.LOG_INFO if asked else warp.LOG_WARNING


_MOST_CONTACTS = 64  # of one world; 30 were enough for the ant, 60 for two hands
_LOST = 0b11111  # MuJoCo-Warp's overflow bits that cost contacts or constraints; the others are of solvers and sensors


def room(model: mujoco.MjModel, contacts: int | None = None) -> tuple[int, int]:
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
