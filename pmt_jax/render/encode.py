"""Arrays as the scripts of pages read them."""

from __future__ import annotations

import base64

import numpy as np


def to_base64(x: np.ndarray) -> str:
    """Numbers for the page's script: bytes as they are, everything else as little-endian f32."""
    return base64.b64encode(np.ascontiguousarray(x, "u1" if x.dtype == np.uint8 else "<f4").tobytes()).decode()
