"""Trained policies as files that need neither pmt_jax nor, with the NumPy loader, JAX."""

from __future__ import annotations

import inspect
import pathlib

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from ..files import writing_folder
from ..learning.maths import running_moments
from ..learning.setup import Setup
from ..learning.types import Params, RunningMoments
from . import numpy_policy, onnx_policy
from .load import load_seed, policy_function

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def export_policy(
    folder: str | pathlib.Path, out: pathlib.Path, seed: int | None = None, which: str = "last", onnx: bool = False
) -> list[str]:
    """Writes a run's policy into the folder `out`, three files or four, and returns their names:

    policy.stablehlo: `jax.export` of obs [batch, N, O] -> action [batch, N, A], f32, for CPU, CUDA, ROCm and TPU; of a
      recurrent policy (obs, hidden [batch, N, H]) -> (action, hidden), which is 0 where an episode begins;
    policy.npz: its weights; numpy_policy.py: a loader of these in NumPy alone;
    policy.onnx: with `onnx` the same function as an ONNX graph, checked by onnxruntime before anything is written.

    Raises:
      UsageError: as `load_policy`, or `out` cannot be written; the extra `onnx` is missing.
    """
    setup, _, state = load_seed(folder, seed, which, physics="auto")  # nothing will be simulated
    spec = setup.vector.spec
    memory, (batch,) = setup.nets.start(1), jax.export.symbolic_shape("batch")
    shapes = [(spec.num_agents, spec.obs_dim), *([memory.actor.shape[1:]] if memory else [])]
    program = jax.jit(jax.vmap(policy_function(setup, state)))
    inputs = [jax.ShapeDtypeStruct((batch, *shape), jnp.float32) for shape in shapes]
    exported = jax.export.export(program, platforms=PLATFORMS)(*inputs)
    named = weights(setup, state.actor.params, state.obs_moments)
    with writing_folder(out) as partial:
        (partial / "policy.stablehlo").write_bytes(exported.serialize())
        np.savez(partial / "policy.npz", **named)  # pyright: ignore[reportArgumentType] (its stub)
        (partial / "numpy_policy.py").write_text(inspect.getsource(numpy_policy))
        if onnx:
            obs, *hidden = (np.random.default_rng(0).standard_normal((64, *shape)) for shape in shapes)
            given = [np.asarray(x, np.float32) for x in (named["obs_mean"] + named["obs_scale"] * obs, *hidden)]
            onnx_policy.write(named, partial / "policy.onnx")
            onnx_policy.check(partial / "policy.onnx", given, jax.tree.leaves(jax.device_get(program(*given))))
        else:  # what an export before this one left is another policy
            (out / "policy.onnx").unlink(missing_ok=True)
    return ["policy.stablehlo", "policy.npz", "numpy_policy.py", *(["policy.onnx"] if onnx else [])]


def weights(setup: Setup, params: Params, moments: RunningMoments) -> dict[str, np.ndarray]:
    """One seed's policy as the arrays that `numpy_policy.load` reads."""
    if setup.config.obs_norm == "running":
        mean, scale, bound = running_moments.obs_scaling(moments)
    else:
        mean, scale, bound = jnp.zeros(setup.nets.obs_dim), jnp.ones(setup.nets.obs_dim), jnp.float32(jnp.inf)
    mask = setup.vector.spec.action_mask.astype(np.float32)
    named = {"obs_mean": mean, "obs_scale": scale, "obs_clip": bound, "action_mask": mask}
    named |= {"activation": np.asarray(setup.config.activation), **setup.nets.layers(params)}
    return {name: np.asarray(x) for name, x in named.items()}
