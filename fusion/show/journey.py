"""`Journey`: what a log says of a drive, as arrays, in the frame that its odometry began in."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Detection, Event, Odometry, Scan

Array = NDArray[np.float64]

#: So many poses and scan points are kept for drawing; of more, every second, fourth, ... one.
MAX_POSES, MAX_POINTS = 20_000, 40_000


@dataclass(frozen=True, eq=False, slots=True)
class Journey:
    """A drive by dead reckoning and what was sensed on it.

    ``odometry`` (n, 4): time [s], x, y [m], theta [rad, unwrapped], beginning at the origin. ``detections`` (m, 3):
    time, range [m], bearing [rad]. ``points`` (s, 3): what range scans hit, likewise. ``events``: how many there were.
    """

    odometry: Array
    detections: Array
    points: Array
    events: int

    @property
    def length(self) -> float:
        """Driven distance [m] by odometry."""
        return float(np.hypot(*np.diff(self.odometry[:, 1:3], axis=0).T).sum())

    @property
    def duration(self) -> float:
        """Time [s] from the first to the last pose."""
        return float(self.odometry[-1, 0] - self.odometry[0, 0]) if len(self.odometry) else 0.0


def journey(events: Iterable[Event]) -> Journey:
    """Goes once through the events of a log, in bounded memory but for its detections.

    >>> drive = journey([Odometry(0.0, 5.0, 5.0, 0.0), Odometry(1.0, 6.0, 5.0, 0.0), Detection(1.0, "door", 2.0, 0.0)])
    >>> drive.odometry[:, 1].tolist(), drive.length, drive.events
    ([0.0, 1.0], 1.0, 3)
    """
    poses, points = _Thinned(MAX_POSES), _Thinned(MAX_POINTS)
    detections: list[tuple[float, float, float]] = []
    last: tuple[float, ...] | None = None
    count = 0
    for event in events:
        count += 1
        if isinstance(event, Odometry):
            theta = event.theta if last is None else last[3] + math.remainder(event.theta - last[3], math.tau)
            last = (event.t, event.x, event.y, theta)
            poses.add(last)
        elif isinstance(event, Detection):
            detections.append((event.t, event.range, event.bearing))
        elif isinstance(event, Scan):
            for k, distance in enumerate(event.ranges):
                if distance is not None:
                    points.add((event.t, distance, event.start + k * event.step))
    if last is not None and poses.rows[-1] != last:
        poses.rows.append(last)
    odometry = np.array(poses.rows, dtype=float).reshape(-1, 4)
    if len(odometry):
        start = odometry[0, 1:].copy()
        odometry[:, 1:3] = se2.transform(se2.inverse(start), odometry[:, 1:3])
        odometry[:, 3] -= start[2]
    return Journey(odometry, _readings(detections), _readings(points.rows), count)


def _readings(rows: Sequence[tuple[float, ...]]) -> Array:
    return np.array(rows, dtype=float).reshape(-1, 3)


class _Thinned:
    """Rows of a stream of unknown length: at most ``most``, evenly thinned, the first one always kept."""

    def __init__(self, most: int) -> None:
        self.rows: list[tuple[float, ...]] = []
        self._most, self._every, self._seen = most, 1, 0

    def add(self, row: tuple[float, ...]) -> None:
        if self._seen % self._every == 0:
            self.rows.append(row)
            if len(self.rows) > self._most:
                self.rows = self.rows[::2]
                self._every *= 2
        self._seen += 1


def poses_at(path: Array, times: Array) -> Array:
    """Poses (k, 3) at ``times`` (k,) [s] on a path (n, 4) of time, x, y, theta, between its poses in proportion.

    >>> poses_at(np.array([[0.0, 0.0, 0.0, 3.0], [1.0, 2.0, 0.0, -3.0]]), np.array([0.5])).round(3).tolist()
    [[1.0, 0.0, 3.142]]
    """
    theta = np.unwrap(path[:, 3])
    return np.column_stack([np.interp(times, path[:, 0], column) for column in (path[:, 1], path[:, 2], theta)])


def corrected(odometry: Array, path: Array) -> Array:
    """Odometry (n, 4) that begins anew at each pose of a coarser but better ``path`` (m, 4).

    >>> odometry = np.array([[0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [2.0, 2.0, 0.0, 0.0]])
    >>> corrected(odometry, np.array([[0.0, 5.0, 5.0, 0.0], [1.5, 5.0, 6.0, np.pi / 2]])).round(3)[:, 1:3].tolist()
    [[5.0, 5.0], [6.0, 5.0], [5.0, 6.5]]
    """
    if not len(odometry) or not len(path):
        return path
    begun = np.clip(np.searchsorted(path[:, 0], odometry[:, 0], side="right") - 1, 0, None)
    since = se2.between(poses_at(odometry, path[:, 0])[begun], odometry[:, 1:])
    return np.column_stack([odometry[:, 0], se2.compose(path[begun, 1:], since)])


def sensed_at(path: Array, readings: Array) -> Array:
    """Points (k, 2) that readings (k, 3) of time, range and bearing lie at, seen from a path (n, 4)."""
    if not len(path) or not len(readings):
        return np.zeros((0, 2))
    pose = poses_at(path, readings[:, 0])
    ahead = pose[:, 2] + readings[:, 2]
    return np.asarray(pose[:, :2] + readings[:, 1:2] * np.column_stack([np.cos(ahead), np.sin(ahead)]))
