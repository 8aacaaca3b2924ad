"""Networks in training by compiled code: what XLA computes, to rounding, in half the time.

On NVIDIA GPUs it is CUDA (gpu.py); what follows is for CPUs with a C++ compiler.

XLA's products of small matrices and its many passes over the rows between them cost more than the arithmetic. Here a
network's forward pass, its backward pass and Adam's step are a call each (mlp.cpp), over the threads of XLA's pool. So
are all steps of a recurrent unit (gru.h). The loss between them is JAX as ever, so any loss will do. A network's
numbers depend neither on the number of threads nor on what is fitted next to it. Where nothing compiles, or the rows of
a network are split over devices, XLA does it all.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import pathlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from ... import tasks
from .. import sharding
from ..types import Params
from . import gpu

if TYPE_CHECKING:
    from ..networks import MLP

HERE = pathlib.Path(__file__).parent
ACTIVATIONS = ("relu", "tanh", "elu")  # in the order of activations.h
MOST_LAYERS, MOST_LEAVES = 16, 80  # of mlp.h and adam.h
_ALIGNED, _CHUNK, _PART = 16, 48, 4096  # of matmul.h, mlp.h and adam.h
_F32 = jnp.float32


@dataclasses.dataclass(frozen=True)
class _Shape:
    """What a network is, but for its weights; `widths` of its input and of each layer."""

    widths: tuple[int, ...]
    activation: str
    layer_norm: bool
    input_norm: bool
    through: bool  # whether the input has a gradient, too

    @property
    def attributes(self) -> dict[str, np.int64]:
        numbers = {"layers": len(self.widths) - 1, "activation": ACTIVATIONS.index(self.activation)}
        numbers |= {name: int(getattr(self, name)) for name in ("layer_norm", "input_norm", "through")}
        return {name: np.int64(number) for name, number in numbers.items()}

    @property
    def packed(self) -> int:
        """Numbers of the weights as the passes read them (`Packed` in mlp.h)."""
        layers = zip(self.widths, self.widths[1:], strict=False)
        return sum(i * _wide(o) + o * _wide(i) + _wide(o) + 3 * _wide(i) for i, o in layers)

    def saved(self, rows: int) -> int:
        """Numbers that the forward pass leaves to the backward pass (`Saved` in mlp.h)."""
        size = self.packed + rows * _wide(self.widths[-1])
        for layer, inputs in enumerate(self.widths[:-1]):
            copies = 2 if (self.layer_norm if layer else self.input_norm) else 1
            size += copies * rows * _wide(inputs) + _wide(2 * rows)
        return size

    def scratch(self, rows: int) -> int:
        """Numbers that the backward pass needs for itself (`Deltas` in mlp.h)."""
        chunks, size = -(-rows // _CHUNK), rows * _wide(self.widths[0]) if self.input_norm or self.through else 0
        for inputs, outputs in zip(self.widths, self.widths[1:], strict=False):
            size += (rows + chunks) * _wide(outputs) + 2 * chunks * _wide(inputs)
        return size


def _wide(width: int) -> int:
    return -(-width // _ALIGNED) * _ALIGNED


def available() -> bool:
    """Whether what is traced now can call the code: on one CPU device, where it compiles, or on one NVIDIA GPU."""
    if not sharding.single_device():
        return False
    return gpu.available() or on_cpu()


def on_cpu() -> bool:
    """Whether there is code for this CPU, also of recurrent units and of Adam."""
    return jax.default_backend() == "cpu" and function_names() is not None


@functools.cache
def function_names() -> list[str] | None:
    """The functions' names in XLA; None where no compiler makes them."""
    native = tasks.native()
    headers = (HERE / name for name in ("activations.h", "adam.h", "gru.h", "matmul.h", "mlp.h", "passes.h"))
    shared = (native.HEADER.parent / "physics" / "fused" / "vector.h", native.HEADER)
    functions = ("mlp_forward", "mlp_backward", "adam_step", "gru_forward", "gru_backward")
    code = native.Code("mlp", "the networks", (HERE / "mlp.cpp", *headers, *shared), functions, (), ("REAL=float",))
    try:
        return native.targets(code)
    except native.NoLibrary as error:
        native.announce(f"XLA computes the networks, more slowly: their own code {error}")
        return None


def _call(which: int, results: Sequence[Any], **options: Any) -> Callable[..., Any]:
    targets = function_names()
    assert targets is not None
    return jax.ffi.ffi_call(targets[which], results, vmap_method="broadcast_all", **options)


# -- networks --


def apply(module: MLP, params: Params, x: jax.Array, through: bool = False) -> jax.Array:
    """As `module.apply`: x [..., I] to [..., O]. Weights have a gradient, x if `through`, and no second one."""
    layers, last = params["params"], len(module.hidden)
    if last >= MOST_LAYERS or (gpu.available() and (through or not gpu.takes(module, x.shape[-1]))):
        return module.apply(params, x)  # pyright: ignore[reportReturnType] (flax types apply as Any or a tuple)
    if gpu.available():
        return gpu.apply(module, params, x)
    norms = [layers[f"LayerNorm_{i}"] for i in range(sum(name.startswith("LayerNorm") for name in layers))]
    first = [norms.pop(0)] if module.input_norm else []
    weights = [norm[name] for norm in first for name in ("scale", "bias")]
    for i in range(last + 1):
        weights += [layers[f"Dense_{i}"]["kernel"], layers[f"Dense_{i}"]["bias"]]
        weights += [norms[i][name] for name in ("scale", "bias")] if module.layer_norm and i < last else []
    widths = (x.shape[-1], *module.hidden, module.outputs)
    shape = _Shape(widths, module.activation, module.layer_norm, module.input_norm, through)
    x = x if through else jax.lax.stop_gradient(x)
    out: jax.Array = _network(shape, weights, x.reshape(-1, x.shape[-1]))
    return out.reshape(*x.shape[:-1], module.outputs)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _network(shape: _Shape, weights: list[jax.Array], x: jax.Array) -> jax.Array:
    return _outputs(shape, weights, x, shape.packed)[0]


def _outputs(shape: _Shape, weights: list[jax.Array], x: jax.Array, memory: int) -> list[jax.Array]:
    results = [jax.ShapeDtypeStruct(size, _F32) for size in ((x.shape[0], shape.widths[-1]), (memory,))]
    return _call(0, results)(x, *weights, **shape.attributes)


def _forward(shape: _Shape, weights: list[jax.Array], x: jax.Array) -> tuple[jax.Array, Any]:
    out, saved = _outputs(shape, weights, x, shape.saved(x.shape[0]))
    return out, (weights, saved, x)


def _backward(shape: _Shape, kept: Any, gradient: jax.Array) -> tuple[list[jax.Array], jax.Array]:
    weights, saved, x = kept
    results = [jax.ShapeDtypeStruct(w.shape, _F32) for w in (*weights, *([x] if shape.through else []))]
    results.append(jax.ShapeDtypeStruct((shape.scratch(x.shape[0]),), _F32))
    *gradients, _ = _call(1, results)(gradient, saved, *weights, **shape.attributes)
    return gradients[: len(weights)], gradients[-1] if shape.through else jnp.zeros_like(x)


_network.defvjp(_forward, _backward)


# -- the gated recurrent unit --


def unroll(gates: jax.Array, hidden: jax.Array, done: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    """As `gru.unroll`, all steps in one call. Gates, kernel and bias have one gradient, hidden states have none."""
    steps, between = gates.shape[1], gates.shape[2:-1]  # between: agents

    def whole(x: jax.Array) -> jax.Array:  # [B, T, ..., I] as sequences [R, T, I]
        return jnp.moveaxis(x, 1, -2).reshape(-1, steps, x.shape[-1])

    going = jnp.broadcast_to(~done[(...,) + (None,) * len(between)], gates.shape[:-1])[..., None]
    flat = hidden.reshape(-1, hidden.shape[-1])
    states = _sequences(whole(gates), jax.lax.stop_gradient(flat), whole(going.astype(_F32))[..., 0], kernel, bias)
    return jnp.moveaxis(states.reshape(gates.shape[0], *between, steps, -1), -2, 1)


@jax.custom_vjp
def _sequences(gates: jax.Array, hidden: jax.Array, going: jax.Array, kernel: jax.Array, bias: jax.Array) -> jax.Array:
    return _states(0, gates, hidden, going, kernel, bias)[0]


def _states(saved: int, gates: jax.Array, hidden: jax.Array, *others: jax.Array) -> list[jax.Array]:
    width, rows = hidden.shape[-1], gates.shape[:2]
    sizes = ((*rows, width), (*rows, saved), (3 * width * _wide(width),))
    return _call(3, [jax.ShapeDtypeStruct(size, _F32) for size in sizes])(gates, hidden, *others)


def _sequences_forward(
    gates: jax.Array, hidden: jax.Array, going: jax.Array, kernel: jax.Array, bias: jax.Array
) -> tuple[jax.Array, Any]:
    states, saved, _ = _states(4 * hidden.shape[-1], gates, hidden, going, kernel, bias)
    return states, (states, saved, hidden, going, kernel)


def _sequences_backward(kept: Any, gradient: jax.Array) -> tuple[jax.Array, ...]:
    states, _, hidden, going, kernel = kept
    width, rows = hidden.shape[-1], states.shape[:2]
    scratch = (3 * width + 4 * rows[0] * rows[1]) * _wide(width)
    sizes = ((*rows, 3 * width), kernel.shape, (width,), (scratch,))
    results = [jax.ShapeDtypeStruct(size, _F32) for size in sizes]
    gates, kernel, bias, _ = _call(4, results)(gradient, *kept)
    return gates, jnp.zeros_like(hidden), jnp.zeros_like(going), kernel, bias


_sequences.defvjp(_sequences_forward, _sequences_backward)


# -- Adam --


def steps_vectors() -> bool:
    """Whether a network's weights are best one vector while it is fitted: Adam is then one kernel of a GPU."""
    return available() and gpu.available()


def takes(params: Params) -> bool:
    """Whether `adam` can step these weights."""
    leaves = jax.tree.leaves(params)
    return on_cpu() and len(leaves) <= MOST_LEAVES and all(x.dtype == _F32 and x.size for x in leaves)


def adam(
    params: Params, opt_state: Any, gradient: Params, learning_rate: jax.Array | float, bound: jax.Array | float
) -> tuple[Params, Any, jax.Array]:
    """Weights and state after a step of Adam along the gradient, scaled down to the norm `bound`, and that norm."""
    leaves, structure = jax.tree.flatten(params)
    count = len(leaves)
    parts = sum(-(-math.prod(x.shape) // _PART) for x in leaves)
    scalars = [jax.ShapeDtypeStruct((), jnp.int32), jax.ShapeDtypeStruct((), _F32)]
    results = [jax.ShapeDtypeStruct(x.shape, _F32) for x in leaves] * 3
    in_place = {3 + k: k for k in range(3 * count)}
    given = [*leaves, *jax.tree.leaves(opt_state.mu), *jax.tree.leaves(opt_state.nu), *jax.tree.leaves(gradient)]
    limits = (jnp.asarray(learning_rate, _F32), jnp.asarray(bound, _F32), opt_state.count)
    call = _call(2, [*results, *scalars, jax.ShapeDtypeStruct((parts,), _F32)], input_output_aliases=in_place)
    *new, steps, norm, _ = call(*limits, *given)
    params, mu, nu = (jax.tree.unflatten(structure, new[k * count : (k + 1) * count]) for k in range(3))
    return params, opt_state._replace(count=steps, mu=mu, nu=nu), norm
