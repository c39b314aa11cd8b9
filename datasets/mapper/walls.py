"""Walls: straight pieces of range scans, put where the map says they were seen, joined into polylines."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, pi, sin

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..logs import Scan, Sensors
from .config import MapperConfig
from .memory import Hit, Piece

Array = NDArray[np.float64]

#: Scans with steps above this [rad] are of single beams, each of which draws its own walls as the robot moves.
BEAMS = 0.15
#: How straight [m] what a beam draws is: the robot's own heading swings a little on its way.
_DRAWN = 0.08
#: A piece of wall holds at least so many readings of a scan.
_LEAST = 4
#: Pieces are of one wall where their directions differ by less [rad].
_ANGLE = 0.15
#: Ends of walls nearer than this [m] meet in a corner.
_CORNER = 0.7


def wall_pieces(
    scan: Scan, pose: tuple[float, float, float], sensors: Sensors, config: MapperConfig
) -> list[tuple[float, float, float, float, int]]:
    """Straight pieces of a scan taken at ``pose``, in that pose's frame: both ends [m] and the number of readings."""
    out: list[tuple[float, float, float, float, int]] = []
    for run in _runs(scan, pose, config.wall_gap):
        for first, last in _split(run, max(3 * sensors.scan_sigma, 0.04)):
            points = run[first : last + 1]
            if len(points) < _LEAST:
                continue
            (x1, y1), (x2, y2) = fitted(points, np.ones(len(points)))
            if hypot(x2 - x1, y2 - y1) >= config.wall_length / 2:
                out.append((float(x1), float(y1), float(x2), float(y2), len(points)))
    return out


def _runs(scan: Scan, pose: tuple[float, float, float], gap: float) -> list[Array]:
    """Neighbouring readings without a jump between them, as points (k, 2)."""
    x, y, theta = pose
    runs: list[list[tuple[float, float]]] = [[]]
    for k, distance in enumerate(scan.ranges):
        if distance is None or not 0 < distance < 1e6:
            runs.append([])
            continue
        angle = theta + scan.start + k * scan.step
        point = (x + distance * cos(angle), y + distance * sin(angle))
        if runs[-1]:
            px, py = runs[-1][-1]
            # readings at a flat angle are far from each other on one wall
            if hypot(point[0] - px, point[1] - py) > max(gap, 4 * abs(scan.step) * distance):
                runs.append([])
        runs[-1].append(point)
    return [np.array(run) for run in runs if len(run) >= _LEAST]


def _split(points: Array, tolerance: float) -> list[tuple[int, int]]:
    """First and last index of straight parts (iterative end point fit; Duda and Hart 1973)."""
    out: list[tuple[int, int]] = []
    left = [(0, len(points) - 1)]
    while left:
        a, b = left.pop()
        if b - a + 1 < _LEAST:
            continue
        chord = points[b] - points[a]
        length = float(np.hypot(*chord))
        inner = points[a : b + 1] - points[a]
        off = np.hypot(*inner.T) if length < 1e-9 else np.abs(chord[0] * inner[:, 1] - chord[1] * inner[:, 0]) / length
        k = int(np.argmax(off))
        if off[k] <= tolerance:
            out.append((a, b))
        elif k in (0, b - a):
            left.append((a, b - 1))
        else:
            left += [(a + k, b), (a, a + k)]
    return sorted(out)


def fitted(points: Array, weights: Array) -> Array:
    """The line through points (k, 2) by total least squares, from the first to the last of them along it: (2, 2)."""
    middle = weights @ points / weights.sum()
    centred = points - middle
    spread = (centred * weights[:, None]).T @ centred
    _, vectors = np.linalg.eigh(spread)
    direction = vectors[:, 1]
    along = centred @ direction
    return np.asarray(middle + np.outer([along.min(), along.max()], direction), dtype=float)


def scan_hits(scan: Scan, pose: tuple[float, float, float]) -> list[tuple[int, float, float]]:
    """Number of the beam and end (x, y) [m], in the frame of the ``pose`` that it was taken at, of each reading."""
    x, y, theta = pose
    return [
        (k, x + distance * cos(angle), y + distance * sin(angle))
        for k, distance in enumerate(scan.ranges)
        if distance is not None and 0 < distance < 1e6
        for angle in (theta + scan.start + k * scan.step,)
    ]


def drawn_by_beams(hits: Sequence[Hit], poses: Array, config: MapperConfig) -> tuple[Array, Array]:
    """Straight pieces (n, 2, 2) [m] that single beams drew while the robot moved, and the readings (n,) of each."""
    segments: list[Array] = []
    readings: list[float] = []
    for beam in sorted({hit.beam for hit in hits}):
        own = [hit for hit in hits if hit.beam == beam]
        points = se2.transform(poses[[hit.keyframe for hit in own]], np.array([(hit.x, hit.y) for hit in own]))
        scans = np.array([hit.scan for hit in own])
        apart = (np.hypot(*np.diff(points, axis=0).T) > config.wall_gap) | (np.diff(scans) > 1)
        for run in np.split(points, 1 + np.flatnonzero(apart)):
            for first, last in _split(run, _DRAWN):
                line = fitted(run[first : last + 1], np.ones(last + 1 - first))
                if np.hypot(*(line[1] - line[0])) >= config.wall_length:
                    segments.append(line)
                    readings.append(float(last + 1 - first))
    return np.array(segments).reshape(-1, 2, 2), np.array(readings)


def walls_of(pieces: Sequence[Piece], hits: Sequence[Hit], poses: Array, config: MapperConfig) -> tuple[Array, ...]:
    """Polylines (k, 2) [m] in the map's frame from what was seen from keyframes at ``poses`` (K, 3)."""
    found, counts = drawn_by_beams(hits, poses, config)
    if pieces:
        base = poses[[p.keyframe for p in pieces]]
        a = se2.transform(base, np.array([(p.x1, p.y1) for p in pieces]))
        b = se2.transform(base, np.array([(p.x2, p.y2) for p in pieces]))
        found = np.concatenate([found, np.stack([a, b], axis=1)])
        counts = np.concatenate([counts, [float(p.readings) for p in pieces]])
    if not len(found):
        return ()
    segments = _joined(found, counts, config)
    return _polylines([s for s in segments if np.hypot(*(s[1] - s[0])) >= config.wall_length])


class _Wall:
    """A wall as it grows: moments of its points, and its extent."""

    def __init__(self, segment: Array, weight: float) -> None:
        self.ends = segment
        self.weight = 0.0
        self.sum = np.zeros(2)
        self.moment = np.zeros((2, 2))
        self.line = segment
        self._add(segment, weight)
        self._fit()

    def _add(self, segment: Array, weight: float) -> None:
        for end in segment:
            self.weight += weight / 2
            self.sum = self.sum + weight / 2 * end
            self.moment = self.moment + weight / 2 * np.outer(end, end)

    def _fit(self) -> None:
        middle = self.sum / self.weight
        _, vectors = np.linalg.eigh(self.moment / self.weight - np.outer(middle, middle))
        direction = vectors[:, 1]
        along = (self.ends - middle) @ direction
        self.line = middle + np.outer([along.min(), along.max()], direction)

    def take(self, segment: Array, weight: float) -> None:
        """Add a piece."""
        self.ends = np.concatenate([self.line, segment])
        self._add(segment, weight)
        self._fit()


def _joined(segments: Array, readings: Array, config: MapperConfig) -> list[Array]:
    """Pieces of one wall joined, the longest first; each piece goes to the wall that it lies best on."""
    lengths = np.hypot(*(segments[:, 1] - segments[:, 0]).T)
    walls: list[_Wall] = []
    lines = np.zeros((0, 2, 2))
    for k in np.argsort(-lengths, kind="stable"):
        off = _distance_to_lines(segments[k], lines, config)
        best = int(np.argmin(off)) if len(off) else -1
        if best >= 0 and off[best] < config.wall_tolerance:
            walls[best].take(segments[k], readings[k])
            lines[best] = walls[best].line
        else:
            walls.append(_Wall(segments[k], readings[k]))
            lines = np.concatenate([lines, segments[k][None]])
    merged = [w.line for w in walls]
    weights = [w.weight for w in walls]
    return _merged_walls(merged, weights, config)


def _distance_to_lines(segment: Array, lines: Array, config: MapperConfig) -> Array:
    """How far (n,) [m] a piece's ends are off each line at most; infinite where it is turned or lies apart along it."""
    if not len(lines):
        return np.zeros(0)
    chord = lines[:, 1] - lines[:, 0]
    length = np.maximum(np.hypot(*chord.T), 1e-9)
    unit = chord / length[:, None]
    own = segment[1] - segment[0]
    own = own / max(float(np.hypot(*own)), 1e-9)
    turned = np.abs(unit[:, 0] * own[1] - unit[:, 1] * own[0])
    rel = segment[None] - lines[:, :1]
    along = np.einsum("nki,ni->nk", rel, unit)
    across = np.abs(rel[..., 1] * unit[:, None, 0] - rel[..., 0] * unit[:, None, 1]).max(axis=1)
    apart = np.maximum(np.maximum(along.min(axis=1) - length, -along.max(axis=1)), 0.0)
    return np.where((turned < np.sin(_ANGLE)) & (apart < config.wall_gap), across, np.inf)


def _merged_walls(lines: list[Array], weights: list[float], config: MapperConfig) -> list[Array]:
    """Walls that grew towards each other, joined until nothing joins any more."""
    while True:
        order = sorted(range(len(lines)), key=lambda k: (-weights[k], k))
        lines, weights = [lines[k] for k in order], [weights[k] for k in order]
        for k in range(len(lines) - 1, 0, -1):
            off = _distance_to_lines(lines[k], np.array(lines[:k]), config)
            best = int(np.argmin(off))
            if off[best] < config.wall_tolerance:
                points = np.concatenate([lines[best], lines[k]])
                share = np.repeat([weights[best], weights[k]], 2)
                lines[best] = fitted(points, share)
                weights[best] += weights[k]
                del lines[k], weights[k]
                break
        else:
            return lines


def _polylines(segments: list[Array]) -> tuple[Array, ...]:
    """Segments chained where their ends meet: each meets at the point where both lines cross."""
    left = [s.copy() for s in segments]
    chains: list[Array] = []
    while left:
        chain = left.pop(0)
        for _ in range(2):
            while (grown := _extended(chain, left)) is not None:
                chain = grown
            chain = chain[::-1]
        chains.append(chain)
    return tuple(chains)


def _extended(chain: Array, left: list[Array]) -> Array | None:
    """The chain with the nearest segment at its end, which leaves ``left``; None where none is near."""
    best: tuple[float, int, bool] | None = None
    for k, segment in enumerate(left):
        for turned in (False, True):
            start = segment[1] if turned else segment[0]
            away = float(np.hypot(*(start - chain[-1])))
            if away < _CORNER and (best is None or away < best[0]):
                best = (away, k, turned)
    if best is None:
        return None
    _, k, turned = best
    segment = left[k][::-1] if turned else left[k]
    corner = _crossing(chain[-2], chain[-1], segment[0], segment[1])
    if corner is None or np.hypot(*(corner - chain[-1])) > _CORNER or np.hypot(*(corner - segment[0])) > _CORNER:
        return None
    del left[k]
    return np.concatenate([chain[:-1], corner[None], segment[1:]])


def _crossing(a: Array, b: Array, c: Array, d: Array) -> Array | None:
    """Where the lines a-b and c-d cross; None where they are nearly parallel."""
    u, v = b - a, d - c
    cross = float(u[0] * v[1] - u[1] * v[0])
    if abs(cross) < sin(pi / 8) * float(np.hypot(*u) * np.hypot(*v)):
        return None
    w = c - a
    return np.asarray(a + u * float(w[0] * v[1] - w[1] * v[0]) / cross, dtype=float)
