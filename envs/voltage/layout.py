"""Where the buses of a distribution feeder are drawn."""

from __future__ import annotations

import itertools

import numpy as np


def layout(branches: np.ndarray, root: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places the buses of a feeder: hops from the substation to the right, its longest line straight.

    Args:
      branches: [b, 2] the buses that each line joins; lines that close a ring do not move anything.
      root: the substation.
      count: n, buses.

    Returns:
      [n] x and [n] y, each scaled to 0 to 1 (0.5 if all are equal).
    """
    hops, children = _tree(branches, root, count)
    reach = _reach(hops, children, root)
    rows, _ = _rows(root, hops, children, reach)
    y = np.array([rows.get(bus, 0) for bus in range(count)], float)
    return _scaled(np.array(hops, float)), _scaled(y)


def _rows(
    bus: int, hops: list[int], children: list[list[int]], reach: list[int]
) -> tuple[dict[int, int], set[tuple[int, int]]]:
    """The rows of `bus` (row 0) and all that it feeds, and the cells (hop, row) that they and their lines take.

    Branches are laid from the far end of the line backwards, each in the nearest rows that are free: what leads to a
    branch then passes before all that lies behind it, so nothing crosses.
    """
    line = [bus]
    while children[line[-1]]:
        line.append(max(children[line[-1]], key=lambda child: reach[child]))
    rows, cells = dict.fromkeys(line, 0), {(hops[stop], 0) for stop in line}
    for stop in reversed(line):
        risers: set[tuple[int, int]] = set()
        for child in children[stop]:
            if child in rows:
                continue
            sub_rows, sub_cells = _rows(child, hops, children, reach)
            for shift in itertools.chain.from_iterable((k, -k) for k in itertools.count(1)):
                moved = {(hop, row + shift) for hop, row in sub_cells}
                riser = {(hops[stop], row) for row in range(shift, 0, -1 if shift > 0 else 1)}
                if not (moved | riser) & cells:
                    break
            rows |= {other: row + shift for other, row in sub_rows.items()}
            cells |= moved
            risers |= riser
        cells |= risers
    return rows, cells


def _tree(branches: np.ndarray, root: int, count: int) -> tuple[list[int], list[list[int]]]:
    """Breadth first from `root`: hops [n] (0 if nothing leads there) and the buses that each one feeds."""
    neighbours: list[list[int]] = [[] for _ in range(count)]
    for a, b in np.asarray(branches).tolist():
        neighbours[a].append(b)
        neighbours[b].append(a)
    hops, children = [0] * count, [[] for _ in range(count)]
    seen, queue = {root}, [root]
    for bus in queue:
        for other in neighbours[bus]:
            if other not in seen:
                seen.add(other)
                queue.append(other)
                children[bus].append(other)
                hops[other] = hops[bus] + 1
    return hops, children


def _reach(hops: list[int], children: list[list[int]], root: int) -> list[int]:
    """[n] hops of the farthest bus beyond each one."""
    reach = list(hops)
    order = [root]
    for bus in order:
        order += children[bus]
    for bus in reversed(order):
        reach[bus] = max([hops[bus], *(reach[child] for child in children[bus])])
    return reach


def _scaled(x: np.ndarray) -> np.ndarray:
    span = np.ptp(x)
    return (x - x.min()) / span if span else np.full_like(x, 0.5)
