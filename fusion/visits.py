"""In which order matched landmarks are come upon along the corridors, and from which direction."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from .prepared import PreparedMap

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: A link shorter than this [m] has no direction to speak of.
SHORT_M = 0.5


def visits(m: PreparedMap, matched: Index) -> tuple[Index, Array]:
    """Order in which matched landmarks are come upon along a map's corridors, and the direction each is come by.

    ``matched`` (k,): places in the map. Returns places in ``matched`` (k,) and unit vectors in the map's frame (k, 2),
    NaN for the first one and where no corridor is known. Each stretch of corridor is followed from the landmark
    nearest to what was visited before, the first one from the middle.
    """
    neighbours: dict[int, list[int]] = {}
    for a, b in m.corridors.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    p = m.positions
    order: list[int] = []
    directions: list[Array] = []
    remaining = {int(i): k for k, i in enumerate(matched)}
    while remaining:
        queue: list[tuple[float, int, int]] = [(0.0, _begin(p, matched, order, remaining), -1)]
        done: set[int] = set()
        while queue:
            distance, node, before = heapq.heappop(queue)
            if node in done:
                continue
            done.add(node)
            if node in remaining:
                order.append(remaining.pop(node))
                directions.append(_arrival(m, matched, order, node, before))
                distance = 0.0
            for other in neighbours.get(node, []):
                if other not in done:
                    step = float(np.linalg.norm(p[other] - p[node]))
                    heapq.heappush(queue, (distance + step, other, node))
    return np.array(order, dtype=np.intp), np.array(directions).reshape(-1, 2)


def _begin(p: Array, matched: Index, order: list[int], remaining: dict[int, int]) -> int:
    """The matched landmark to begin a stretch of corridor with."""
    if not order:
        middle = p[matched].mean(axis=0)
        return min(remaining, key=lambda i: float(np.linalg.norm(p[i] - middle)))
    return min(remaining, key=lambda i: float(np.linalg.norm(p[matched[order]] - p[i], axis=1).min()))


def _arrival(m: PreparedMap, matched: Index, order: list[int], node: int, before: int) -> Array:
    """Direction of the corridor by which ``node`` was reached."""
    p = m.positions
    if before >= 0:
        step = p[node] - p[before]
        length = float(np.hypot(*step))
        if length > SHORT_M:
            return np.asarray(step / length)
    arms = m.arm_headings[node][m.arm_passable[node]]
    if len(order) < 2 or not len(arms):
        return np.full(2, np.nan)
    nearest = min(order[:-1], key=lambda k: float(np.linalg.norm(p[matched[k]] - p[node])))
    ways = np.column_stack([np.cos(arms), np.sin(arms)])
    return np.asarray(ways[int(np.argmax(np.abs(ways @ (p[node] - p[matched[nearest]]))))])
