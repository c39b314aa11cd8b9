"""Maps as bodies in space, in plain arrays: what a viewer draws and a file of triangles holds; no display is needed.

Each map is a `Layer`: landmarks as prisms whose outline says what they are, links as flat bars, walls extruded, 95 %
ellipses as flat ellipsoids. Recorded maps lie one above the other, the merged one on top.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.arms import Kind
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.values import frozen_array

from ..result import FusedMap
from .scene import COMMON_OWNER, Scene, scene_of_group, scene_of_map
from .style import CHI2_95, COMMON, OWNERS

Array = NDArray[np.float64]
Triangles = NDArray[np.intp]

#: Heights [m] of landmarks and walls, half that of ellipsoids, and the gap from layer to layer per metre of extent.
LANDMARK_M, WALL_M, ELLIPSOID_M, GAP = 0.6, 1.2, 0.08, 0.12
#: Corners of a landmark's outline, and the turn [rad] of the first one.
OUTLINES = {
    Kind.CORNER: (4, np.pi / 4), Kind.T_JUNCTION: (3, np.pi / 2), Kind.CROSSING: (8, 0.0), Kind.END: (5, np.pi / 2),
    Kind.DOOR: (4, 0.0), Kind.CORRIDOR: (4, 0.0), Kind.UNKNOWN: (6, 0.0), Kind.POINT: (16, 0.0),
}  # fmt: skip


@dataclass(frozen=True, eq=False, slots=True)
class Body:
    """Triangles (m, 3) over ``vertices`` (n, 3) [m] with ``colours`` (n, 3) in [0, 1]."""

    vertices: Array
    triangles: Triangles
    colours: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", frozen_array(self.vertices))
        object.__setattr__(self, "colours", frozen_array(self.colours))

    def moved(self, T: Array, up: float = 0.0) -> Body:
        """The body where ``T`` (3,) lays it in the plane, and so much higher [m]."""
        at = self.vertices.copy()
        at[:, :2] = se2.transform(T, at[:, :2])
        at[:, 2] += up
        return Body(at, self.triangles, self.colours)


@dataclass(frozen=True, eq=False, slots=True)
class Layer:
    """One map as a body in its own frame; it lies at ``pose`` (3,) and ``height`` [m], coming from ``start`` (3,)."""

    name: str
    body: Body
    pose: Array
    start: Array
    height: float

    def at(self, share: float) -> Body:
        """The body after that share, in [0, 1], of its way from start to pose."""
        return self.body.moved(between(self.start, self.pose, share), self.height)


def between(start: Array, end: Array, share: float) -> Array:
    """The pose (3,) after a share of the way, turning the short way round.

    >>> between(np.array([0.0, 0.0, 3.0]), np.array([2.0, 0.0, -3.0]), 0.5).round(3).tolist()
    [1.0, 0.0, 3.142]
    """
    turn = start[2] + share * se2.wrap(end[2] - start[2])
    return np.array([*(start[:2] + share * (end[:2] - start[:2])), float(se2.wrap(turn))])


def together(bodies: Iterable[Body]) -> Body:
    """All bodies as one."""
    parts = [body for body in bodies if len(body.vertices)]
    if not parts:
        return Body(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp), np.zeros((0, 3)))
    offsets = np.cumsum([0, *(len(body.vertices) for body in parts[:-1])])
    return Body(
        np.concatenate([body.vertices for body in parts]),
        np.concatenate([body.triangles + offset for body, offset in zip(parts, offsets, strict=True)]),
        np.concatenate([body.colours for body in parts]),
    )


def layers_of_map(map_: LandmarkMap) -> tuple[Layer, ...]:
    """One map, lying in its own frame."""
    return (Layer(map_.name, body_of(scene_of_map(map_)), np.zeros(3), np.zeros(3), 0.0),)


def layers_of_fused(fused: FusedMap, group: int = 0) -> tuple[Layer, ...]:
    """A group's recorded maps, each a layer that moves to its place, and the merged map on top.

    Of an ambiguous pair or one without overlap the two maps, the second one where its best hypothesis has it.
    """
    names = fused.groups[group] if fused.groups else ()
    poses = {name: fused.frames[name].T.array for name in names if name in fused.frames}
    if len(names) < 2 and fused.pairs and fused.pairs[0].T12 is not None:
        first, second = fused.pairs[0].maps
        poses = {first: np.zeros(3), second: fused.pairs[0].T12.array}
    recorded = [
        (name, scene_of_map(fused.sources[name], fused.maps.index(name))) for name in poses if name in fused.sources
    ]
    merged = scene_of_group(fused, group) if len(names) > 1 or not recorded else None
    scenes = [scene for _, scene in recorded] + ([merged] if merged is not None else [])
    gap = max(1.5 * WALL_M, GAP * max((float(np.ptp(scene.extent, axis=0).max()) for scene in scenes), default=0.0))
    found = [
        Layer(name, body_of(scene), poses[name], _apart(k, recorded), k * gap)
        for k, (name, scene) in enumerate(recorded)
    ]
    if merged is not None:
        found.append(Layer("merged map", body_of(merged), np.zeros(3), np.zeros(3), len(recorded) * gap))
    return tuple(found)


def _apart(k: int, recorded: Sequence[tuple[str, Scene]]) -> Array:
    """Where the k-th map starts: beside those before it."""
    before = sum(float(np.ptp([*scene.extent], axis=0)[0]) for _, scene in recorded[:k])
    return np.array([1.2 * before, 0.0, 0.0])


def body_of(scene: Scene) -> Body:
    """Everything of a scene as one body."""
    size = _size(scene.positions)
    parts = [_wall(wall) for wall in scene.walls if len(wall) > 1]
    parts += [
        _bar(scene.positions[a], scene.positions[b], 0.12 * size, 0.04, _colour(int(k)))
        for (a, b), k in zip(scene.links, scene.link_owners, strict=True)
    ]
    parts += [
        _ellipsoid(scene.positions[k], C, _colour(int(scene.owners[k])))
        for k, C in zip(scene.covariance_of.tolist(), scene.covariances, strict=True)
    ]
    for k, at in enumerate(scene.positions):
        colour = _colour(int(scene.owners[k]))
        # what may not be there is pale, and half as high
        pale, height = (0.6, 0.5 * LANDMARK_M) if scene.doubtful[k] else (0.0, LANDMARK_M)
        parts.append(_prism(at, scene.kinds[k], size, height, colour + pale * (1 - colour)))
    return together(parts)


def _size(positions: Array) -> float:
    """Radius [m] of landmarks, by how far they reach."""
    return float(np.clip(0.006 * np.ptp(positions, axis=0).max(), 0.15, 3.0)) if len(positions) > 1 else 0.3


def _colour(owner: int) -> Array:
    fill = COMMON.fill if owner == COMMON_OWNER else OWNERS[owner % len(OWNERS)].fill
    return np.array([int(fill[k : k + 2], 16) / 255 for k in (1, 3, 5)])


def _painted(vertices: Array, triangles: Triangles, colour: Array) -> Body:
    return Body(vertices, triangles, np.broadcast_to(colour, vertices.shape).copy())


def _prism(at: Array, kind: Kind, radius: float, height: float, colour: Array) -> Body:
    """An upright prism, its outline a polygon with as many corners as the kind has."""
    n, turn = OUTLINES[kind]
    angle = turn + 2 * np.pi * np.arange(n) / n
    ring = at + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    low, high = np.column_stack([ring, np.zeros(n)]), np.column_stack([ring, np.full(n, height)])
    vertices = np.concatenate([low, high, [[*at, height]]])
    k, after = np.arange(n), (np.arange(n) + 1) % n
    sides = np.concatenate([np.column_stack([k, after, n + after]), np.column_stack([k, n + after, n + k])])
    return _painted(vertices, np.concatenate([sides, np.column_stack([n + k, n + after, np.full(n, 2 * n)])]), colour)


def _bar(a: Array, b: Array, width: float, height: float, colour: Array) -> Body:
    """A box from a to b (2,) in the plane."""
    along = b - a
    length = float(np.hypot(*along))
    across = np.array([-along[1], along[0]]) / length * width / 2 if length > 0 else np.zeros(2)
    ring = np.array([a - across, b - across, b + across, a + across])
    vertices = np.concatenate([np.column_stack([ring, np.full(4, z)]) for z in (0.0, height)])
    faces = [
        (0, 1, 5),
        (0, 5, 4),
        (1, 2, 6),
        (1, 6, 5),
        (2, 3, 7),
        (2, 7, 6),
        (3, 0, 4),
        (3, 4, 7),
        (4, 5, 6),
        (4, 6, 7),
    ]
    return _painted(vertices, np.array(faces, dtype=np.intp), colour)


def _wall(line: Array) -> Body:
    """A polyline (n, 2) as upright thin boxes."""
    grey = np.full(3, 0.72)
    return together(_bar(a, b, 0.06, WALL_M, grey) for a, b in pairwise(line))


def _ellipsoid(at: Array, C: Array, colour: Array) -> Body:
    """The 95 % ellipse of a position with covariance ``C`` (2, 2), flat."""
    across, around = 6, 20
    polar = np.linspace(0.0, np.pi, across + 1)
    turn = 2 * np.pi * np.arange(around) / around
    ring = np.column_stack([np.cos(turn), np.sin(turn)])
    values, vectors = np.linalg.eigh(C)
    shape = vectors * np.sqrt(CHI2_95 * np.maximum(values, 0.0))
    vertices = np.concatenate([
        np.column_stack([at + np.sin(p) * ring @ shape.T, np.full(around, ELLIPSOID_M * np.cos(p))]) for p in polar
    ])  # fmt: skip
    k, after = np.arange(around), (np.arange(around) + 1) % around
    faces = [
        np.column_stack(corners)
        for low in range(0, across * around, around)
        for corners in ((low + k, low + around + k, low + around + after), (low + k, low + around + after, low + after))
    ]
    return _painted(vertices, np.concatenate(faces), colour + 0.55 * (1 - colour))
