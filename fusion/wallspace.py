"""What walls say against a hypothesis: ways through walls, and sights through walls.

Under a wrong hypothesis one robot drives through the other's walls, or sees a wall of its own through one of them. Both
count only beyond what a map may be wrong by, and walls that a map's own robot drove through count for nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mapfuse.datasets import se2
from mapfuse.datasets.maps import LandmarkMap

from .config import WallsConfig
from .walls import WallConfig, align, segments, wall_points

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WallEvidence:
    """``crossed``: walls that a way leads through; ``through_m``: wall that was seen through the other map's walls.

    ``nats``: what both take off the log odds of the hypothesis, zero or less.
    """

    crossed: int
    through_m: float
    nats: float


def wall_evidence(
    map1: LandmarkMap,
    map2: LandmarkMap,
    T12: ArrayLike,
    config: WallsConfig | None = None,
    placed: tuple[Array, Array] | None = None,
) -> WallEvidence | None:
    """What walls and ways of both maps say against ``T12`` (3,), each map's against the other's.

    None where a map has no walls or no way: nothing can be said then. ``placed``: where the landmarks of both maps lie
    under the hypothesis, (n1, 2) and (n2, 2) in frame 1, once the maps are bent onto each other; walls and ways are
    then bent as the landmarks near them. Without it the maps are rigid, and map 2 is first laid on its walls
    (`mapfuse.fusion.walls.align`), so that what the hypothesis is slightly off by is not held against it.
    """
    config = config or WallsConfig()
    way1, way2 = way_of(map1), way_of(map2)
    if not map1.walls or not map2.walls or len(way1) < 2 or len(way2) < 2:
        return None
    T = np.array(T12, dtype=float)
    laid = align(map1.walls, map2.walls, T, WallConfig(gate_m=2 * config.margin_m)) if placed is None else None
    if laid is not None and np.hypot(*(laid.T12 - T)[:2]) < 4 * config.margin_m:
        T = laid.T12
    walls1 = credible(map1.walls, way1, config.margin_m)
    walls2 = [se2.transform(T, line) for line in credible(map2.walls, way2, config.margin_m)]
    way2 = se2.transform(T, way2)
    if placed is not None:
        at2 = se2.transform(T, map2.positions)
        walls1, way1 = [bent(line, map1.positions, placed[0]) for line in walls1], bent(way1, map1.positions, placed[0])
        walls2, way2 = [bent(line, at2, placed[1]) for line in walls2], bent(way2, at2, placed[1])
    return against((walls1, way1), (walls2, way2), config)


def against(
    one: tuple[Sequence[ArrayLike], Array], other: tuple[Sequence[ArrayLike], Array], config: WallsConfig
) -> WallEvidence:
    """What walls and the way (n, 2) of either map say against the other's, all of them in one frame."""
    (walls1, way1), (walls2, way2) = one, other
    crossed = crossings(walls1, way2, config.margin_m) + crossings(walls2, way1, config.margin_m)
    through = seen_through(walls1, walls2, way2, config) + seen_through(walls2, walls1, way1, config)
    nats = -min(crossed * config.crossing_nats + through * config.through_nats, config.most_nats)
    return WallEvidence(crossed, through, nats)


def bent(points: Array, at: Array, to: Array, nearest: int = 4) -> Array:
    """Points (n, 2) displaced as the landmarks near them, which go from ``at`` (k, 2) to ``to`` (k, 2).

    Each of the nearest few counts by one over its squared distance, or over one square metre where it is nearer.

    >>> at = np.array([[0.0, 0.0], [100.0, 0.0]])
    >>> bent(np.array([[1.0, 0.0], [50.0, 0.0]]), at, at + [[0.0, 2.0], [0.0, 0.0]]).round(2).tolist()
    [[1.0, 2.0], [50.0, 1.0]]
    """
    if not len(at) or not len(points):
        return points
    count = min(nearest, len(at))
    distance, which = (np.asarray(found).reshape(len(points), count) for found in cKDTree(at).query(points, k=count))
    weight = 1 / np.maximum(distance, 1.0) ** 2
    moved = np.einsum("nk,nkc->nc", weight, (to - at)[which]) / weight.sum(axis=1, keepdims=True)
    return np.asarray(points + moved)


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


def seen_through(walls: Sequence[ArrayLike], own: Sequence[ArrayLike], way: Array, config: WallsConfig) -> float:
    """Length [m] of ``own`` walls that a robot saw from its ``way`` (n, 2) through ``walls``, which so aren't there.

    Seen is what is within its reach with none of its own walls in between. That a robot lacks a wall is not held
    against anything: it may have seen it too badly to record it.

    >>> own, other = [[[-2.0, 2.0], [2.0, 2.0]]], [[[-9.0, 1.0], [9.0, 1.0]]]
    >>> way = np.array([[-2.0, 0.0], [2.0, 0.0]])
    >>> [seen_through(walls, own, way, WallsConfig()) for walls in (other, own)]
    [4.0, 0.0]
    """
    spacing = 0.25
    points = wall_points(own, spacing).points
    if not len(points) or not len(way):
        return 0.0
    near, nearest = (np.asarray(found) for found in cKDTree(way).query(points))
    asked = (near > 2 * config.margin_m) & (near < config.reach_m)
    eyes, seen = way[nearest[asked]], points[asked]
    # up to a little before the wall that was seen
    before = seen - (seen - eyes) * (config.margin_m / near[asked])[:, None]
    through = _clear(eyes, before, segments(own)) & ~_clear(eyes, before, _shortened(walls, config.margin_m))
    return float(through.sum() * spacing)


def _shortened(walls: Sequence[ArrayLike], margin_m: float) -> Array:
    """Stretches (n, 2, 2) [m] without their ends, of which nobody knows where they are."""
    lines = segments(walls)
    along = lines[:, 1] - lines[:, 0]
    length = np.hypot(*along.T)
    cut = along * (margin_m / length)[:, None]
    return np.asarray(np.stack([lines[:, 0] + cut, lines[:, 1] - cut], axis=1)[length > 2 * margin_m])


def credible(walls: Sequence[ArrayLike], way: Array, margin_m: float) -> list[Array]:
    """The stretches (2, 2) of a map's walls that its own robot did not drive through."""
    return [line for line in segments(walls) if not crossings([line], way, margin_m)]


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
