"""Networks in training by CUDA kernels, on one NVIDIA GPU: a forward pass is one launch, a backward pass three.

XLA launches some tens of small kernels for them, and each takes longer to start than to compute. The weights of a
network are one vector here: `optimise.fit` steps such a vector, so that Adam is one kernel, too. See networks.cu.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import pathlib
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from ... import tasks
from ..types import Params

if TYPE_CHECKING:
    from ..networks import MLP

_SOURCE = pathlib.Path(__file__).parent / "networks.cu"
_ACTIVATIONS = ("relu", "tanh", "elu")  # in the order of networks.cu
_WIDEST = {1: 512, 4: 128}  # columns of a block's shared memory, by its tiles of rows
_TILE, _SPLIT = 16, 128  # rows of a tile, and of a share of a gradient
_THREADS, _GRADIENT_THREADS, _GRADIENT_TILE = 256, 128, 64  # of networks.cu
_AMPERE = 8.0  # compute capability
_FULL = 528  # blocks that keep a GPU busy; more of them take more rows each


@dataclasses.dataclass(frozen=True)
class _Network:
    """What a network is, but for its weights.

    Attributes:
      widths: of its input and of each layer. normed: for each layer, whether its input is normalised.
      at: where each layer's kernel, bias, scale and offset begin in the vector of all weights; 0 of what is missing.
      weights: numbers of that vector.
    """

    widths: tuple[int, ...]
    activation: str
    normed: tuple[bool, ...]
    at: tuple[tuple[int, int, int, int], ...]
    weights: int

    @property
    def layers(self) -> int:
        return len(self.widths) - 1

    def fits(self, tiles: int) -> bool:
        """Whether a block has room for so many tiles of rows."""
        return max(self.widths[1 - self.normed[0] :]) <= _WIDEST[tiles]

    def saved(self, rows: int) -> tuple[list[tuple[int, int, int]], int]:
        """Where the forward pass leaves each layer's activations, normalised input and moments, and their size."""
        sizes = []
        for layer, (width, normed) in enumerate(zip(self.widths, self.normed, strict=False)):
            sizes += [rows * width if layer else 0, rows * width * normed, 2 * rows * normed]
        return _begin(sizes, 3)

    def deltas(self, rows: int) -> tuple[list[tuple[int, int]], int]:
        """Where the backward pass leaves the gradients of a layer's outputs and of its norm's, and their size."""
        sizes = []
        for layer, normed in enumerate(self.normed):
            sizes += [rows * self.widths[layer + 1] * (layer + 1 < self.layers), rows * self.widths[layer] * normed]
        return _begin(sizes, 2)

    def header(self, rows: int, gradient: bool, tiles: int) -> str:
        """`network.h` of networks.cu for `rows` rows, `tiles` tiles of them a block."""
        kernel, bias, scale, offset = zip(*self.at, strict=True)
        saved, saved_size = self.saved(rows)
        deltas, deltas_size = self.deltas(rows)
        active, inputs, moments = zip(*saved, strict=True)
        delta, normal = zip(*deltas, strict=True)
        numbers = {"ROWS": rows, "LAYERS": self.layers, "WEIGHTS": self.weights, "TILES": tiles}
        numbers |= {"ACTIVATION": _ACTIVATIONS.index(self.activation), "SAVED": saved_size if gradient else 1}
        numbers |= {"DELTAS": deltas_size, "SPLIT_ROWS": _SPLIT, "SPLITS": -(-rows // _SPLIT)}
        numbers |= {"GRADIENT": int(gradient), "INPUT_NORM": int(self.normed[0])}
        lists = {"WIDTH": self.widths, "NORMED": self.normed, "KERNEL_AT": kernel, "BIAS_AT": bias, "SCALE_AT": scale}
        lists |= {"OFFSET_AT": offset, "ACTIVE_AT": active, "INPUT_AT": inputs, "MOMENTS_AT": moments}
        lists |= {"DELTA_AT": delta, "NORMAL_AT": normal}
        lines = [f"constexpr {_integer(number)} {name} = {number};" for name, number in numbers.items()]
        for name, x in lists.items():
            lines.append(f"constexpr {_integer(*x)} {name}[] = {{{', '.join(map(str, map(int, x)))}}};")
        return "\n".join(lines) + "\n"


def _integer(*values: int) -> str:
    """The type in C that holds the values: places in the rows of a large batch need 64 bits."""
    return "int" if max(values) < 2**31 else "long"


def _begin(sizes: list[int], together: int) -> tuple[list[Any], int]:
    """Where pieces of these sizes begin, in groups, and the size of all."""
    *begins, end = itertools.accumulate(sizes, initial=0)
    groups = [tuple(begins[k : k + together]) for k in range(0, len(begins), together)]
    return groups, max(end, 1)


@functools.cache
def available() -> bool:
    """Whether there are NVIDIA GPUs that multiply in TF32, as from Ampere on, and NVIDIA's run-time compiler."""
    if jax.default_backend() != "gpu" or tasks.gpu().obstacle() is not None:
        return False
    return float(tasks.gpu().architecture()) >= _AMPERE


def takes(module: MLP, inputs: int) -> bool:
    """Whether a block of the kernels has room for the network's rows."""
    return max(*module.hidden, module.outputs, inputs * module.input_norm) <= _WIDEST[1]


def apply(module: MLP, params: Params, x: jax.Array) -> jax.Array:
    """As `module.apply`: x [..., I] to [..., O]. Only the weights have a gradient, and no second one."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(params["params"])
    names, arrays = [tuple(key.key for key in path) for path, _ in leaves], [leaf for _, leaf in leaves]
    begins = dict(zip(names, itertools.accumulate((a.size for a in arrays), initial=0), strict=False))
    network = _network_of(module, x.shape[-1], begins, sum(a.size for a in arrays))
    weights = jnp.concatenate([a.ravel() for a in arrays])
    out: jax.Array = _network(network, weights, jax.lax.stop_gradient(x).reshape(-1, x.shape[-1]))
    return out.reshape(*x.shape[:-1], module.outputs)


def _network_of(module: MLP, inputs: int, begins: dict[tuple[str, ...], int], weights: int) -> _Network:
    widths, first = (inputs, *module.hidden, module.outputs), int(module.input_norm)
    normed = (module.input_norm, *(module.layer_norm for _ in module.hidden))
    at = []
    for layer, has_norm in enumerate(normed):
        dense, norm = f"Dense_{layer}", f"LayerNorm_{layer - 1 + first}"
        places = [(dense, "kernel"), (dense, "bias"), *([(norm, "scale"), (norm, "bias")] if has_norm else [])]
        at.append(tuple(begins[place] for place in places) + (0,) * (4 - len(places)))
    return _Network(widths, module.activation, normed, tuple(at), weights)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _network(network: _Network, weights: jax.Array, x: jax.Array) -> jax.Array:
    if not x.shape[0]:
        return jnp.zeros((0, network.widths[-1]), x.dtype)
    return _kernel(network, x.shape[0], False, "FORWARD")(weights, x)[0]


def _forward(network: _Network, weights: jax.Array, x: jax.Array) -> tuple[jax.Array, Any]:
    out, saved = _kernel(network, x.shape[0], True, "FORWARD")(weights, x)
    return out, (weights, x, saved)


def _backward(network: _Network, kept: Any, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    weights, x, saved = kept
    (deltas,) = _kernel(network, x.shape[0], True, "BACKWARD")(gradient, weights, saved)
    (shares,) = _kernel(network, x.shape[0], True, "WEIGHT_GRADIENTS")(gradient, x, saved, deltas)
    (total,) = _kernel(network, x.shape[0], True, "SUM")(shares)
    return total, jnp.zeros_like(x)


_network.defvjp(_forward, _backward)


@functools.cache
def _kernel(network: _Network, rows: int, gradient: bool, part: str, tiles: int = 1) -> Any:
    gpu = tasks.gpu()
    header = network.header(rows, gradient, tiles)
    ptx = gpu.ptx(f"#define {part}\n{_SOURCE.read_text()}", {"network.h": header}, "the networks")
    splits = -(-rows // _SPLIT)
    if part == "SUM":
        return gpu.Kernel("mlp_sum", ptx, ((network.weights,),), 2, -(-network.weights // _THREADS), _THREADS)
    if part == "WEIGHT_GRADIENTS":
        pieces = (-(-i // _GRADIENT_TILE) * -(-o // _GRADIENT_TILE) for i, o in itertools.pairwise(network.widths))
        blocks = splits * sum(count + 1 for count in pieces)
        return gpu.Kernel("mlp_gradients", ptx, ((splits, network.weights),), 2, blocks, _GRADIENT_THREADS)
    blocks, crowded = -(-rows // (_TILE * tiles)), None
    if tiles == 1 and network.fits(4):
        crowded = (_FULL, _kernel(network, rows, gradient, part, 4))
    if part == "FORWARD":
        results = ((rows, network.widths[-1]), (network.saved(rows)[1] if gradient else 1,))
        return gpu.Kernel("mlp_forward", ptx, results, 1, blocks, _THREADS, crowded=crowded)
    return gpu.Kernel("mlp_backward", ptx, ((network.deltas(rows)[1],),), 2, blocks, _THREADS, crowded=crowded)
