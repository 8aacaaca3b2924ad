"""Trained policies without the training: as a function, and as files that need neither pmt_jax nor, if wished, JAX."""

from __future__ import annotations

import inspect
import pathlib
from collections.abc import Callable

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from . import normalise, numpy_policy
from .errors import UsageError
from .folder import MATMUL_PRECISION, load_run
from .run import Run
from .types import ActingState, Moments, Params

Policy = Callable[[jax.Array], jax.Array]
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def load_policy(folder: str | pathlib.Path, seed: int | None = None, which: str = "last") -> Policy:
    """A run's team policy as a pure function, to be jitted and vmapped at will.

    Args:
      folder: the run folder, which is only read, or the name of a pretrained policy: `hub:ant_2x4/r4sg`.
      seed: one of the run's seeds; its first if None.
      which: `last`, or `best`: the seed's own best (see docs/runs.md).

    Returns:
      policy: raw observations obs [N, O] -> mean action [N, A], 0 where an agent has no such entry. Observations are
        normalised inside; the task clips actions by its own rule.

    Raises:
      UsageError: no run, no checkpoint, or no such seed.
    """
    return _policy(*_seed_of(folder, seed, which))


def export_policy(folder: str | pathlib.Path, out: pathlib.Path, seed: int | None = None, which: str = "last") -> None:
    """Writes a run's policy into the folder `out`, three files:

    policy.stablehlo: `jax.export` of obs [batch, N, O] -> action [batch, N, A], f32, for CPU, CUDA, ROCm and TPU;
    policy.npz: its weights; numpy_policy.py: a loader of these in NumPy alone.

    Raises:
      UsageError: as `load_policy`, or `out` cannot be written.
    """
    run, state = _seed_of(folder, seed, which)
    spec = run.vector.spec
    batch = jax.export.symbolic_shape(f"batch, {spec.num_agents}, {spec.obs_dim}")
    program = jax.jit(jax.vmap(_policy(run, state)))
    exported = jax.export.export(program, platforms=PLATFORMS)(jax.ShapeDtypeStruct(batch, jnp.float32))
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "policy.stablehlo").write_bytes(exported.serialize())
        np.savez(out / "policy.npz", **weights(run, state.actor.params, state.obs_moments))  # pyright: ignore[reportArgumentType] (its stub)
        (out / "numpy_policy.py").write_text(inspect.getsource(numpy_policy))
    except OSError as error:
        raise UsageError(f"cannot write into {out}: {error.strerror}; choose another folder") from None


def weights(run: Run, params: Params, moments: Moments) -> dict[str, np.ndarray]:
    """One seed's policy as the arrays that `numpy_policy.load` reads."""
    if run.config.obs_norm == "running":
        mean, scale, bound = normalise.obs_scaling(moments)
    else:
        mean, scale, bound = jnp.zeros(run.nets.obs_dim), jnp.ones(run.nets.obs_dim), jnp.float32(jnp.inf)
    mask = run.vector.spec.action_mask.astype(np.float32)
    named = {"obs_mean": mean, "obs_scale": scale, "obs_clip": bound, "action_mask": mask}
    named |= {"activation": np.asarray(run.config.activation), **run.nets.layers(params)}
    return {name: np.asarray(x) for name, x in named.items()}


def _seed_of(folder: str | pathlib.Path, seed: int | None, which: str) -> tuple[Run, ActingState]:
    run, states = load_run(pathlib.Path(folder), which, physics="auto")  # nothing will be simulated
    first, count = run.config.seed, run.config.seeds
    index = 0 if seed is None else seed - first
    if not 0 <= index < count:
        raise UsageError(f"{folder} holds seeds {first} to {first + count - 1}, not {seed}")
    return run, jax.tree.map(lambda x: x[index], states)


def _policy(run: Run, state: ActingState) -> Policy:
    mask = jnp.asarray(run.vector.spec.action_mask)

    def policy(obs: jax.Array) -> jax.Array:
        with jax.default_matmul_precision(MATMUL_PRECISION):
            mean, _ = run.nets.policies(state.actor.params, run.scale(state.obs_moments, obs))
        return mean * mask

    return policy
