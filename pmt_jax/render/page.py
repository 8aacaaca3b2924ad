"""Pages of one file: style, script and data inside, readable on a phone, dark or light as the reader's system is."""

from __future__ import annotations

import html
import importlib.resources
import json
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..studies import plot
from .episode import Episode, to_base64

NUMBER = re.compile(r"[-+]?(\d|$)")  # the beginning of one, or - for none
RATE = 20.0  # control steps that a replay shows a second


def page(title: str, body: Iterable[str]) -> str:
    """A whole HTML document."""
    accents = f":root {{ --accent-light: {plot.BLUE}; --accent-dark: {plot.SKY}; }}\n"  # the colours of all figures
    style = accents + _asset("page.css")
    script = f"const LINES = {json.dumps(plot.OTHER_COLOURS)};\n{_asset('replay.js')}"
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
    """An episode as a figure that plays: bodies in space, a network map, or metrics and actions over time.

    Args:
      rate: control steps a second.
      play: begin at once (never if the reader's system requests little motion).
    """
    kind = episode.picture.kind
    data: dict[str, Any] = {
        "kind": kind,
        "title": f"{episode.env.spec.name}, {episode.method}, seed {episode.seed}",
        "rate": rate,
        "limit": str(episode.limits),
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
        data["panels"] = _panels(episode)
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")  # a name cannot end the script
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
        "unit": grid.unit,
        "values": to_base64(episode.raw[grid.quantity]),
    }


def _panels(episode: Episode) -> list[dict[str, Any]]:
    """Metrics and actions over time, for a task without a picture: name and lines [T + 1] of each panel."""
    sums = {"reward so far": episode.reward_sum, "cost so far": episode.cost_sum}
    panels = [{"name": name, "lines": [_numbers(x)]} for name, x in {**sums, **episode.info}.items()]
    for agent, (actions, mask) in enumerate(
        zip(episode.action.swapaxes(0, 1), episode.env.spec.action_mask, strict=True)
    ):
        lines = [_numbers(x) for x, used in zip(actions.T, mask, strict=True) if used]
        panels.append({"name": f"actions of agent {agent}", "lines": lines})
    return panels


def _numbers(x: np.ndarray) -> list[float]:
    return [float(f"{value:.5g}") for value in np.nan_to_num(np.asarray(x, float)).tolist()]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table that scrolls by itself if it is wider than the screen; columns of numbers are aligned to the right."""
    lines = [list(row) for row in rows]
    numeric = [i > 0 and all(NUMBER.match(row[i]) for row in lines) for i in range(len(head or lines[0]))]

    def line(cells: Sequence[str], tag: str) -> str:
        kinds = [' class="number"' * number for number in numeric]
        return "".join(f"<{tag}{k}>{html.escape(c)}</{tag}>" for k, c in zip(kinds, cells, strict=True))

    top = f"<thead><tr>{line(head, 'th')}</tr></thead>" if head else ""
    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in lines)
    return f'<div class="wide" tabindex="0"><table>{top}<tbody>{body}</tbody></table></div>'
