"""A network map: its colours, and its frames in films, drawn by matplotlib."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .episode import Episode

# As in assets/replay.js, so that page and film agree.
PAPER, INK = (251, 250, 248), (29, 33, 37)
NEUTRAL, LOW, HIGH = (np.array(c) / 255 for c in ((205, 205, 200), (33, 102, 172), (190, 40, 45)))


def colours(values: np.ndarray, band: tuple[float, float]) -> np.ndarray:
    """[..., 3] colours, 0 to 1: blue below the band's middle, red above; full strength begins where the band ends."""
    middle, half = (band[0] + band[1]) / 2, (band[1] - band[0]) / 2
    off = (np.asarray(values)[..., None] - middle) / half
    strength = np.where(np.abs(off) > 1, np.minimum(1, 0.8 + 0.2 * (np.abs(off) - 1)), 0.55 * np.abs(off))
    return NEUTRAL + (np.where(off < 0, LOW, HIGH) - NEUTRAL) * strength


def frames(episode: Episode, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """[height, width, 3] pictures of an episode's moments."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    network = episode.picture
    x, y, (low, high), values = network.x, -network.y, network.band, episode.raw[network.quantity]
    figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, facecolor="#{:02x}{:02x}{:02x}".format(*PAPER))
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.03, 0.22, 0.94, 0.72), frameon=False, xticks=[], yticks=[])
    area = 40 * min(1, 45 / len(x))  # points^2 of a node
    rim = area**0.5 / 3
    elbows = [[(x[a], y[a]), (x[a], y[b]), (x[b], y[b])] for a, b in network.links]
    lines: Any = axes.add_collection(LineCollection(elbows, linewidths=area**0.5 / 2.5, zorder=1))
    marks = np.isin(np.arange(len(x)), network.agents)
    looks = ((~marks, area, "o"), (marks, 1.75 * area, "s"))
    nodes: list[Any] = [axes.scatter(x[m], y[m], s=s, marker=k, zorder=2) for m, s, k in looks]
    _colour_bar(figure, network.band, network.unit)
    for v in values:
        lines.set_color(colours(v[network.links].mean(1), network.band))
        for dots, chosen in zip(nodes, (~marks, marks), strict=True):
            out = (v[chosen] < low) | (v[chosen] > high)
            dots.set_facecolor(colours(v[chosen], network.band))
            dots.set_edgecolor(np.where(out[:, None], np.array(INK) / 255, np.array(PAPER) / 255))
            dots.set_linewidth(np.where(out, rim, 0.4 * rim))
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3]


def _colour_bar(figure: Any, band: tuple[float, float], unit: str) -> None:
    """Beneath the map: which colour means which value, the band marked."""
    low, high = band
    reach = np.linspace(low - (high - low) / 2, high + (high - low) / 2, 200)
    axes = figure.add_axes((0.56, 0.175, 0.4, 0.025))
    axes.imshow(colours(reach, band)[None], aspect="auto", extent=(reach[0], reach[-1], 0, 1))
    axes.set(yticks=[], xticks=[low, (low + high) / 2, high])
    axes.set_xticklabels([f"{low:g}", f"{(low + high) / 2:g} {unit}".strip(), f"{high:g}"], fontsize=8)
    axes.tick_params(length=2, pad=1)
    axes.set_frame_on(False)
