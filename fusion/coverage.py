"""Where the other robot has been: which landmarks it should have seen, and how much corridor both travelled."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from mapfuse.datasets import se2
from mapfuse.datasets.compiled import kernels

from .prepared import PreparedMap
from .tomap import OTHER_PATHS

Array = NDArray[np.float64]

#: Corridors cross by at least this angle [degrees], and this clear of every landmark and of their ends [m].
CROSSING_DEG, CROSSING_CLEAR_M = 30.0, 2.5


def passing_kernels() -> ModuleType:
    """The compiled loops (`_passing_kernels`)."""
    return kernels("_passing_kernels", __package__, "who passed what")


@dataclass(frozen=True, eq=False)
class Segments:
    """Travelled corridors as segments: ``start`` and ``end`` (m, 2) [m]."""

    start: Array
    end: Array

    def __len__(self) -> int:
        return len(self.start)

    @classmethod
    def of(cls, prepared: PreparedMap, positions: Array) -> Segments:
        """The straight travelled links of a map, its landmarks being at ``positions`` (n, 2)."""
        return cls(positions[prepared.corridors[:, 0]], positions[prepared.corridors[:, 1]])


def passed(points: Array, segments: Segments, width: float, margin: float = 0.0) -> NDArray[np.bool_]:
    """Which segments pass which points: lateral offset below ``width`` [m], inside the ends by ``margin`` [m];
    (points, segments)."""
    by: NDArray[np.bool_] = passing_kernels().passed(points, segments.start, segments.end, width, margin)[0]
    return by


def overlap_length(segments1: Segments, segments2: Segments, width: float, angle: float) -> float:
    """Length [m] of corridor that both travelled: parallel within ``angle`` [rad], within ``width`` [m] across.

    Symmetric: the mean of what map 1's links cover of map 2's and the reverse.
    """
    one, two = (segments1.start, segments1.end), (segments2.start, segments2.end)
    cosine, covered = float(np.cos(angle)), passing_kernels().covered
    return float(covered(*one, *two, width, cosine) + covered(*two, *one, width, cosine)) / 2


def bare_crossings(one: Segments, other: Segments, landmarks: Array) -> Array:
    """Where corridors of the one cross those of the other (k, 2), and none of the ``landmarks`` (n, 2) is near.

    >>> ends = ((-9.0, 0.0), (9.0, 0.0)), ((1.0, 5.0), (1.0, -5.0))
    >>> along, across = (Segments(np.array([start]), np.array([end])) for start, end in ends)
    >>> bare_crossings(along, across, np.zeros((0, 2))).tolist()
    [[1.0, 0.0]]
    >>> bare_crossings(along, across, np.array([[2.0, 0.0]])).tolist()
    []
    """
    ends = (one.start, one.end, other.start, other.end)
    sine = float(np.sin(np.deg2rad(CROSSING_DEG)))
    return np.asarray(passing_kernels().crossings(*ends, landmarks, CROSSING_CLEAR_M, sine))


def _ways(prepared: PreparedMap) -> Array:
    """Where the map's robot was (k, 2) [m]; in a merged map, all its robots."""
    paths = [prepared.map.path] if prepared.map.path is not None else []
    paths += [np.asarray(path, dtype=float) for path in prepared.map.extra.get(OTHER_PATHS, {}).values()]
    return np.concatenate([np.zeros((0, 2)), *(path[:, 1:3] for path in paths)])


@dataclass(frozen=True, eq=False)
class SeenArea:
    """Where a robot would have seen a point landmark: discs of ``radius`` [m] around its path or its landmarks."""

    centres: Array
    radius: float

    @classmethod
    def of(cls, prepared: PreparedMap, points: NDArray[np.intp]) -> SeenArea:
        """From the map's point landmarks (places ``points``), in the map's frame.

        With a path: as far around it as nine in ten of the landmarks lie from it. Without one a robot is taken to have
        seen what is no further from one of its landmarks than the gaps between these: nine in ten of the edges of
        their minimum spanning tree.
        """
        at = prepared.positions[points]
        if len(at) < 2:
            return cls(at, 1.0)
        path = _ways(prepared)
        if len(path):
            return cls(path, max(float(np.quantile(cKDTree(path).query(at)[0], 0.9)), 0.5))
        edges = minimum_spanning_tree(squareform(pdist(at))).data
        return cls(at, max(float(np.quantile(edges, 0.9)) if len(edges) else 0.0, 0.5))

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Which points (k, 2) lie inside."""
        if not len(self.centres) or not len(points):
            return np.zeros(len(points), dtype=bool)
        return np.asarray(cKDTree(self.centres).query(points)[0] < self.radius)

    def moved(self, T12: Array) -> SeenArea:
        """The same area in frame 1, this map being map 2."""
        return SeenArea(se2.transform(T12, self.centres), self.radius)

    def area(self, other: SeenArea | None = None) -> float:
        """Area [m^2], or that of the part it has in common with another one; on a grid of an eighth of the radius."""
        if not len(self.centres):
            return 0.0
        radius = self.radius if other is None else min(self.radius, other.radius)
        low, high = self.centres.min(axis=0) - self.radius, self.centres.max(axis=0) + self.radius
        step = max(radius / 8, float((high - low).max()) / 400)
        shape = tuple(np.maximum(np.ceil((high - low) / step - 0.5), 1).astype(int).tolist())
        painted = passing_kernels().painted
        inside = painted(self.centres, self.radius, low, step, shape)
        if other is not None:
            inside &= painted(other.centres, other.radius, low, step, shape)
        return float(inside.sum()) * step**2

    @cached_property
    def own_area(self) -> float:
        """Area [m^2] of the whole, looked up."""
        return self.area()
