"""An exported team policy in NumPy alone; this file needs nothing else and may be copied anywhere.

Examples:
  policy = load("policy.npz")
  action = policy(obs)  # obs [..., N, O] as the environment gives them -> mean action [..., N, A]
"""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "relu": lambda x: np.maximum(x, 0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}


def load(path: str | os.PathLike[str]) -> Callable[[np.ndarray], np.ndarray]:
    """The policy in `path`: obs [..., N, O] -> mean action [..., N, A].

    The file holds obs_mean [O], obs_scale [O], obs_clip [], activation (its name), action_mask [N, A] and for each
    layer i kernel_i [N, I, J], bias_i [N, J] and, if its input is normalised, norm_scale_i and norm_bias_i [N, I].
    """
    with np.load(path) as file:
        w = dict(file)
    activation = ACTIVATIONS[str(w["activation"])]

    def policy(obs: np.ndarray) -> np.ndarray:
        x = (np.asarray(obs, np.float32) - w["obs_mean"]) / w["obs_scale"]
        x = np.clip(x, -w["obs_clip"], w["obs_clip"])
        for i in range(sum(name.startswith("kernel_") for name in w)):
            x = activation(x) if i else x
            if f"norm_scale_{i}" in w:
                x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + np.float32(1e-6))
                x = x * w[f"norm_scale_{i}"] + w[f"norm_bias_{i}"]
            x = np.einsum("...ni,nij->...nj", x, w[f"kernel_{i}"]) + w[f"bias_{i}"]
        return x * w["action_mask"]

    return policy
