"""Safe multi-agent reinforcement learning with emotions, as one compiled program.

Everything public is reached from here; importing the package imports neither JAX nor MuJoCo until something is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .config import Config, load_config
    from .evaluation import evaluate
    from .learner import init, make_train, train_step
    from .methods import METHODS, Method
    from .policy import load_policy
    from .run import setup

__version__ = "0.1.0"

_PLACES = {
    "Config": "config",
    "METHODS": "methods",
    "Method": "methods",
    "evaluate": "evaluation",
    "init": "learner",
    "load_config": "config",
    "load_policy": "policy",
    "make_train": "learner",
    "setup": "run",
    "train_step": "learner",
}

__all__ = [
    "METHODS",
    "Config",
    "Method",
    "evaluate",
    "init",
    "load_config",
    "load_policy",
    "make_train",
    "setup",
    "train_step",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'pmt_jax' has no attribute '{name}'")
    return getattr(importlib.import_module(f".{_PLACES[name]}", __name__), name)
