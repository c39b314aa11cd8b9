"""Where the other robot has been: which landmarks it should have seen, and how much corridor both travelled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from mapfuse.datasets import se2

from .prepared import PreparedMap
from .tomap import OTHER_PATHS

Array = NDArray[np.float64]

#: A landmark this close [m] to the end of a travelled link is not passed but reached.
END_MARGIN_M = 1.0


@dataclass(frozen=True, eq=False)
class Segments:
    """Travelled corridors as segments: ``start`` and ``end`` (m, 2) [m]."""

    start: Array
    end: Array

    def __len__(self) -> int:
        return len(self.start)

    @property
    def length(self) -> Array:
        """Lengths (m,) [m]."""
        return np.asarray(np.linalg.norm(self.end - self.start, axis=1))

    @property
    def direction(self) -> Array:
        """Unit vectors (m, 2)."""
        return (self.end - self.start) / np.maximum(self.length, 1e-9)[:, None]

    @classmethod
    def of(cls, prepared: PreparedMap, positions: Array) -> Segments:
        """The straight travelled links of a map, its landmarks being at ``positions`` (n, 2)."""
        ends = positions[prepared.corridors]
        return cls(ends[:, 0], ends[:, 1])


def passed(points: Array, segments: Segments, width: float) -> NDArray[np.bool_]:
    """Which segments pass which points: lateral offset below ``width`` [m], inside the ends; (points, segments)."""
    if not len(points) or not len(segments):
        return np.zeros((len(points), len(segments)), dtype=bool)
    offset = points[:, None, :] - segments.start[None]
    along = np.einsum("psi,si->ps", offset, segments.direction)
    across = offset[..., 1] * segments.direction[:, 0] - offset[..., 0] * segments.direction[:, 1]
    inside = (along > END_MARGIN_M) & (along < segments.length - END_MARGIN_M)
    return np.asarray(inside & (np.abs(across) < width))


def overlap_length(
    segments1: Segments, segments2: Segments, width: float, angle: float, end_margin: float = 0.0
) -> float:
    """Length [m] of corridor that both travelled: parallel within ``angle`` [rad], within ``width`` [m] across.

    Symmetric: the mean of what map 1's links cover of map 2's and the reverse. ``end_margin`` [m]: what the covering
    link doesn't cover at either end, as in `passed`.
    """
    return (
        _covered(segments1, segments2, width, angle, end_margin)
        + _covered(segments2, segments1, width, angle, end_margin)
    ) / 2


def _covered(a: Segments, b: Segments, width: float, angle: float, end_margin: float) -> float:
    """Length [m] of the segments ``a`` that lies alongside one of ``b``."""
    if not len(a) or not len(b):
        return 0.0
    cosine = a.direction @ b.direction.T
    to_start, to_end = b.start[None] - a.start[:, None], b.end[None] - a.start[:, None]
    s, e = (np.einsum("abi,ai->ab", to, a.direction) for to in (to_start, to_end))
    margin = end_margin * np.abs(cosine)
    low, high = np.minimum(s, e) + margin, np.maximum(s, e) - margin
    low, high = np.clip(low, 0, a.length[:, None]), np.clip(high, 0, a.length[:, None])
    # across at the middle of the stretch that lies alongside
    share = np.where(np.abs(e - s) > 1e-9, ((low + high) / 2 - s) / np.where(np.abs(e - s) > 1e-9, e - s, 1), 0.5)
    middle = to_start + share[..., None] * (to_end - to_start)
    across = np.abs(middle[..., 1] * a.direction[:, None, 0] - middle[..., 0] * a.direction[:, None, 1])
    alongside = (np.abs(cosine) > np.cos(angle)) & (across < width) & (high > low)
    return sum(_union(low[k, alongside[k]], high[k, alongside[k]]) for k in np.flatnonzero(alongside.any(axis=1)))


def _union(low: Array, high: Array) -> float:
    """Length of the union of intervals."""
    order = np.argsort(low)
    reach = np.maximum.accumulate(np.concatenate([[-np.inf], high[order]]))
    return float(np.clip(high[order] - np.maximum(low[order], reach[:-1]), 0, None).sum())


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
        """Area [m^2], or that of the part it has in common with another one; on a grid of a fifth of the radius."""
        if not len(self.centres):
            return 0.0
        radius = self.radius if other is None else min(self.radius, other.radius)
        low, high = self.centres.min(axis=0) - self.radius, self.centres.max(axis=0) + self.radius
        step = max(radius / 8, float((high - low).max()) / 400)
        axes = [np.arange(low[k] + step / 2, high[k], step) for k in range(2)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        inside = self.contains(grid)
        if other is not None:
            inside &= other.contains(grid)
        return float(inside.sum()) * step**2
