"""When the robot passed a landmark, and whether it saw it then: counters, and the probability that it is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..logs import Sensors
from .memory import Memory

Array = NDArray[np.float64]

#: Probabilities of existence keep this distance from 0 and 1.
_EDGE = 1e-6


@dataclass(frozen=True, eq=False, slots=True)
class Track:
    """The way of the robot in the map's frame: ``t`` (n,) [s], ``way`` (n,) [m], ``pose`` (n, 3).

    ``way`` counts as odometry did; ``travelled`` (n,) [m] is the length of the corrected way.
    """

    t: Array
    way: Array
    pose: Array
    travelled: Array

    def at(self, way: float) -> Array:
        """Position (2,) at a place of the way, between the nearest two that are known."""
        return np.array([np.interp(way, self.way, self.pose[:, k]) for k in (0, 1)])

    def travelled_at(self, way: float) -> float:
        """Corrected length of the way until there [m]."""
        return float(np.interp(way, self.way, self.travelled))


def track_of(memory: Memory, poses: Array, here: tuple[float, float, tuple[float, float, float]]) -> Track:
    """The way, from the remembered places on it; ``here``: time, way, and pose seen from the last keyframe."""
    first = memory.keyframes[0]
    rows = [(first.t, first.way, 0, 0.0, 0.0, 0.0)]
    rows += [(w.t, w.way, w.keyframe, w.x, w.y, w.theta) for w in memory.path]
    if here[1] > rows[-1][1]:
        rows.append((here[0], here[1], len(memory.keyframes) - 1, *here[2]))
    table = np.array(rows, dtype=float)
    base = poses[table[:, 2].astype(int)]
    pose = se2.compose(base, table[:, 3:])
    steps = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    return Track(table[:, 0], table[:, 1], pose, np.concatenate([[0.0], np.cumsum(steps)]))


@dataclass(frozen=True, slots=True)
class Pass:
    """The robot was near a landmark: from ``start`` to ``end`` of its way [m], nearest at ``way``, ``distance`` [m]."""

    start: float
    end: float
    way: float
    distance: float
    seen: bool


def passes_of(xy: Array, seen: Sequence[float], track: Track, sensors: Sensors, near: float) -> list[Pass]:
    """All passes of a landmark at ``xy`` (2,), which was seen at the places ``seen`` [m] of the way.

    A pass is a stretch of the way within reach of the landmark that comes within ``near`` [m] of it, with the landmark
    in the field of view somewhere, or on which the landmark was seen.
    """
    away = xy - track.pose[:, :2]
    distance = np.hypot(*away.T)
    bearing = np.abs(se2.wrap(np.arctan2(away[:, 1], away[:, 0]) - track.pose[:, 2]))
    visible = bearing <= sensors.field_of_view / 2 + 1e-9
    reach = max(sensors.detection_range, near) * 1.1 + 0.5
    within = distance < reach
    sightings = np.sort(np.asarray(seen, dtype=float))
    marks = np.searchsorted(track.way, sightings, side="right") - 1
    within[np.clip(marks, 0, len(within) - 1)] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[False], within, [False]]).astype(int)))
    found = []
    for a, b in edges.reshape(-1, 2):
        k = a + int(np.argmin(distance[a:b]))
        of_pass = bool(np.any((marks >= a) & (marks < b)))
        if of_pass or (distance[k] < near and visible[a:b].any()):
            found.append(
                Pass(float(track.way[a]), float(track.way[b - 1]), float(track.way[k]), float(distance[k]), of_pass)
            )
    return found


def existence(type_: str, passes: Sequence[Pass], near: float, sensors: Sensors) -> float:
    """Probability that a landmark is there: every pass that saw it counts for it, every one that didn't against.

    A landmark that was seen in n passes is false with ``false_alarm_rate^n``; one that is there is missed with
    1 - ``detection_rate``, one that isn't stays away with 1 - ``false_alarm_rate``.

    >>> round(existence("corner", [Pass(0, 1, 0.5, 0.2, True)], 1.0, Sensors()), 3)
    0.8
    >>> round(existence("corner", [Pass(0, 1, 0.5, 0.2, True), Pass(9, 9, 9, 0.2, False)], 1.0, Sensors()), 3)
    0.487
    """
    false = min(max(sensors.false_alarm(type_), _EDGE), 1 - _EDGE)
    found = min(max(sensors.detection(type_), _EDGE), 1 - _EDGE)
    seen = max(1, sum(p.seen for p in passes))
    missed = sum(not p.seen and p.distance < near for p in passes)
    odds = log((1 - false**seen) / false**seen) + missed * log((1 - found) / (1 - false))
    return min(max(1 / (1 + exp(-odds)) if odds > -700 else 0.0, _EDGE), 1 - _EDGE)
