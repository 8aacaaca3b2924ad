"""The CUDA kernels of networks, compiled for a CPU: threads take turns, and a tensor core is a loop."""

from __future__ import annotations

import ctypes
import functools
import itertools
import pathlib
import re
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pmt_jax import tasks
from pmt_jax.learning.fused import gpu
from pmt_jax.learning.networks import MLP
from threads_on_cpu import COMPILER, compiled

pytestmark = [compiled, pytest.mark.full]

NETWORKS = 2
SOURCE = pathlib.Path(__file__).with_name("networks_on_cpu.cpp")
CUDA = pathlib.Path(str(gpu.__file__)).with_name("networks.cu")
PARTS = ("FORWARD", "BACKWARD", "WEIGHT_GRADIENTS", "SUM")


@pytest.fixture
def built(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch):
    """A function of a network, rows and tiles: the kernels as a library, and their numbers of blocks."""
    monkeypatch.setattr(tasks.gpu(), "ptx", lambda *_: "ptx")

    def build(network: gpu._Network, rows: int, tiles: int) -> tuple[ctypes.CDLL, list[int]]:
        (tmp_path / "network.h").write_text(network.header(rows, True, tiles))
        source, count = re.subn(r'asm\("mma.*?\);', "tensor_core(c, a, b);", CUDA.read_text(), flags=re.DOTALL)
        assert count == 1
        (tmp_path / "networks_for_cpu.cu").write_text(source)
        library = tmp_path / f"{tiles}.so"
        flags = ["-O1", "-std=c++17", "-shared", "-fPIC", "-w", f"-I{tmp_path}", *(f"-D{part}" for part in PARTS)]
        subprocess.run([str(COMPILER), *flags, str(SOURCE), "-o", str(library)], check=True)
        kernels = [gpu._kernel.__wrapped__(network, rows, True, part, tiles) for part in PARTS]
        return ctypes.CDLL(str(library)), [NETWORKS * kernel.blocks for kernel in kernels]

    return build


def expected(module: MLP, params: dict, x: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Outputs, and the gradient of their weighted sum as one vector."""

    def total(params: dict) -> jax.Array:
        return jnp.sum(weight * module.apply(params, x))  # pyright: ignore

    gradient = jax.grad(total)(params)
    return module.apply(params, x), jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(gradient)])  # pyright: ignore


def network_of(module: MLP, inputs: int, params: dict) -> gpu._Network:
    leaves, _ = jax.tree_util.tree_flatten_with_path(params["params"])
    begins = itertools.accumulate((leaf.size for _, leaf in leaves), initial=0)
    names = [tuple(key.key for key in path) for path, _ in leaves]
    return gpu._network_of(module, inputs, dict(zip(names, begins, strict=False)), sum(x.size for _, x in leaves))


@pytest.mark.parametrize(
    ("hidden", "outputs", "activation", "layer_norm", "input_norm", "inputs", "rows", "tiles"),
    [
        ((40, 24), 3, "tanh", True, False, 5, 150, 1),
        ((72,), 9, "elu", True, True, 70, 130, 4),
        ((128, 128), 4, "relu", True, False, 31, 100, 4),
        ((130,), 70, "relu", False, True, 12, 40, 1),
        ((), 2, "relu", True, False, 11, 20, 4),
    ],
)
def test_the_kernels_compute_what_xla_computes(
    built, hidden, outputs, activation, layer_norm, input_norm, inputs, rows, tiles
):
    module = MLP(hidden, outputs, 1.0, activation, layer_norm, input_norm)
    keys = jax.random.split(jax.random.key(0), NETWORKS)
    params = jax.vmap(lambda key: module.init(key, jnp.zeros(inputs)))(keys)
    params = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(jax.random.key(x.size), x.shape), params)
    network = network_of(module, inputs, jax.tree.map(lambda x: x[0], params))
    library, blocks = built(network, rows, tiles)

    def array(*shape: int) -> np.ndarray:
        return np.full((NETWORKS, *shape), np.nan, np.float32)  # what is read before it is written shows

    x, weight = (jax.random.normal(jax.random.key(k), (NETWORKS, rows, n)) for k, n in ((1, inputs), (2, outputs)))
    weights = np.concatenate([np.asarray(leaf).reshape(NETWORKS, -1) for leaf in jax.tree.leaves(params)], 1)
    out, saved, deltas = array(rows, outputs), array(network.saved(rows)[1]), array(network.deltas(rows)[1])
    shares, gradient = array(-(-rows // gpu._SPLIT), network.weights), array(network.weights)
    calls = {"forward": (weights, x, out, saved), "backward": (weight, weights, saved, deltas)}
    calls |= {"gradients": (weight, x, saved, deltas, shares), "sum": (shares, gradient)}
    for (name, arrays), count in zip(calls.items(), blocks, strict=True):
        held = [np.ascontiguousarray(each, np.float32) if isinstance(each, jax.Array) else each for each in arrays]
        getattr(library, name)(count, *(each.ctypes.data_as(ctypes.c_void_p) for each in held))
    with jax.default_matmul_precision("highest"):
        right = jax.vmap(functools.partial(expected, module))(params, x, weight)
    for found, exact in zip((out, gradient), right, strict=True):
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-5 * float(np.abs(exact).max()))


def test_places_in_a_batch_of_many_rows_have_64_bits(tmp_path: pathlib.Path):
    module = MLP((128, 128), 1, 1.0, "relu", True, False)
    params = jax.eval_shape(module.init, jax.random.key(0), jnp.zeros(29))
    for rows, kind in ((2**20, "int"), (2**22, "long")):
        header = network_of(module, 29, params).header(rows, False, 1)
        assert f"constexpr {kind} MOMENTS_AT[]" in header and f"constexpr int ROWS = {rows};" in header
        (tmp_path / "network.cpp").write_text(header)  # which does not narrow a number
        subprocess.run([str(COMPILER), "-fsyntax-only", "-std=c++17", str(tmp_path / "network.cpp")], check=True)
