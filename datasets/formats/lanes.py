"""Ways along the lanes of a building: which of its doors and named places a robot comes to next from which.

Lanes lead from vertex to vertex, most of which have no name. A way leads from one landmark to another along lanes that
pass no third one. Where many meet in one hall everything would lead to everything, so of three landmarks that lead to
each other the longest way is left to the other two (the relative neighbourhood graph of Toussaint 1980, with lengths
along the lanes), which parts nothing that was joined.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .graphs import BENT, Way
from .reading import counted

Array = NDArray[np.float64]

#: Beyond so many landmarks the lanes of a level are left out: time grows by their third power.
MAX_LANDMARKS = 1000
#: Lanes that are longer than the straight line by this share and this [m] (doors are passed beside their middle) bend.
DETOUR_SHARE, DETOUR_M = 0.01, 0.1


@dataclass(frozen=True, slots=True)
class Lane:
    """A lane from vertex ``start`` to vertex ``end``, by their places; ``both`` ways or one."""

    start: int
    end: int
    both: bool = True


def lane_ways(
    ids: Sequence[str], doors: Array, named: Sequence[int], vertices: Array, lanes: Sequence[Lane]
) -> tuple[list[Way], tuple[str, ...]]:
    """Ways between landmarks, and remarks; ``ids``: of ``doors`` (m, 2, 2) [m], then of the ``named`` vertices.

    A lane comes by a door where it crosses its line. ``vertices`` (n, 2) [m]. Ways that aren't straight are marked
    `BENT` in their ``extra``.

    >>> xy = np.array([[0.0, 0.0], [3.0, 0.0], [9.0, 0.0]])
    >>> door = np.array([[[5.0, -1.0], [5.0, 1.0]]])
    >>> ways, _ = lane_ways(["front", "desk", "dock"], door, [0, 2], xy, [Lane(0, 1), Lane(1, 2, both=False)])
    >>> [(way.start, way.end) for way in ways]
    [('front', 'dock'), ('desk', 'front')]
    """
    if not lanes:
        return [], ()
    if len(ids) > MAX_LANDMARKS:
        return [], counted({"lanes": len(lanes)}, f"left out, of a level with more than {MAX_LANDMARKS:,} landmarks")
    apart = _distances(len(ids), doors, named, vertices, lanes)
    at = np.concatenate([doors.mean(axis=1), vertices[list(named)]])
    ways = []
    for a, row in enumerate(apart):
        between = np.minimum.reduce(np.maximum(row[:, None], apart), axis=0)
        straight = np.hypot(*(at - at[a]).T) * (1 + DETOUR_SHARE) + DETOUR_M
        ways += [
            Way(ids[a], ids[b], extra={BENT: True} if row[b] > straight[b] else {})
            for b in np.flatnonzero(np.isfinite(row) & (between >= row)).tolist()
        ]
    return ways, ()


def _distances(count: int, doors: Array, named: Sequence[int], vertices: Array, lanes: Sequence[Lane]) -> Array:
    """Lengths (count, count) [m] along lanes from landmark to landmark that pass no third one; infinite without one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    # a landmark is left from one node and reached at another, so that no way leads through it
    leave = np.arange(len(vertices)) + 2 * count
    reach = leave.copy()
    leave[list(named)] = len(doors) + np.arange(len(named))
    reach[list(named)] = leave[list(named)] + count
    rows: list[int] = []
    columns: list[int] = []
    lengths: list[float] = []
    for lane in lanes:
        for a, b, length in _pieces(lane, doors, vertices):
            for start, end in ((a, b), (b, a)) if lane.both else ((a, b),):
                rows.append(start if start < 0 else int(leave[start]))
                columns.append(end if end < 0 else int(reach[end]))
                lengths.append(length)
    size = len(vertices) + 2 * count
    starts = np.array([~row if row < 0 else row for row in rows], dtype=np.intp)
    ends = np.array([~column + count if column < 0 else column for column in columns], dtype=np.intp)
    # of doubled lanes the shortest counts, and none is of no length, which would be none at all
    weights = np.maximum(np.array(lengths), 1e-9)
    order = np.lexsort((weights, ends, starts))
    key = starts[order] * size + ends[order]
    first = order[np.unique(key, return_index=True)[1]]
    graph = coo_array((weights[first], (starts[first], ends[first])), shape=(size, size)).tocsr()
    found = np.asarray(dijkstra(graph, indices=np.arange(count)))[:, count : 2 * count]
    np.fill_diagonal(found, np.inf)
    return found


def _pieces(lane: Lane, doors: Array, vertices: Array) -> Iterator[tuple[int, int, float]]:
    """A lane cut where it crosses doors: from, to, length [m]; a door k is ``~k``."""
    a, b = vertices[lane.start], vertices[lane.end]
    along = b - a
    length = float(np.hypot(*along))
    before, at = lane.start, 0.0
    if len(doors):
        across = doors[:, 1] - doors[:, 0]
        off = doors[:, 0] - a
        turn = along[0] * across[:, 1] - along[1] * across[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (off[:, 0] * across[:, 1] - off[:, 1] * across[:, 0]) / turn
            aside = (off[:, 0] * along[1] - off[:, 1] * along[0]) / turn
        crossed = np.flatnonzero((turn != 0) & (share > 0) & (share < 1) & (aside >= 0) & (aside <= 1))
        for k in crossed[np.argsort(share[crossed], kind="stable")].tolist():
            yield before, ~k, (float(share[k]) - at) * length
            before, at = ~k, float(share[k])
    yield before, lane.end, (1 - at) * length
