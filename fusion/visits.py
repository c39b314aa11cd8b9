"""In which order matched landmarks are come upon along the corridors, and from which direction."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from .elastic import Joined

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def visits(joined: Joined) -> tuple[Index, Array]:
    """Order in which matched pairs are come upon along the corridors, and the corridor direction each is come by.

    Returns places in ``joined.i`` (k,) and unit vectors in frame 1 (k, 2); of the first one the direction is NaN.
    """
    m = joined.m1
    place = {int(i): k for k, i in enumerate(joined.i)}
    neighbours: dict[int, list[int]] = {}
    for a, b in m.corridors.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    p = m.positions
    order: list[int] = []
    directions: list[Array] = []
    remaining = dict(place)
    while remaining:
        first = min(remaining, key=lambda i: _seed_rank(joined, remaining[i], order))
        queue: list[tuple[float, int, int]] = [(0.0, first, -1)]
        done: set[int] = set()
        while queue:
            distance, node, before = heapq.heappop(queue)
            if node in done:
                continue
            done.add(node)
            if node in remaining:
                order.append(remaining.pop(node))
                directions.append(_arrival(joined, order, node, before))
                distance = 0.0
            for other in neighbours.get(node, []):
                if other not in done:
                    step = float(np.linalg.norm(p[other] - p[node]))
                    heapq.heappush(queue, (distance + step, other, node))
    return np.array(order, dtype=np.intp), np.array(directions).reshape(-1, 2)


def _seed_rank(joined: Joined, k: int, order: list[int]) -> tuple[float, ...]:
    """Which matched landmark to begin a stretch of corridor with: near what is matched, then the best known."""
    p = joined.m1.positions
    if not order:
        centre = p[joined.i].mean(axis=0)
        return (float(np.linalg.norm(p[joined.i[k]] - centre)),)
    return (float(np.linalg.norm(p[joined.i[order]] - p[joined.i[k]], axis=1).min()),)


def _arrival(joined: Joined, order: list[int], node: int, before: int) -> Array:
    """Direction of the corridor by which ``node`` was reached."""
    p = joined.m1.positions
    if before >= 0:
        step = p[node] - p[before]
        length = float(np.hypot(*step))
        if length > 0.5:
            return np.asarray(step / length)
    if len(order) < 2:
        return np.full(2, np.nan)
    arms = joined.m1.arm_headings[node][joined.m1.arm_passable[node]]
    if not len(arms):
        return np.full(2, np.nan)
    nearest = min(order[:-1], key=lambda k: float(np.linalg.norm(p[joined.i[k]] - p[node])))
    step = p[node] - p[joined.i[nearest]]
    ways = np.column_stack([np.cos(arms), np.sin(arms)])
    return np.asarray(ways[int(np.argmax(np.abs(ways @ step)))])
