"""Which pieces of scans are of one wall, as it is followed from keyframe to keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import atan2, cos, hypot, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..logs import Sensors
from .config import MapperConfig
from .linear import Estimate
from .memory import Hit, Memory
from .walllines import WallPoints
from .walls import drawn_by_beams

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: No wall is a line to better than this [m] per piece: seen at once by a scan, drawn by a beam as the robot moves.
_ROUGH, _ROUGH_DRAWN = 0.005, 0.01
#: A piece continues a wall that was seen within so much way [m] if both of its ends lie within so much [m] of it, it is
#: turned by less [rad] and begins no further [m] along it from where that ends.
_RECENT, _OFF, _TURNED, _GAP = 6.0, 0.25, 0.15, 1.5
#: A wall is followed by its last pieces: what came before is bent by drift.
_LAST = 5
#: The more lines, the slower the smoother; those with the most pieces count.
MOST_LINES = 300


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """Straight pieces of wall (n,), as seen from keyframes.

    ``ends`` (n, 2, 2) [m] in the keyframe's frame, which lies to the left of the way from the first to the second;
    ``sigma`` (n,) [m]: sideways, of each of two points that stand for the piece.
    """

    keyframe: Indices
    ends: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.keyframe)

    def placed(self, poses: Array) -> Array:
        """Ends (n, 2, 2) in the map's frame, keyframes at ``poses`` (K, 3)."""
        return se2.transform(poses[self.keyframe][:, None], self.ends)


def seen_walls(memory: Memory, sensors: Sensors, config: MapperConfig) -> Seen:
    """The pieces in order of the way: of scans that were taken at a keyframe, and what beams drew from one on."""
    found: list[tuple[int, float, float, float, float, float]] = []
    for p in memory.pieces:
        if p.here and hypot(p.x2 - p.x1, p.y2 - p.y1) >= config.wall_length:
            sigma = sqrt(2 * sensors.scan_sigma**2 / p.readings + _ROUGH**2)
            found.append((p.keyframe, p.x1, p.y1, p.x2, p.y2, sigma))
    still = np.zeros((len(memory.keyframes), 3))
    of_keyframe: dict[int, list[Hit]] = {}
    for hit in memory.hits:
        of_keyframe.setdefault(hit.keyframe, []).append(hit)
    for k, hits in of_keyframe.items():
        for ends, readings in zip(*drawn_by_beams(hits, still, config), strict=True):
            sigma = sqrt(2 * sensors.scan_sigma**2 / readings + _ROUGH_DRAWN**2)
            found.append((k, *ends.ravel().tolist(), sigma))
    found.sort(key=lambda row: row[0])
    rows = np.array(found, dtype=float).reshape(-1, 6)
    ends = rows[:, 1:5].reshape(-1, 2, 2)
    a, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    right = along[:, 1] * a[:, 0] - along[:, 0] * a[:, 1] < 0
    ends = np.where(right[:, None, None], ends[:, ::-1], ends)
    return Seen(rows[:, 0].astype(np.intp), ends, rows[:, 5])


class _Track:
    """A wall as it is followed."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.way = 0.0
        self.last: list[tuple[float, float, float, float]] = []
        self.x = self.y = self.u = self.v = self.low = self.high = 0.0

    def take(self, piece: tuple[float, float, float, float], way: float) -> None:
        """Go on with a piece: the line through the ends of the last few by least squares."""
        self.way = way
        self.last = [*self.last[1 - _LAST :], piece]
        ends = [end for x1, y1, x2, y2 in self.last for end in ((x1, y1), (x2, y2))]
        n = len(ends)
        x, y = sum(e[0] for e in ends) / n, sum(e[1] for e in ends) / n
        xx = sum((e[0] - x) ** 2 - (e[1] - y) ** 2 for e in ends)
        xy = sum((e[0] - x) * (e[1] - y) for e in ends)
        angle = atan2(2 * xy, xx) / 2
        u, v = cos(angle), sin(angle)
        if u * (piece[2] - piece[0]) + v * (piece[3] - piece[1]) < 0:
            u, v = -u, -v
        self.x, self.y, self.u, self.v = x, y, u, v
        along = [(ex - x) * u + (ey - y) * v for ex, ey in ends]
        self.low, self.high = min(along), max(along)

    def off(self, piece: tuple[float, float, float, float]) -> float:
        """How far [m] the piece lies off at most; infinite where it can't be of this wall."""
        x1, y1, x2, y2 = piece
        length = hypot(x2 - x1, y2 - y1)
        if ((x2 - x1) * self.u + (y2 - y1) * self.v) / length < cos(_TURNED):
            return float("inf")
        s1, s2 = ((x - self.x) * self.u + (y - self.y) * self.v for x, y in ((x1, y1), (x2, y2)))
        if s1 - self.high > _GAP or self.low - s2 > _GAP:
            return float("inf")
        return max(abs((y - self.y) * self.u - (x - self.x) * self.v) for x, y in ((x1, y1), (x2, y2)))


def followed(seen: Seen, poses: Array, way: Sequence[float]) -> Indices:
    """The wall (n,) of each piece, numbered from 0; followed along the ``way`` (K,) [m], keyframes at ``poses``."""
    of = np.zeros(len(seen), dtype=np.intp)
    tracks: list[_Track] = []
    count = 0
    for i, ends in enumerate(seen.placed(poses).reshape(-1, 4).tolist()):
        piece = (ends[0], ends[1], ends[2], ends[3])
        here = way[seen.keyframe[i]]
        tracks = [track for track in tracks if here - track.way <= _RECENT]
        best = min(tracks, key=lambda track: track.off(piece), default=None)
        if best is None or best.off(piece) > _OFF:
            best = _Track(count)
            tracks.append(best)
            count += 1
        best.take(piece, here)
        of[i] = best.number
    return of


def numbered(of: Indices, least: int = 2) -> Indices:
    """Numbers (n,) of walls from 0 without gaps, the walls with the most pieces first; -1 for those of too few."""
    names, inverse, counts = np.unique(of, return_inverse=True, return_counts=True)
    order = np.argsort(-counts, kind="stable")[:MOST_LINES]
    new = np.full(len(names), -1, dtype=np.intp)
    kept = order[(counts[order] >= least) & (names[order] >= 0)]
    new[kept] = np.arange(len(kept))
    return new[inverse.reshape(-1)]


def on_lines(seen: Seen, of: Indices, poses: Array) -> tuple[WallPoints, Array]:
    """The walls' points, two for each piece, and lines (w, 2) to start with.

    Readings all along a piece know its line as two points do that stand where Gauss' quadrature has them, each for
    half of the readings.
    """
    kept = np.flatnonzero(of >= 0)
    a, b = seen.ends[kept, 0], seen.ends[kept, 1]
    share = np.sqrt(1 / 3) / 2
    points = np.concatenate([a + (0.5 - share) * (b - a), a + (0.5 + share) * (b - a)])
    keyframe, line = np.tile(seen.keyframe[kept], 2), np.tile(of[kept], 2)
    placed = se2.transform(poses[keyframe], points)
    count = int(of.max(initial=-1)) + 1
    anchors, lines = np.zeros((count, 2)), np.zeros((count, 2))
    along = np.diff(seen.placed(poses)[kept], axis=1)[:, 0]
    for w in range(count):
        own = placed[line == w]
        anchors[w] = own.mean(axis=0)
        u = along[of[kept] == w].sum(axis=0)
        _, vectors = np.linalg.eigh((own - anchors[w]).T @ (own - anchors[w]))
        direction = vectors[:, 1] if vectors[:, 1] @ u > 0 else -vectors[:, 1]
        lines[w, 0] = atan2(direction[0], -direction[1])  # the normal points to where it was seen from
    return WallPoints(keyframe, line, points, np.tile(seen.sigma[kept], 2), anchors), lines


@dataclass(frozen=True, eq=False, slots=True)
class Walls:
    """Pieces of walls, the wall ``of`` (n,) each (-1: none), and where all of it was taken to be.

    ``poses`` (K, 3): the keyframes; ``points`` on ``lines`` (w, 2): what is measured, and where the walls lie.
    """

    seen: Seen
    of: Indices
    poses: Array
    points: WallPoints
    lines: Array

    @classmethod
    def numbered(cls, seen: Seen, of: Indices, poses: Array) -> Walls:
        """Walls that were seen from more than one keyframe, numbered anew, where keyframes at ``poses`` see them."""
        of = numbered(of)
        return cls(seen, of, poses, *on_lines(seen, of, poses))

    def at(self, estimate: Estimate) -> Walls:
        """The same where an estimate has them."""
        return replace(self, poses=estimate.poses, lines=estimate.lines)


def followed_walls(memory: Memory, poses: Array, sensors: Sensors, config: MapperConfig) -> Walls:
    """The walls that a drive saw, keyframes at ``poses`` (K, 3), as far as they were followed without a break."""
    seen = seen_walls(memory, sensors, config)
    return Walls.numbered(seen, followed(seen, poses, [frame.way for frame in memory.keyframes]), poses)
