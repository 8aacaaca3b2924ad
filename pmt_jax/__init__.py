"""Safe multi-agent reinforcement learning with emotions, compiled by JAX.

Everything public is reached from here; importing the package imports neither JAX nor MuJoCo until something is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .config.load import load_config
    from .config.methods import METHODS, Method
    from .config.settings import Config
    from .learning.evaluation import evaluate
    from .learning.learner import init, make_train, train_step
    from .learning.setup import make_setup
    from .policies.load import load_policy

__version__ = "0.2.0.dev0"  # the only place

_PLACES = {
    "Config": "config.settings",
    "METHODS": "config.methods",
    "Method": "config.methods",
    "evaluate": "learning.evaluation",
    "init": "learning.learner",
    "load_config": "config.load",
    "load_policy": "policies.load",
    "make_train": "learning.learner",
    "make_setup": "learning.setup",
    "train_step": "learning.learner",
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
    "make_setup",
    "train_step",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'pmt_jax' has no attribute '{name}'")
    return getattr(importlib.import_module(f".{_PLACES[name]}", __name__), name)
