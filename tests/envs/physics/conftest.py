"""Shared by the tests of physics."""

from __future__ import annotations

from native import quick_compiler

__all__ = ["quick_compiler"]
