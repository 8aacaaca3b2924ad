"""A team policy as an ONNX graph; needs the extra `onnx`."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ..errors import UsageError, optional

OPSET = 17  # the first with LayerNormalization
IR_VERSION = 8  # of that opset, which older runtimes read too
TOLERANCE = 1e-5  # in units of an action, and of its size beyond 1
_ACTIVATIONS = {"relu": "Relu", "tanh": "Tanh", "elu": "Elu"}
_EPSILON = 1e-6  # of layer normalisation, as in `numpy_policy`


def write(weights: dict[str, np.ndarray], out: pathlib.Path) -> None:
    """Writes obs [batch, N, O] -> action [batch, N, A], f32, as the file `out`.

    A recurrent policy also has the input `hidden` [batch, N, H] and the output `hidden_after`.

    Args:
      weights: what `export.weights` returns.

    Raises:
      UsageError: the package onnx is missing.
    """
    onnx = optional("onnx", "onnx")
    helper, floats = onnx.helper, onnx.TensorProto.FLOAT
    graph = _Graph(helper)
    bound = weights["obs_clip"]
    x = graph.add("Sub", "obs", weights["obs_mean"])
    x = graph.add("Div", x, weights["obs_scale"])
    x = graph.add("Clip", x, -bound, bound)
    x = graph.add("Transpose", x, perm=(1, 0, 2))  # [N, batch, O], so that each agent multiplies by its own kernel
    last, recurrent = sum(name.startswith("kernel_") for name in weights) - 1, "recurrent_kernel" in weights
    for i in range(last + 1):
        if recurrent and i == last:
            x = _gru(graph, x, weights["recurrent_kernel"], weights["recurrent_bias"])
        else:
            x = graph.add(_ACTIVATIONS[str(weights["activation"])], x) if i else x
        if f"norm_scale_{i}" in weights:
            ones = np.ones(weights[f"norm_scale_{i}"].shape[-1])
            x = graph.add("LayerNormalization", x, ones, axis=-1, epsilon=_EPSILON)
            x = graph.add("Mul", x, weights[f"norm_scale_{i}"][:, None])
            x = graph.add("Add", x, weights[f"norm_bias_{i}"][:, None])
        x = graph.add("MatMul", x, weights[f"kernel_{i}"])
        x = graph.add("Add", x, weights[f"bias_{i}"][:, None])
    x = graph.add("Transpose", x, perm=(1, 0, 2))
    graph.add("Mul", x, weights["action_mask"], output="action")
    agents, actions = weights["action_mask"].shape
    widths = {"obs": weights["kernel_0"].shape[1], "action": actions}
    if recurrent:
        widths |= dict.fromkeys(("hidden", "hidden_after"), weights["recurrent_kernel"].shape[1])
    ends = [helper.make_tensor_value_info(name, floats, ["batch", agents, width]) for name, width in widths.items()]
    made = helper.make_graph(graph.nodes, "policy", ends[::2], ends[1::2], graph.constants)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    onnx.checker.check_model(model, full_check=True)
    out.write_bytes(model.SerializeToString())


def _gru(graph: _Graph, gates: str, kernel: np.ndarray, bias: np.ndarray) -> str:
    """Adds `hidden_after` [batch, N, H] to the graph; the names of it and of `gates` with [N, batch, ...]."""
    before = graph.add("Transpose", "hidden", perm=(1, 0, 2))
    outer, inner = graph.split(gates, 3), graph.split(graph.add("MatMul", before, kernel), 3)
    reset, update = (graph.add("Sigmoid", graph.add("Add", outer[i], inner[i])) for i in range(2))
    kept = graph.add("Mul", reset, graph.add("Add", inner[2], bias[:, None]))
    new = graph.add("Tanh", graph.add("Add", outer[2], kept))
    after = graph.add("Add", new, graph.add("Mul", update, graph.add("Sub", before, new)))
    graph.add("Transpose", after, perm=(1, 0, 2), output="hidden_after")
    return after


def check(path: pathlib.Path, inputs: list[np.ndarray], outputs: list[np.ndarray]) -> None:
    """Runs the file by onnxruntime on `inputs`, obs [batch, N, O] and of a recurrent policy hidden [batch, N, H].

    Args:
      outputs: what it is compared with, action [batch, N, A] and of a recurrent policy the hidden state after it.

    Raises:
      UsageError: the package onnxruntime is missing, or actions differ by more than `TOLERANCE`.
    """
    runtime = optional("onnxruntime", "onnx")
    session = runtime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    found = session.run(None, dict(zip(("obs", "hidden"), inputs, strict=False)))
    pairs = zip(found, outputs, strict=True)
    apart = max(float(np.max(np.abs(x - y) / np.maximum(1.0, np.abs(y)), initial=0.0)) for x, y in pairs)
    if not apart <= TOLERANCE:
        raise UsageError(f"onnxruntime's actions differ from the policy's by {apart:.1g}; export without --onnx")


class _Graph:
    """The nodes and the constants of a graph, named in their order."""

    def __init__(self, helper: Any) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._helper = helper

    def add(self, operator: str, *inputs: str | np.ndarray, output: str | None = None, **attributes: Any) -> str:
        """Adds a node with inputs that are names of values, or constants, and returns the name of its output."""
        names = [x if isinstance(x, str) else self._constant(x) for x in inputs]
        output = output or f"value_{len(self.nodes)}"
        self.nodes.append(self._helper.make_node(operator, names, [output], **attributes))
        return output

    def split(self, x: str, parts: int) -> list[str]:
        """Adds a node that cuts the last axis of `x` into equal parts, and returns their names."""
        names = [f"value_{len(self.nodes)}_{i}" for i in range(parts)]
        self.nodes.append(self._helper.make_node("Split", [x], names, axis=-1))
        return names

    def _constant(self, x: np.ndarray) -> str:
        x = np.asarray(x, np.float32)
        name = f"constant_{len(self.constants)}"
        tensor = self._helper.make_tensor(name, 1, x.shape, x.ravel())  # 1 is a tensor of 32-bit floats
        self.constants.append(tensor)
        return name
