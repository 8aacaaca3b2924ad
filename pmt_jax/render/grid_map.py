"""The colours of a network map."""

from __future__ import annotations

import numpy as np

# As in assets/replay.js, so that page and film agree.
NEUTRAL, LOW, HIGH = (np.array(c) / 255 for c in ((205, 205, 200), (33, 102, 172), (190, 40, 45)))


def voltage_colours(voltages: np.ndarray, band: tuple[float, float]) -> np.ndarray:
    """[..., 3] colours, 0 to 1: blue below the band's middle, red above; full strength begins where the band ends."""
    middle, half = (band[0] + band[1]) / 2, (band[1] - band[0]) / 2
    off = (np.asarray(voltages)[..., None] - middle) / half
    strength = np.where(np.abs(off) > 1, np.minimum(1, 0.8 + 0.2 * (np.abs(off) - 1)), 0.55 * np.abs(off))
    return NEUTRAL + (np.where(off < 0, LOW, HIGH) - NEUTRAL) * strength
