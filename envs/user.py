"""A task of the user's own: a Python file that keeps the contract of `envs.base`.

Its name is `my_env.py`, or `my_env.py:Name` where the file holds more than one class or function. Importing this module
imports neither JAX nor MuJoCo.
"""

from __future__ import annotations

import functools
import importlib.util
import inspect
import pathlib
import re
import sys
import traceback
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .errors import TaskError, did_you_mean

if TYPE_CHECKING:
    from .base import Env

_NAME = re.compile(r"(.*\.py)(?::(\w+))?")
NEEDS = ("spec", "engine", "reset", "step")  # what training asks of an environment


def is_file(name: str) -> bool:
    """Whether `name` means a Python file and not a task of ours."""
    return _NAME.fullmatch(name) is not None


def _split(name: str) -> tuple[pathlib.Path, str | None]:
    match = _NAME.fullmatch(name)
    assert match is not None, name  # whoever comes here has asked `is_file`
    return pathlib.Path(match[1]).absolute(), match[2]


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


@functools.lru_cache(maxsize=16)
def _module(file: pathlib.Path, changed: int) -> types.ModuleType:
    """Runs `file`, anew only when it has `changed`."""
    del changed
    spec = importlib.util.spec_from_file_location(f"pmt_user_env_{file.stem}", file)
    assert spec and spec.loader  # a .py file has both
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    _guard(f"{file} cannot be imported", lambda: spec.loader.exec_module(module))  # pyright: ignore[reportOptionalMemberAccess]
    return module


def build(make: Callable[..., Any], name: str, options: dict[str, Any]) -> Env:
    """`make(**options)`, checked against the contract.

    Raises:
      TaskError: it fails, lacks something, or returns other shapes than its spec promises.
    """
    env = _guard(f"{name} cannot be built", lambda: make(**options))
    missing = [need for need in NEEDS if not hasattr(env, need)]
    if missing:
        raise TaskError(f"{name} does not keep the contract of envs/base.py: it has no {', '.join(missing)}")
    check(env, name)
    return env


def check(env: Env, name: str) -> None:
    """Traces one reset and one step of `env` and compares their shapes with its spec.

    Raises:
      TaskError: the first thing that differs.
    """
    import jax
    import jax.numpy as jnp

    spec = env.spec
    n = spec.num_agents
    action = jnp.zeros((n, spec.action_dim))
    start = _guard(f"{name}: reset fails", lambda: jax.eval_shape(env.reset, jax.random.key(0)))
    shapes = {"obs": (n, spec.obs_dim), "global_state": (spec.state_dim,), "reward": (), "cost": (n, spec.num_costs)}
    for field, shape in {**shapes, "terminated": ()}.items():
        got = getattr(start, field).shape
        if got != shape:
            raise TaskError(f"{name}: reset gives {field} of shape {got}, but its spec says {shape}")
    if start.terminated.dtype != bool:
        raise TaskError(f"{name}: terminated must be a bool, not {start.terminated.dtype}")
    after = _guard(f"{name}: step fails", lambda: jax.eval_shape(env.step, start, action))
    before, then = (dict(jax.tree_util.tree_leaves_with_path(x)) for x in (start, after))
    for path in {**before, **then}:
        old, new = (f"{x[path].dtype}{list(x[path].shape)}" if path in x else "nothing" for x in (before, then))
        if old != new:
            where = jax.tree_util.keystr(path)
            raise TaskError(f"{name}: step must keep what reset made, but {where} was {old} and became {new}")


def _guard(what: str, run: Callable[[], Any]) -> Any:
    """Runs code of the user's; whatever it raises becomes one sentence with the line it came from."""
    try:
        return run()
    except Exception as error:  # anything can go wrong in a file that we have not written
        line = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{pathlib.Path(line.filename).name}, line {line.lineno}"
        if isinstance(error, SyntaxError):
            place = f"{pathlib.Path(error.filename or '').name}, line {error.lineno}"
        first = (str(error).splitlines() or [""])[0]
        raise TaskError(f"{what}: {type(error).__name__}: {first} ({place})") from error
