"""Access to the environments: the only file of pmt_jax that imports `envs`, on first use."""

from __future__ import annotations

import contextlib
import importlib
import pathlib
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from .errors import UsageError

if TYPE_CHECKING:
    from envs.base import Controller, Env, EnvSpec, State, declarations, shares_cost
    from envs.columns import Column
    from envs.vector import Outcome, VectorEnv, VectorState, observed_cost

__all__ = [
    "Env",
    "EnvSpec",
    "Outcome",
    "State",
    "VectorEnv",
    "VectorState",
    "absolute",
    "advice",
    "announcing",
    "baseline",
    "check",
    "columns",
    "compiler",
    "declarations",
    "did_you_mean",
    "engines",
    "explain_options",
    "guard",
    "installed_version",
    "observed_cost",
    "is_file",
    "make",
    "members",
    "names",
    "native",
    "options",
    "shares_cost",
    "task_file",
]


def _envs() -> types.ModuleType:
    import envs

    if getattr(envs, "__pmt__", None) != "pmt-jax":
        raise UsageError(
            f"another package named 'envs' hides ours: {getattr(envs, '__file__', None) or envs}; "
            "remove it (pip uninstall envs), or run from another folder, then reinstall pmt-jax"
        )
    return envs


def _module(name: str) -> Any:
    return importlib.import_module(f"{_envs().__name__}.{name}")


@contextlib.contextmanager
def _asked() -> Iterator[Any]:
    """Gives `envs`, whose errors become sentences of ours."""
    envs = _envs()
    try:
        yield envs
    except envs.TaskError as error:
        raise UsageError(str(error)) from error


_CONTRACT = {"Env": "base", "EnvSpec": "base", "State": "base", "declarations": "base"}
_CONTRACT |= {"shares_cost": "base"}
_CONTRACT |= {"Outcome": "vector", "VectorEnv": "vector", "VectorState": "vector", "observed_cost": "vector"}


def __getattr__(name: str) -> Any:
    """The contract's types and functions, imported (with JAX) when first asked for."""
    if name not in _CONTRACT:
        raise AttributeError(f"module 'pmt_jax.tasks' has no attribute '{name}'")
    return getattr(_module(_CONTRACT[name]), name)


def names() -> list[str]:
    """The tasks that `make` builds."""
    return _envs().names()


def is_file(name: str) -> bool:
    """Whether a task's name means a Python file of the user's (`my_env.py`, `my_env.py:Name`)."""
    return _envs().user.is_file(name)


def task_file(name: str) -> pathlib.Path:
    """The Python file that a task's name means (see `is_file`), as a whole path; links are not followed."""
    return _envs().user.file_of(name)


def members(name: str) -> tuple[dict[str, Any], str | None]:
    """What the Python file that `name` means holds once it has been executed, and the `:Name` behind it, if any.

    Raises:
      UsageError: there is no such file, or it cannot be imported.
    """
    with _asked() as envs:
        return envs.user.members(name)


def guard(what: str, run: Callable[[], Any]) -> Any:
    """What code of the user's returns.

    Raises:
      UsageError: `what` happened, and why, in one sentence with the user's line.
    """
    with _asked() as envs:
        return envs.user.guard(what, run)


def absolute(name: str) -> str:
    """A task's name as it means the same from every folder: that of a file becomes a whole path."""
    return _envs().user.absolute(name) if is_file(name) else name


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """The nearest of `choices` as '; did you mean ...?', or all of them if none is near."""
    return _envs().errors.did_you_mean(word, choices)


def baseline(env: Env, name: str) -> Controller:
    """A policy that needs no training: state -> action [N, A].

    Raises:
      UsageError: unknown policy, or a task that has none.
    """
    known = _module("base").declarations(env).baselines
    if not known:
        raise UsageError(f"task '{env.spec.name}' has no baseline policies")
    if name not in known:
        raise UsageError(f"unknown policy '{name}'{did_you_mean(name, known)}")
    return known[name]()


def columns(name: str) -> Mapping[str, Column]:
    """The entries of a task's `info` that tables show, by their name in `info`; needs no JAX."""
    return _envs().columns(name)


def installed_version(package: str) -> str | None:
    """A package's version; None where it is missing."""
    return _module("versions").installed_version(package)


def engines(env: Env | None = None) -> tuple[str, dict[str, str | None]]:
    """The physics engine that `auto` takes here, and for each engine why it cannot run here, None if it can.

    With a task, why an engine cannot step its model counts, too.

    Raises:
      UsageError: MuJoCo is missing or of another version.
    """
    with _asked():
        physics = _module("physics")
        physics.check_versions()
        step = _stepped(env)
        return physics.resolve("auto", *step), {name: physics.obstacle(name, *step) for name in physics.ENGINES}


def _stepped(env: Env | None) -> tuple[Any, Any, bool]:
    """The MjModel that a task's physics steps, its readout and forward pass, as far as the task declares them."""
    if env is None:
        return None, None, False
    declared = _module("base").declarations(env)
    return declared.stepped or (getattr(declared.picture, "model", None), None, False)


def advice(env: Env) -> str | None:
    """What would make a task's physics faster on this machine, as a sentence; None if nothing is known."""
    model, readout, _ = _stepped(env)
    return _module("physics").advice(model, readout) if model is not None else None


def compiler() -> str:
    """What compiles the engine `fused` here; needs one."""
    return _module("physics.fused_engine").compiler()


def native() -> types.ModuleType:
    """How C++ code is compiled and called here."""
    return _module("native")


def gpu() -> types.ModuleType:
    """How CUDA code is compiled and called here."""
    return _module("physics.fused.gpu")


def announcing(say: Callable[[str], object]) -> contextlib.AbstractContextManager[None]:
    """Prints a line before something that takes long while a task is made inside."""
    return _module("progress").announcing(say)


def make(name: str, physics: str = "auto", **options: Any) -> Env:
    """Builds a task, with the chosen engine if it has one.

    Raises:
      UsageError: unknown task or option, an engine that cannot run here, or a file that does not keep the contract.
    """
    if physics != "auto":
        options["physics"] = physics
    try:
        with _asked() as envs:
            return envs.make(name, **options)
    except UsageError:
        raise
    except Exception as error:
        given = ", ".join(f"{option} = {value!r}" for option, value in options.items() if option != "physics")
        if not given:
            raise
        reason = (str(error).splitlines() or [""])[0]
        raise UsageError(f"task '{name}' cannot be built with {given}: {type(error).__name__}: {reason}") from error


def check(env: Env) -> None:
    """Checks the shapes of an environment that did not come from `make`.

    Raises:
      UsageError: it does not keep the contract of envs/base.py.
    """
    with _asked() as envs:
        envs.user.check_shapes(env, type(env).__name__)


def options(name: str) -> dict[str, Any]:
    """The options that a task takes, with their defaults.

    Raises:
      UsageError: unknown task.
    """
    with _asked() as envs:
        return envs.task_options(name)


def explain_options(name: str) -> str:
    """What the class of a task says of its options."""
    return _envs().explain_options(name)
