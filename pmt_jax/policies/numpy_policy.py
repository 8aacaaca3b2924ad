"""An exported team policy in NumPy alone; this file needs nothing else and may be copied anywhere.

Examples:
  policy = load("policy.npz")
  action = policy(obs)  # obs [..., N, O] as the environment gives them -> mean action [..., N, A]

  action, hidden = policy(obs)  # of a recurrent policy, where an episode begins
  action, hidden = policy(obs, hidden)  # and later; hidden [..., N, H]
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "relu": lambda x: np.maximum(x, 0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}


def load(path: str | os.PathLike[str]) -> Callable[..., Any]:
    """The policy in `path`: obs [..., N, O] -> mean action [..., N, A].

    A recurrent one is (obs, hidden [..., N, H]) -> (action, hidden); without `hidden` an episode begins.

    The file holds obs_mean [O], obs_scale [O], obs_clip [], activation (its name), action_mask [N, A] and for each
    layer i kernel_i [N, I, J], bias_i [N, J] and, if its input is normalised, norm_scale_i and norm_bias_i [N, I].
    A recurrent policy also has recurrent_kernel [N, H, 3H] and recurrent_bias [N, H]; its last layer but one makes what
    the input adds to the gates.
    """
    with np.load(path) as file:
        w = dict(file)
    activation = ACTIVATIONS[str(w["activation"])]
    expected = (len(w["kernel_0"]), len(w["obs_mean"]))

    def act(obs: np.ndarray, hidden: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        if np.shape(obs)[-2:] != expected:
            raise ValueError(f"this policy takes observations [..., N, O] that end in {expected}, not {np.shape(obs)}")
        x = (np.asarray(obs, np.float32) - w["obs_mean"]) / w["obs_scale"]
        x = np.clip(x, -w["obs_clip"], w["obs_clip"])
        last = sum(name.startswith("kernel_") for name in w) - 1
        for i in range(last + 1):
            if hidden is not None and i == last:
                hidden = x = _gru(x, hidden, w["recurrent_kernel"], w["recurrent_bias"])
            else:
                x = activation(x) if i else x
            if f"norm_scale_{i}" in w:
                x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + np.float32(1e-6))
                x = x * w[f"norm_scale_{i}"] + w[f"norm_bias_{i}"]
            x = np.einsum("...ni,nij->...nj", x, w[f"kernel_{i}"]) + w[f"bias_{i}"]
        return x * w["action_mask"], hidden

    def policy(obs: np.ndarray) -> np.ndarray:
        return act(obs, None)[0]

    def recurrent(obs: np.ndarray, hidden: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
        width = w["recurrent_kernel"].shape[1]
        return act(obs, np.zeros((*np.shape(obs)[:-1], width), np.float32) if hidden is None else hidden)

    return recurrent if "recurrent_kernel" in w else policy


def _gru(gates: np.ndarray, hidden: np.ndarray, kernel: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Hidden states [..., N, H] after a step: (1 - z) n + z h (see pmt_jax.learning.maths.gru)."""
    inner, both = np.einsum("...nh,nhj->...nj", hidden, kernel), 2 * hidden.shape[-1]
    opened = np.float32(0.5) * (1 + np.tanh(np.float32(0.5) * (gates + inner)))  # the sigmoid, which overflows nowhere
    reset, update = np.split(opened[..., :both], 2, -1)
    new = np.tanh(gates[..., both:] + reset * (inner[..., both:] + bias))
    return (1 - update) * new + update * hidden
