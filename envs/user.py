"""A task of the user's own: a Python file that keeps the contract of `envs.base`.

Its name is `my_env.py`, or `my_env.py:Name` if the file holds more than one class or function. Importing this module
imports neither JAX nor MuJoCo.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.machinery
import importlib.util
import inspect
import pathlib
import re
import sys
import sysconfig
import traceback
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .errors import TaskError, did_you_mean

if TYPE_CHECKING:
    import jax

    from .base import Env, EnvSpec

_NAME = re.compile(r"(.*\.py)(?::(\w+))?")
NEEDS = ("spec", "engine", "reset", "step")  # what training needs of an environment


def is_file(name: str) -> bool:
    """Whether `name` means a Python file and not a registered task."""
    return _NAME.fullmatch(name) is not None


def file_of(name: str) -> pathlib.Path:
    """The Python file that `name` means, as a whole path; links are not followed."""
    return _split(name)[0]


def _split(name: str) -> tuple[pathlib.Path, str | None]:
    match = _NAME.fullmatch(name)
    assert match is not None, name  # callers check `is_file` first
    return pathlib.Path(match[1]).expanduser().absolute(), match[2]


def absolute(name: str) -> str:
    """`name` with the file's whole path, so that it means the same from every folder."""
    file, chosen = _split(name)
    return f"{file}:{chosen}" if chosen else str(file)


def factory(name: str) -> Callable[..., Env]:
    """The class or function that `name` means; without `:Name`, the file's only class with `reset` and `step`.

    Raises:
      TaskError: no such file, one that cannot be imported, or no such class.
    """
    file, chosen = _split(name)
    if not file.is_file():
        raise TaskError(f"there is no environment file {file}")
    found = vars(_module(file, file.stat().st_mtime_ns))
    if chosen:
        if not callable(found.get(chosen)):
            known = [k for k, v in found.items() if inspect.isclass(v) or inspect.isfunction(v)]
            raise TaskError(f"{file} has no class or function '{chosen}'{did_you_mean(chosen, known)}")
        return found[chosen]
    own: list[Any] = [v for v in found.values() if inspect.isclass(v) and v.__module__ == found["__name__"]]
    envs = [v for v in own if hasattr(v, "reset") and hasattr(v, "step")]
    if len(envs) != 1:
        listing = ", ".join(v.__name__ for v in envs)
        which = f"several ({listing}); choose one, as {file.name}:{envs[0].__name__}" if envs else "none"
        raise TaskError(f"{file} should hold one class with reset and step (see envs/base.py), but holds {which}")
    return envs[0]


def members(name: str) -> tuple[dict[str, Any], str | None]:
    """What the Python file that `name` means holds, by name, once it has been executed; and the `:Name`, if any.

    Raises:
      TaskError: there is no such file, or it cannot be imported.
    """
    file, chosen = _split(name)
    if not file.is_file():
        raise TaskError(f"there is no file {file}")
    return vars(_module(file, file.stat().st_mtime_ns)), chosen


class _Loader(importlib.machinery.SourceFileLoader):
    """Reads a user's file and leaves no bytecode in the user's folder."""

    def set_data(self, path: Any, data: Any, *, _mode: int = 0o666) -> None:
        del path, data, _mode


@functools.lru_cache(maxsize=16)
def _module(file: pathlib.Path, changed: int) -> types.ModuleType:
    """Runs `file`, anew only when it has `changed`."""
    del changed
    place = hashlib.sha256(str(file).encode()).hexdigest()[:8]  # files of one name in several folders stay apart
    name = f"pmt_user_env_{file.stem}_{place}"
    spec = importlib.util.spec_from_file_location(name, file, loader=_Loader(name, str(file)))
    assert spec and spec.loader  # a .py file has both
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    guard(f"{file} cannot be imported", lambda: spec.loader.exec_module(module))  # pyright: ignore[reportOptionalMemberAccess]
    return module


def build(make: Callable[..., Any], name: str, options: dict[str, Any]) -> Env:
    """`make(**options)`, checked against the contract.

    Raises:
      TaskError: it fails, lacks something, or returns other shapes than its spec promises.
    """
    env = guard(f"{name} cannot be built", lambda: make(**options))
    missing = [need for need in NEEDS if not hasattr(env, need)]
    if missing:
        raise TaskError(f"{name} does not keep the contract of envs/base.py: it has no {', '.join(missing)}")
    check_shapes(env, name)
    _check_engine(env, name)
    if env.engine not in ("mjx", "warp"):  # these take minutes to compile, and training compiles them again
        _check_values(env, name)
    return env


def check_shapes(env: Env, name: str) -> None:
    """Traces a reset and a step of `env` and checks them against its spec and the contract; computes nothing.

    Raises:
      TaskError: the first thing that differs.
    """
    import jax
    import jax.numpy as jnp

    from .base import EnvSpec

    spec = getattr(env, "spec", None)
    if not isinstance(spec, EnvSpec):
        raise TaskError(f"{name}: spec must be an EnvSpec of envs/base.py, not a {type(spec).__name__}")
    start = guard(f"{name}: reset fails", lambda: jax.eval_shape(env.reset, jax.random.key(0)))
    _check_fields(env.spec, start, name)
    action = jnp.zeros(env.spec.action_mask.shape)
    after = guard(f"{name}: step fails", lambda: jax.eval_shape(env.step, start, action))
    before, then = (dict(jax.tree_util.tree_leaves_with_path(x)) for x in (start, after))
    for path in {**before, **then}:
        old, new = (f"{x[path].dtype}{list(x[path].shape)}" if path in x else "nothing" for x in (before, then))
        if old != new:
            where = jax.tree_util.keystr(path)
            raise TaskError(f"{name}: step must keep what reset made, but {where} was {old} and became {new}")


def _check_engine(env: Env, name: str) -> None:
    """Compares the name of the engine with the known ones, and with what the task computes."""
    import jax
    import jax.numpy as jnp

    from .physics import ENGINES

    known = ("xla", *ENGINES)
    if env.engine not in known:
        raise TaskError(f"{name}: unknown engine '{env.engine}'{did_you_mean(str(env.engine), known)}")
    if env.engine in ("xla", "mjx"):  # these run within XLA, where nothing tells them apart
        return
    action = jnp.zeros(env.spec.action_mask.shape)
    program = jax.make_jaxpr(lambda key: env.step(env.reset(key), action))(jax.random.key(0))
    if not re.search("ffi_call|callback", str(program)):
        raise TaskError(
            f"{name}: it has engine = '{env.engine}', but no step calls an engine; a task that is plain JAX has "
            "engine = 'xla'"
        )


def _check_fields(spec: EnvSpec, start: Any, name: str) -> None:
    """Compares the shapes of what `reset` returns with the spec."""
    import chex
    import jax.numpy as jnp

    n = spec.num_agents
    shapes = {"obs": (n, spec.obs_dim), "global_state": (spec.state_dim,), "reward": (), "cost": (n, spec.num_costs)}
    shapes["terminated"] = ()
    missing = [field for field in (*shapes, "info", "carry") if not hasattr(start, field)]
    if missing:
        kind = type(start).__name__
        raise TaskError(f"{name}: reset must return a State of envs/base.py, but its {kind} has no {missing[0]}")
    for field, shape in shapes.items():
        try:
            chex.assert_shape([getattr(start, field)], shape)
        except (AssertionError, AttributeError):
            got = getattr(getattr(start, field), "shape", None)
            raise TaskError(f"{name}: reset gives {field} of shape {got}, but its spec says {shape}") from None
    for field in ("reward", "cost"):
        kind = getattr(start, field).dtype
        if not jnp.issubdtype(kind, jnp.floating):
            raise TaskError(f"{name}: {field} must be floating, not {kind}; add .astype(float)")
    if start.terminated.dtype != bool:
        raise TaskError(f"{name}: terminated must be a bool, not {start.terminated.dtype}")
    if not isinstance(start.info, dict):
        raise TaskError(f"{name}: info must be a dict of scalars, not a {type(start.info).__name__}")
    for key, value in start.info.items():
        if getattr(value, "shape", None) != ():
            raise TaskError(f"{name}: info holds scalars, but '{key}' has shape {getattr(value, 'shape', None)}")


def _check_values(env: Env, name: str) -> None:
    """Plays a reset and three steps, and checks their numbers.

    The steps are without any action, with the largest in [-1, 1], and with one that differs from agent to agent.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from .base import shares_cost
    from .vector import out_of_range

    def play(key: jax.Array) -> dict[str, jax.Array]:
        def step(state: Any, action: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
            after = env.step(state, action)
            return after, seen(after)

        def seen(state: Any) -> dict[str, jax.Array]:
            found = {field: getattr(state, field) for field in ("obs", "global_state", "reward", "cost")}
            for path, leaf in jax.tree_util.tree_leaves_with_path(jax.tree.map(jnp.asarray, state.carry)):
                if jnp.issubdtype(leaf.dtype, jnp.floating):  # 0, or what is not finite
                    found["carry" + jax.tree_util.keystr(path)] = jnp.sum(leaf - leaf)
            return found

        start = env.reset(key)
        mask = jnp.asarray(env.spec.action_mask, float)
        apart = mask * jnp.linspace(1.0, -1.0, len(mask))[:, None]
        later = jax.lax.scan(step, start, jnp.stack([0 * mask, mask, apart]))[1]
        return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), seen(start), later)

    found = guard(f"{name}: the first steps fail", lambda: jax.device_get(jax.jit(play)(jax.random.key(0))))
    for field, values in found.items():
        if not np.isfinite(values).all():
            step = int(np.argwhere(~np.isfinite(values))[0][0])
            when = f"after step {step}" if step else "after reset"
            raise TaskError(f"{name}: {field} is not finite {when}")
    low, high = found["cost"].min(), found["cost"].max()
    if out_of_range(jnp.stack([low, high])).any():
        raise TaskError(f"{name}: costs must be within [0, 1], but the first steps give {low if low < 0 else high:g}")
    if shares_cost(env) and np.ptp(found["cost"], axis=1).any():
        raise TaskError(f"{name}: it has shares_cost = True, but its agents' costs differ; leave shares_cost out")


def guard(what: str, run: Callable[[], Any]) -> Any:
    """What code of the user's returns.

    Raises:
      TaskError: in one sentence with the user's line, whatever the code raised.
    """
    try:
        return run()
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        lines = traceback.extract_tb(error.__traceback__)
        # Neither ours nor of a package that the user's code calls, as JAX; <string> is a dataclass.
        here = pathlib.Path(__file__).parent
        others = (
            f"{here}/",
            f"{here.with_name('pmt_jax')}/",
            "<",
            sysconfig.get_path("purelib"),
            sysconfig.get_path("platlib"),
        )
        own = [line for line in lines if not line.filename.startswith(others)]
        line = (own or lines)[-1]
        place = f"{pathlib.Path(line.filename).name}, line {line.lineno}"
        if isinstance(error, TaskError):
            raise TaskError(f"{what}: {error} ({place})") from error
        if isinstance(error, SyntaxError):
            place = f"{pathlib.Path(error.filename or '').name}, line {error.lineno}"
        text = error.msg if isinstance(error, SyntaxError) else str(error)  # the latter has the place, too
        first = (text.splitlines() or [""])[0]
        raise TaskError(f"{what}: {type(error).__name__}: {first} ({place})") from error
