"""Frozen dataclasses as pytrees."""

from __future__ import annotations

import dataclasses
import typing

import jax

_T = typing.TypeVar("_T", bound=type)


@typing.dataclass_transform(frozen_default=True)
def pytree(cls: _T) -> _T:
    """A frozen dataclass whose fields are a pytree's children."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True)(cls))
