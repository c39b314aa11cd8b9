"""`Way`: a link to be recorded, from one recorded station of the walk to the next (rows 3 and 5), without its noise."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .. import se2
from .floors import bearing
from .stations import Station, Stations

Array = NDArray[np.float64]

#: A link is bent where its arm and the recorded displacement disagree by more (row 5) [rad].
BENT = np.deg2rad(20.0)
#: What a bent link's arm must be clear of the true displacement, so that the recorded one is surely bent [rad].
CLEARLY_BENT = np.deg2rad(32.0)
_STRAIGHT = 1e-6

StationArm = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Way:
    """From station ``a`` along its ``arm_a`` to station ``b``, arriving at its ``arm_b``.

    ``length`` [m]: what the robot travelled; ``straight``: nothing but this corridor lies between. A way that isn't
    straight is recorded at ``a`` only.
    """

    a: int
    arm_a: int
    b: int
    arm_b: int
    length: float
    straight: bool
    travels: int = 1


@dataclass(frozen=True, slots=True)
class Trail:
    """All ways between recorded stations, and all their arms that were travelled (even without a link)."""

    ways: tuple[Way, ...]
    travelled: frozenset[StationArm]


def trail(stations: Stations) -> Trail | None:
    """The links that the walk makes between the recorded stations.

    None where the model has no words for this draw: a missed corner whose link would pass for straight, so that
    the landmarks would not all be linked.
    """
    travels: Counter[Way] = Counter(_ways(stations))
    straight = {w: n for w, n in travels.items() if w.straight}
    ways = [Way(w.a, w.arm_a, w.b, w.arm_b, w.length, True, n) for w, n in straight.items()]
    taken = {end for w in ways for end in ((w.a, w.arm_a), (w.b, w.arm_b))}
    linked = {frozenset((w.a, w.b)) for w in ways}
    groups = _Groups(len(stations.all))
    for way in travels:
        if way.straight or frozenset((way.a, way.b)) in linked or groups.joined(way.a, way.b):
            continue
        seen = _from_its_bent_end(stations.all, way, taken)
        if seen is not None:
            ways.append(seen)
            taken.add((seen.a, seen.arm_a))
            linked.add(frozenset((seen.a, seen.b)))
            groups.join(seen.a, seen.b)
    for way in ways:
        groups.join(way.a, way.b)
    recorded = [k for k, s in enumerate(stations.all) if s.detections]
    if any(not groups.joined(recorded[0], k) for k in recorded):
        return None
    return Trail(tuple(ways), _travelled(stations))


def _ways(stations: Stations) -> list[Way]:
    """One way per stretch of the walk between two different recorded stations, smaller index first."""
    found: list[Way] = []
    path: list[int] = []
    for k in stations.walk:
        path.append(k)
        if not stations.all[k].detections:
            path = path if len(path) > 1 else []
        else:
            if len(path) > 1 and path[0] != k:
                found.append(_way(stations.all, path if path[0] < k else path[::-1]))
            path = [k]
    return found


def _way(stations: tuple[Station, ...], path: list[int]) -> Way:
    xy = [stations[k].place.xy for k in path]
    legs = [b - a for a, b in pairwise(xy)]
    directions = [float(np.arctan2(leg[1], leg[0])) for leg in legs]
    straight = all(abs(se2.wrap(d - directions[0])) < _STRAIGHT for d in directions)
    arm_a = stations[path[0]].place.arm_towards(directions[0])
    arm_b = stations[path[-1]].place.arm_towards(directions[-1] + np.pi)
    assert arm_a is not None
    assert arm_b is not None
    # rounded, so that the same stretch walked the other way is the same key
    length = round(float(sum(np.hypot(*leg) for leg in legs)), 9)
    return Way(path[0], arm_a, path[-1], arm_b, length, straight)


def _from_its_bent_end(stations: tuple[Station, ...], way: Way, taken: set[StationArm]) -> Way | None:
    """The way seen from the end whose arm is furthest from the displacement; None where neither will do."""
    turned = Way(way.b, way.arm_b, way.a, way.arm_a, way.length, way.straight)
    ends = [w for w in (way, turned) if (w.a, w.arm_a) not in taken]
    best = max(ends, key=lambda w: clearance(stations, w), default=None)
    return best if best is not None and clearance(stations, best) > CLEARLY_BENT else None


def clearance(stations: tuple[Station, ...], way: Way) -> float:
    """Angle [rad] between the arm at ``a`` and the displacement to ``b``."""
    a, b = stations[way.a], stations[way.b]
    if not np.hypot(*(b.place.xy - a.place.xy)) > 1.0:
        return 0.0
    return abs(float(se2.wrap(a.place.arms[way.arm_a].direction - bearing(a.place.xy, b.place.xy))))


def _travelled(stations: Stations) -> frozenset[StationArm]:
    ends: set[StationArm] = set()
    for a, b in pairwise(stations.walk):
        for here, there in ((a, b), (b, a)):
            place = stations.all[here].place
            arm = place.arm_towards(bearing(place.xy, stations.all[there].place.xy))
            assert arm is not None
            ends.add((here, arm))
    return frozenset(ends)


class _Groups:
    """Which stations are joined (union-find)."""

    def __init__(self, count: int) -> None:
        self._parent = list(range(count))

    def _root(self, k: int) -> int:
        while self._parent[k] != k:
            self._parent[k] = self._parent[self._parent[k]]
            k = self._parent[k]
        return k

    def join(self, a: int, b: int) -> None:
        self._parent[self._root(a)] = self._root(b)

    def joined(self, a: int, b: int) -> bool:
        return self._root(a) == self._root(b)
