"""One-to-one matches of two maps' landmarks under a T12: most matches first, then the smallest distances.

What counts is a maximum matching (no landmark twice, as many pairs as possible), among those the one with the
smallest sum of squared distances. Nearly all landmarks have no rival within reach, so only the connected pieces of
the "within reach" relation in which landmarks compete are solved as assignment problems.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Below this many landmark pairs all distances at once are faster than a grid.
_DENSE_PAIRS = 1 << 16
_CELLS_PER_AXIS = 2048


def label_codes(labels1: Sequence[str], labels2: Sequence[str]) -> tuple[Indices, Indices]:
    """Labels of two maps as integers, equal where the labels are; numbered in the labels' order.

    >>> [codes.tolist() for codes in label_codes(["door", "corner"], ["tree", "door"])]
    [[1, 0], [2, 1]]
    """
    code = {label: k for k, label in enumerate(sorted({*labels1, *labels2}))}
    return np.array([code[l] for l in labels1], dtype=np.intp), np.array([code[l] for l in labels2], dtype=np.intp)


@dataclass(frozen=True, slots=True)
class Matches:
    """Landmarks ``index1`` of map 1 and ``index2`` of map 2 that match, each at most once, and how far apart [m].

    All three have shape (k,), ordered by ``index1``.
    """

    index1: Indices
    index2: Indices
    distance: Array

    def __len__(self) -> int:
        return len(self.index1)


class PointGrid:
    """Points (n, 2) [m] in square cells, to find which of them are within ``reach_m`` of many places at once.

    Each cell lists the points that can be within reach of a place in it. Memory: nine entries a point and at most
    four million cells, whatever the extent.
    """

    def __init__(self, points: ArrayLike, reach_m: float) -> None:
        self.points = np.asarray(points, dtype=float).reshape(-1, 2)
        self.reach_m = float(reach_m)
        # Two empty rings: one that the listing of neighbours fills, one where places outside are clipped to.
        low = self.points.min(axis=0) if len(self.points) else np.zeros(2)
        extent = np.ptp(self.points, axis=0) if len(self.points) else np.zeros(2)
        self._size = np.maximum(max(self.reach_m, 1e-9), extent / _CELLS_PER_AXIS)
        self._low = low - 2 * self._size
        self._shape = (np.floor(extent / self._size) + 5).astype(np.intp)
        own = self._cells(self.points[:, 0], self.points[:, 1])
        ring = (np.arange(-1, 2)[:, None] * self._shape[1] + np.arange(-1, 2)).ravel()
        listed = (own[:, None] + ring).ravel()
        order = np.argsort(listed, kind="stable")
        self._members = order // len(ring)
        self._count = np.bincount(listed, minlength=int(self._shape.prod()))
        self._start = np.cumsum(self._count) - self._count
        self._at_points = self._count[own]

    @property
    def crowding(self) -> float:
        """How many points must be looked at around a place where one is, on average (1 or more)."""
        return float(self._at_points.mean()) if len(self.points) else 1.0

    @property
    def most_listed(self) -> int:
        """How many points must be looked at around any place at most (1 or more)."""
        return int(self._count.max(initial=1))

    def _cells(self, x: Array, y: Array) -> Indices:
        column, row = (
            np.clip((values - low) / size, 0, n - 1).astype(np.intp)
            for values, low, size, n in zip((x, y), self._low, self._size, self._shape, strict=True)
        )
        cells: Indices = column * self._shape[1] + row
        return cells

    def within_reach(self, x: Array, y: Array) -> tuple[Indices, Indices, Array]:
        """For places ``x``, ``y`` (m,): (place, point, squared distance [m^2]) of all within ``reach_m``."""
        cell = self._cells(x, y)
        occupied = np.flatnonzero(self._count[cell])
        cell = cell[occupied]
        n = self._count[cell]
        place = np.repeat(occupied, n)
        first = np.repeat(self._start[cell] - (np.cumsum(n) - n), n)
        point = self._members[first + np.arange(len(place))]
        squared = (x[place] - self.points[point, 0]) ** 2 + (y[place] - self.points[point, 1]) ** 2
        near = squared <= self.reach_m**2
        return place[near], point[near], squared[near]


def one_to_one(group: Indices, index1: Indices, index2: Indices, cost: Array) -> Mask:
    """Which edges make the matching of most edges, then least total cost, in each group separately.

    Parameters, all of shape (e,): edge k joins ``index1[k]`` and ``index2[k]`` within ``group[k]`` at ``cost[k]``
    >= 0; no edge is given twice. Memory grows with (groups) x (largest index).

    >>> zero, cost = np.zeros(3, dtype=int), np.array([0.1, 1.0, 1.0])
    >>> one_to_one(zero, np.array([0, 0, 1]), np.array([0, 1, 0]), cost).tolist()  # two matches beat one near one
    [False, True, True]
    """
    chosen = np.ones(len(index1), dtype=bool)
    if not len(index1):
        return chosen
    key1 = group * (index1.max() + 1) + index1
    key2 = group * (index2.max() + 1) + index2
    rivals = (np.bincount(key1)[key1] > 1) | (np.bincount(key2)[key2] > 1)
    contested = np.flatnonzero(rivals)
    if not len(contested):
        return chosen
    # needed where landmarks compete only, and half of what a first call takes to load
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    chosen[contested] = False
    nodes1, node1 = np.unique(key1[contested], return_inverse=True)
    nodes2, node2 = np.unique(key2[contested], return_inverse=True)
    size = len(nodes1) + len(nodes2)
    joined = coo_array((np.ones(len(contested), dtype=np.int8), (node1, len(nodes1) + node2)), shape=(size, size))
    n_pieces, components = connected_components(joined, directed=False)
    piece_of_node = components.astype(np.intp)
    piece = piece_of_node[node1]
    width1 = np.bincount(piece_of_node[: len(nodes1)], minlength=n_pieces)
    width2 = np.bincount(piece_of_node[len(nodes1) :], minlength=n_pieces)
    star = ((width1 == 1) | (width2 == 1))[piece]
    square = ((width1 == 2) & (width2 == 2))[piece]
    for part, solve in ((star, _solve_stars), (square, _solve_squares), (~star & ~square, _solve_pieces)):
        k = np.flatnonzero(part)
        if len(k):
            chosen[contested[k[solve(piece[k], node1[k], node2[k], cost[contested[k]])]]] = True
    return chosen


def _solve_stars(piece: Indices, node1: Indices, node2: Indices, cost: Array) -> Indices:
    """Pieces with one landmark on a side: one match, the nearest."""
    order = np.lexsort((node2, node1, cost, piece))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(piece[order]) > 0
    return order[first]


def _solve_squares(piece: Indices, node1: Indices, node2: Indices, cost: Array) -> Indices:
    """Pieces of two by two landmarks: the cheaper of the straight and the crossed pairing, if both are there."""
    order = np.lexsort((node2, node1, piece))
    start = np.flatnonzero(np.diff(piece[order], prepend=-1))
    which = np.cumsum(np.diff(piece[order], prepend=-1) > 0) - 1
    low1 = np.minimum.reduceat(node1[order], start)
    low2 = np.minimum.reduceat(node2[order], start)
    row = (node1[order] != low1[which]).astype(np.intp)
    column = (node2[order] != low2[which]).astype(np.intp)
    table = np.full((len(start), 2, 2), np.inf)
    table[which, row, column] = cost[order]
    crossed = table[:, 0, 1] + table[:, 1, 0] < table[:, 0, 0] + table[:, 1, 1]
    return np.asarray(order[(row != column) == crossed[which]])


def _solve_pieces(piece: Indices, node1: Indices, node2: Indices, cost: Array) -> Indices:
    """Any other pieces, one assignment problem each."""
    order = np.argsort(piece, kind="stable")
    start = np.flatnonzero(np.diff(piece[order], prepend=-1))
    row, column = _places_in_piece(piece, node1), _places_in_piece(piece, node2)
    bounds = [*start.tolist(), len(order)]
    heights = np.maximum.reduceat(row[order], start).tolist()
    widths = np.maximum.reduceat(column[order], start).tolist()
    from scipy.optimize import linear_sum_assignment

    # Leaving one more landmark unmatched must cost more than any choice among the distances.
    dear = (1.0 + np.minimum(heights, widths)) * np.maximum.reduceat(cost[order], start) + 1.0
    taken = np.zeros(len(order), dtype=bool)
    for k, absent in enumerate(dear.tolist()):
        edges = order[bounds[k] : bounds[k + 1]]
        table = np.full((heights[k] + 1, widths[k] + 1), absent)
        table[row[edges], column[edges]] = cost[edges]
        rows, columns = linear_sum_assignment(table)
        partner = np.zeros(heights[k] + 1, dtype=np.intp) - 1
        partner[rows] = columns
        taken[edges] = partner[row[edges]] == column[edges]
    return np.flatnonzero(taken)


def _places_in_piece(piece: Indices, node: Indices) -> Indices:
    """Each edge's node numbered from 0 within its piece."""
    order = np.lexsort((node, piece))
    sorted_piece, sorted_node = piece[order], node[order]
    new_piece = np.diff(sorted_piece, prepend=-1) > 0
    number = np.cumsum(new_piece | (np.diff(sorted_node, prepend=-1) != 0))
    place = np.empty(len(node), dtype=np.intp)
    place[order] = number - number[np.maximum.accumulate(np.where(new_piece, np.arange(len(node)), 0))]
    return place


def assign_points(
    points1: ArrayLike,
    points2: ArrayLike,
    gate_m: ArrayLike,
    labels1: Indices | None = None,
    labels2: Indices | None = None,
    grid: PointGrid | None = None,
) -> Matches:
    """One-to-one matches of points in one frame: most pairs first, then the least sum of squared distances.

    Parameters
    ----------
    points1, points2
        Positions (n1, 2) and (n2, 2) [m], both in the same frame.
    gate_m
        How far apart [m] two points may be: one number, (n2,) per point of the second set, or (n1, n2) per pair.
    labels1, labels2
        Integer codes (n1,), (n2,), see `label_codes`: only equal ones match. None: all match.
    grid
        A `PointGrid` of ``points1`` whose reach is not below the largest gate, to be used again and again.

    >>> m = assign_points([[0, 0], [5, 0]], [[5.2, 0], [0.1, 0], [9, 9]], gate_m=1.0)
    >>> m.index1.tolist(), m.index2.tolist(), m.distance.round(3).tolist()
    ([0, 1], [1, 0], [0.1, 0.2])
    """
    p1, p2 = np.asarray(points1, dtype=float).reshape(-1, 2), np.asarray(points2, dtype=float).reshape(-1, 2)
    gate = np.asarray(gate_m, dtype=float)
    if not len(p1) or not len(p2):
        nothing = np.zeros(0, dtype=np.intp)
        return Matches(nothing, nothing, np.zeros(0))
    if grid is None and len(p1) * len(p2) <= _DENSE_PAIRS:
        all_squared = (p1[:, 0, None] - p2[:, 0]) ** 2 + (p1[:, 1, None] - p2[:, 1]) ** 2
        near = all_squared <= gate**2
        if labels1 is not None and labels2 is not None:
            near &= labels1[:, None] == labels2
        i, j = np.nonzero(near)
        squared = all_squared[i, j]
    else:
        j, i, squared = (grid or PointGrid(p1, float(gate.max()))).within_reach(p2[:, 0], p2[:, 1])
        keep = squared <= np.broadcast_to(gate, (len(p1), len(p2)))[i, j] ** 2
        if labels1 is not None and labels2 is not None:
            keep &= labels1[i] == labels2[j]
        i, j, squared = i[keep], j[keep], squared[keep]
    chosen = np.flatnonzero(one_to_one(np.zeros(len(i), dtype=np.intp), i, j, squared))
    chosen = chosen[np.argsort(i[chosen])]
    return Matches(i[chosen], j[chosen], np.sqrt(squared[chosen]))


def assign(
    map1: LandmarkMap, map2: LandmarkMap, T12: Transform, gate_m: ArrayLike, use_types: bool = True
) -> tuple[tuple[str, str], ...]:
    """Correspondences (id in map 1, id in map 2) under ``T12``, one-to-one, in the order of map 1.

    ``gate_m`` [m]: as in `assign_points`. ``use_types``: only landmarks of one type match (the paper's H1).

    >>> from mapfuse.datasets.maps import Landmark
    >>> one = LandmarkMap("one", (Landmark("a", "door", 1.0, 0.0), Landmark("b", "tree", 1.1, 0.0)))
    >>> two = LandmarkMap("two", (Landmark("x", "tree", 0.0, 0.0),))
    >>> assign(one, two, Transform(1.0, 0.0, 0.0), gate_m=0.5)
    (('b', 'x'),)
    """
    labels1, labels2 = label_codes(map1.types, map2.types) if use_types else (None, None)
    q1 = se2.transform(T12.array, map2.positions)
    matches = assign_points(map1.positions, q1, gate_m, labels1, labels2)
    return tuple(
        (map1.ids[i], map2.ids[j]) for i, j in zip(matches.index1.tolist(), matches.index2.tolist(), strict=True)
    )
