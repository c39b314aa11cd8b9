"""What walls say against a hypothesis: ways through walls, and walls where the other robot saw none.

Under a wrong hypothesis one robot drives through the other's walls, or looks at a place where the other map has a wall
and sees none. Both are lengths and counts of places, after what a map may be wrong by is allowed for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mapfuse.datasets import se2
from mapfuse.datasets.maps import LandmarkMap

from .walls import WallConfig, align, segments, wall_points

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SpaceConfig:
    """``margin_m``: a wall counts as crossed, or as missing, only where it is by more than this.

    ``reach_m``: how far from its way a robot sees walls for sure. ``crossing_nats``: what a wall that a way leads
    through takes off; ``missing_nats_per_m``: a metre of wall that should have been seen; ``most_nats``: all together.
    """

    margin_m: float = 0.5
    reach_m: float = 2.5
    crossing_nats: float = 3.0
    missing_nats_per_m: float = 1.5
    most_nats: float = 30.0


@dataclass(frozen=True, slots=True)
class WallEvidence:
    """``crossed``: walls that a way leads through; ``missing_m``: wall that the other robot should have seen.

    ``nats``: what both take off the log odds of the hypothesis, zero or less.
    """

    crossed: int
    missing_m: float
    nats: float


def wall_evidence(
    map1: LandmarkMap, map2: LandmarkMap, T12: ArrayLike, config: SpaceConfig | None = None
) -> WallEvidence | None:
    """What walls and ways of both maps say against ``T12`` (3,), each map's against the other's.

    None where a map has no walls or no way: nothing can be said then. The hypothesis is refined by its walls first
    (`mapfuse.fusion.walls.align`), so that what it is slightly off by is not held against it.
    """
    config = config or SpaceConfig()
    way1, way2 = way_of(map1), way_of(map2)
    if not map1.walls or not map2.walls or len(way1) < 2 or len(way2) < 2:
        return None
    T = np.array(T12, dtype=float)
    laid = align(map1.walls, map2.walls, T, WallConfig(gate_m=2 * config.margin_m))
    if laid is not None and np.hypot(*(laid.T12 - T)[:2]) < 4 * config.margin_m:
        T = laid.T12
    walls2 = [se2.transform(T, wall) for wall in map2.walls]
    way2 = se2.transform(T, way2)
    crossed = crossings(map1.walls, way2, config.margin_m) + crossings(walls2, way1, config.margin_m)
    missing = missing_walls(map1.walls, walls2, way2, config) + missing_walls(walls2, map1.walls, way1, config)
    nats = -min(crossed * config.crossing_nats + missing * config.missing_nats_per_m, config.most_nats)
    return WallEvidence(crossed, missing, nats)


def way_of(map_: LandmarkMap) -> Array:
    """Where the robot drove (n, 2) [m], from the map's path, every half a metre; empty without a path."""
    if map_.path is None or not len(map_.path):
        return np.zeros((0, 2))
    at = np.asarray(map_.path)[:, 1:3]
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))])
    if driven[-1] == 0:
        return at[:1]
    steps = np.linspace(0.0, driven[-1], max(2, int(np.ceil(driven[-1] / 0.5)) + 1))
    return np.column_stack([np.interp(steps, driven, column) for column in at.T])


def crossings(walls: Sequence[ArrayLike], way: Array, margin_m: float) -> int:
    """How many walls a way (n, 2) leads through, from clearly before to clearly behind, and not at their ends.

    >>> wall = [[[0.0, -2.0], [0.0, 2.0]]]
    >>> [crossings(wall, np.array([[-3.0, y], [3.0, y]]), 0.5) for y in (0.0, 1.9)]
    [1, 0]
    """
    lines = segments(walls)
    if not len(lines) or len(way) < 2:
        return 0
    a, along = lines[:, 0], lines[:, 1] - lines[:, 0]
    length = np.hypot(*along.T)
    unit = along / length[:, None]
    off = way[None] - a[:, None]
    side = unit[:, None, 0] * off[..., 1] - unit[:, None, 1] * off[..., 0]  # (walls, way): left of the wall is positive
    place = np.einsum("wk,wnk->wn", unit, off)
    turned = (side[:, :-1] * side[:, 1:]) < 0
    share = np.where(turned, side[:, :-1] / np.where(turned, side[:, :-1] - side[:, 1:], 1.0), 0.0)
    met = place[:, :-1] + share * (place[:, 1:] - place[:, :-1])
    through = turned & (met > margin_m) & (met < (length - margin_m)[:, None])
    return int(sum(_deep(side[w], np.flatnonzero(through[w]), margin_m) for w in np.flatnonzero(through.any(axis=1))))


def _deep(side: Array, at: NDArray[np.intp], margin_m: float) -> bool:
    """Whether a way gets further than the margin to both sides of a wall around one of the places where it crosses."""
    for k in at:
        before, after = side[k::-1], side[k + 1 :]
        ends = [np.flatnonzero(np.sign(part) != np.sign(part[0])) for part in (before, after)]
        parts = [part[: end[0]] if len(end) else part for part, end in zip((before, after), ends, strict=True)]
        if all(np.abs(part).max() > margin_m for part in parts):
            return True
    return False


def missing_walls(walls: Sequence[ArrayLike], others: Sequence[ArrayLike], way: Array, config: SpaceConfig) -> float:
    """Length [m] of ``walls`` that a robot on ``way`` (n, 2) should have seen, but that its own, ``others``, lack.

    It should have seen what is within its reach with none of its own walls in between.
    """
    spacing = 0.25
    points = wall_points(walls, spacing).points
    own = wall_points(others, spacing).points
    if not len(points) or not len(own) or not len(way):
        return 0.0
    lacking = cKDTree(own).query(points)[0] > config.margin_m
    near, nearest = (np.asarray(found) for found in cKDTree(way).query(points))
    asked = lacking & (near < config.reach_m)
    seen = _clear(way[nearest[asked]], points[asked], segments(others))
    return float(seen.sum() * spacing)


def _clear(eyes: Array, points: Array, lines: Array) -> NDArray[np.bool_]:
    """Whether nothing of ``lines`` (n, 2, 2) lies between each eye (k, 2) and its point (k, 2)."""
    if not len(eyes) or not len(lines):
        return np.ones(len(eyes), dtype=bool)
    ray, wall = (points - eyes)[:, None], (lines[:, 1] - lines[:, 0])[None]
    between = lines[None, :, 0] - eyes[:, None]
    cross = ray[..., 0] * wall[..., 1] - ray[..., 1] * wall[..., 0]
    parallel = np.abs(cross) < 1e-12
    safe = np.where(parallel, 1.0, cross)
    along_ray = (between[..., 0] * wall[..., 1] - between[..., 1] * wall[..., 0]) / safe
    along_wall = (between[..., 0] * ray[..., 1] - between[..., 1] * ray[..., 0]) / safe
    hit = ~parallel & (along_ray > 0) & (along_ray < 1) & (along_wall >= 0) & (along_wall <= 1)
    return np.asarray(~hit.any(axis=1))
