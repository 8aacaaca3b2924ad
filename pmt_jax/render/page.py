"""Pages of one file: style, script and data inside, readable on a phone, dark or light as the reader's system is."""

from __future__ import annotations

import base64
import html
import importlib.resources
import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from .episode import Episode

RATE = 20.0  # control steps that a replay shows a second


def page(title: str, body: Iterable[str]) -> str:
    """A whole HTML document."""
    style, script = _asset("page.css"), _asset("replay.js")
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{html.escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<link rel="icon" href="data:,">\n'
        f"<style>\n{style}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + f"\n<script>\n{script}</script>\n</body>\n</html>\n"
    )


def _asset(name: str) -> str:
    return importlib.resources.files("pmt_jax").joinpath("render", "assets", name).read_text()


def replay(episode: Episode, rate: float = RATE, play: bool = True) -> str:
    """An episode as a figure that plays: bodies in space, a voltage map, or the task's figures over time.

    Args:
      rate: control steps a second.
      play: begin at once (never where the reader's system asks for little motion).
    """
    kind = episode.picture.kind
    data: dict[str, Any] = {
        "kind": kind,
        "title": f"{episode.env.spec.name}, {episode.method}, seed {episode.seed}",
        "rate": rate,
        "limit": episode.cost_limit,
        "step": episode.step.tolist(),
        "reward": _numbers(episode.reward),
        "cost": _numbers(episode.cost),
        "reward_sum": _numbers(episode.reward_sum),
        "cost_sum": _numbers(episode.cost_sum),
    }
    if kind == "scene":
        from . import scenes  # MuJoCo, which only its tasks need

        data["scene"] = scenes.tracks(episode)
    elif kind == "map":
        data["map"] = _map(episode)
    else:
        data["info"] = {name: _numbers(x) for name, x in episode.info.items()}
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    starts = "yes" if play else "no"
    return (
        f'<figure class="replay" data-kind="{kind}" data-play="{starts}">\n'
        f'<script type="application/json">{text}</script>\n</figure>'
    )


def _map(episode: Episode) -> dict[str, Any]:
    """The network as a map: places and links of its nodes, the agents' nodes, the band, the quantity [T + 1, n]."""
    grid = episode.picture
    return {
        "x": _numbers(grid.x),
        "y": _numbers(grid.y),
        "links": grid.links.tolist(),
        "agents": grid.agents.tolist(),
        "band": list(grid.band),
        "values": to_base64(episode.raw[grid.quantity]),
    }


def to_base64(x: np.ndarray) -> str:
    """Numbers for the page's script: bytes as they are, everything else as little-endian f32."""
    return base64.b64encode(np.ascontiguousarray(x, "u1" if x.dtype == np.uint8 else "<f4").tobytes()).decode()


def _numbers(x: np.ndarray) -> list[float]:
    return [float(f"{value:.5g}") for value in np.nan_to_num(np.asarray(x, float)).tolist()]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table that scrolls by itself where it is wider than the screen; cells after the first hold numbers."""

    def line(cells: Sequence[str], tag: str) -> str:
        kinds = ["", *[' class="number"'] * (len(cells) - 1)]
        return "".join(f"<{tag}{k}>{html.escape(c)}</{tag}>" for k, c in zip(kinds, cells, strict=True))

    top = f"<thead><tr>{line(head, 'th')}</tr></thead>" if head else ""
    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows)
    return f'<div class="wide"><table>{top}<tbody>{body}</tbody></table></div>'
