"""How a run is split over devices: one mesh with the axes seed and env, and what the learner calls to use it.

Seeds exchange only metrics, so as many devices as possible share the seeds; the rest share each seed's environments.
Environments step on their own device (`per_device`): XLA's partitioner cannot look into physics engines and would give
all of them to every device. On a CPU each network is then fitted by one device (`in_parallel`). Elsewhere the
learner's rows are gathered once for each network's epochs (`replicate`), every minibatch is cut into equal parts
(`shard`), and the partitioner sums the gradients. Random numbers do not depend on the number of devices. Without a mesh
these functions return their argument, so one device runs the same program as without them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from ..config.settings import Config
from ..errors import UsageError
from .types import LearnerState

SEED, ENV = "seed", "env"
F = TypeVar("F", bound=Callable[..., Any])


def make_mesh(config: Config, count: int | None) -> Mesh | None:
    """The devices of a run as (seed, env); None if there is one.

    Args:
      count: how many, of all processes together; None takes one, or all if there are several processes.

    Raises:
      UsageError: there are fewer, or they cannot have equal parts of the seeds and environments.
    """
    present, processes = jax.devices(), jax.process_count()
    if count is None:
        count = len(present) if processes > 1 else 1
    if count > len(present):
        more = f"; XLA_FLAGS=--xla_force_host_platform_device_count={count} makes {count} of a CPU"
        raise UsageError(
            f"--devices {count}, but JAX sees {len(present)} {present[0].platform} device(s); take at most "
            f"{len(present)}{more if present[0].platform == 'cpu' and processes == 1 else ''}"
        )
    if processes > 1 and count < len(present):
        raise UsageError(
            f"--devices {count}, but the {processes} processes bring {len(present)} devices, and all take part; "
            "leave --devices out"
        )
    if count == 1:
        return None
    seeds = math.gcd(config.seeds, count)
    _check_even(config, count, seeds)
    axes = (AxisType.Auto, AxisType.Auto)
    return jax.make_mesh((seeds, count // seeds), (SEED, ENV), axes, devices=present[:count])


def _check_even(config: Config, count: int, seeds: int) -> None:
    parts = count // seeds
    numbers = {"--num-envs": config.num_envs} | (
        {"--eval-episodes": config.eval_episodes} if config.eval_interval else {}
    )
    for flag, number in numbers.items():
        if number % parts:
            raise UsageError(
                f"{count} devices take {config.seeds} seed(s) in {seeds} part(s) and {flag} {number} in {parts}, which "
                f"is not even; choose a multiple of {parts}, other --seeds or other --devices"
            )


def use_mesh(mesh: Mesh | None) -> contextlib.AbstractContextManager[Any]:
    """What is traced inside is for `mesh`."""
    return contextlib.nullcontext() if mesh is None else jax.set_mesh(mesh)


def placement(mesh: Mesh | None, state: LearnerState) -> LearnerState | None:
    """Where each leaf of a state with a leading [seeds] belongs; None without a mesh, which lets JAX decide."""
    if mesh is None:
        return None
    by_seed, by_env = NamedSharding(mesh, P(SEED)), NamedSharding(mesh, P(SEED, ENV))
    everything = jax.tree.map(lambda _: by_seed, state)
    return dataclasses.replace(everything, rollout=jax.tree.map(lambda _: by_env, state.rollout))


def replicated(mesh: Mesh | None) -> NamedSharding | None:
    """Whole on every device; None without a mesh, which lets JAX decide."""
    return None if mesh is None else NamedSharding(mesh, P())


def place(mesh: Mesh | None, state: LearnerState) -> LearnerState:
    """Puts a state with a leading [seeds], the same in every process, where it belongs."""
    return state if mesh is None else jax.jit(lambda x: x, out_shardings=placement(mesh, state))(state)


def gather(tree: Any) -> Any:
    """Arrays that lie partly in other processes, whole in each; all processes must call it."""
    far = [x.sharding for x in jax.tree.leaves(tree) if isinstance(x, jax.Array) and not x.is_fully_addressable]
    mesh = next((sharding.mesh for sharding in far if isinstance(sharding, NamedSharding)), None)
    return tree if mesh is None else jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, P()))(tree)


# ---------------------------------------------------------------------------------------------------------------------
# Inside the program


def per_device(function: F) -> F:
    """`function` of pytrees with a leading [B], applied on each device to its own part of the environments."""
    if single_device():
        return function
    return jax.shard_map(function, in_specs=P(ENV), out_specs=P(ENV), check_vma=False)


def shard(tree: Any) -> Any:
    """Each device works on its part of the rows, the leaves' first axis."""
    return tree if single_device() else jax.lax.with_sharding_constraint(tree, P(ENV))


def replicate(tree: Any) -> Any:
    """Every device has all of it: what is drawn from at random is gathered once, not once a draw."""
    return tree if single_device() else jax.lax.with_sharding_constraint(tree, P())


def in_parallel(*parts: functools.partial[Any]) -> tuple[Any, ...]:
    """What each of `parts` returns; none needs another's result.

    Devices of a CPU take whole parts, the first ones the first device: it computes the gradient of a small minibatch
    faster than its devices exchange their shares of it. Other devices share the rows of every part.
    """
    devices = 1 if single_device() else jax.sharding.get_abstract_mesh().shape[ENV]
    if devices == 1 or not takes_whole_parts():
        return tuple(part() for part in parts)
    leaves, structure = jax.tree.flatten([(part.args, part.keywords) for part in parts])

    def taken_by(device: int, *arrays: jax.Array) -> tuple[Any, ...]:
        given, results = iter(arrays), []
        arguments = jax.tree.unflatten(structure, [next(given) if isinstance(x, jax.Array) else x for x in leaves])
        for i, (part, (args, keywords)) in enumerate(zip(parts, arguments, strict=True)):
            result = functools.partial(part.func, *args, **keywords)
            mine = i * min(devices, len(parts)) // len(parts) == device
            results.append(result() if mine else jax.tree.map(jnp.zeros_like, jax.eval_shape(result)))
        return tuple(results)

    def of_device(*arrays: jax.Array) -> tuple[Any, ...]:
        branches = [functools.partial(taken_by, device) for device in range(devices)]
        # All others have zeros, so that the sum is the one device's result.
        return jax.lax.psum(jax.lax.switch(jax.lax.axis_index(ENV), branches, *arrays), ENV)

    # What a shard_map closes over would still belong to the whole mesh, so arrays go in as its arguments.
    arrays = [x for x in leaves if isinstance(x, jax.Array)]
    return jax.shard_map(of_device, in_specs=P(), out_specs=P(), check_vma=False)(*arrays)


def takes_whole_parts() -> bool:
    """Whether each device takes whole parts of `in_parallel`, as those of a CPU do."""
    return jax.default_backend() == "cpu"


def single_device() -> bool:
    """Whether there is no mesh, or what is traced is one device's own."""
    mesh = jax.sharding.get_abstract_mesh()
    return mesh.empty or ENV in mesh.manual_axes
