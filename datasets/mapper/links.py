"""Links: the ways between landmarks that the robot travelled, at the arms that they leave and arrive by."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import atan2, hypot, radians

import numpy as np
from numpy.typing import NDArray

from .association import wrap_any
from .memory import Known
from .passes import Pass, Track

Array = NDArray[np.float64]

#: A way whose arm and displacement disagree by more is bent (row 5 of the measurement model) [rad].
BENT = radians(20.0)
#: The arm that a way takes is within this of its direction [rad].
_TAKEN = radians(45.0)
#: A straight way is longer than the straight line by less than this share and these metres.
_DETOUR, _SWERVE = 1.1, 0.5
#: The direction in which a robot leaves is that of its first metres.
_LEAVING = 2.0
#: Landmarks nearer to each other than this [m] are at one place, with no way between.
_APART = 0.3


@dataclass(frozen=True, slots=True)
class Way:
    """From landmark ``a`` by its arm ``arm_a`` to ``b``, arriving by ``arm_b`` (None: no such arm was sensed).

    ``distance`` [m]: straight from a to b, or travelled where it is not ``straight``.
    """

    a: int
    arm_a: int | None
    b: int
    arm_b: int | None
    distance: float
    straight: bool
    travels: int


def ways_of(
    landmarks: Mapping[int, Known],
    places: Mapping[int, Array],
    arms: Mapping[int, Sequence[float]],
    passes: Mapping[int, Sequence[Pass]],
    track: Track,
    near: float,
) -> list[Way]:
    """All ways between landmarks with arms, straight ones first; ``places`` (2,) [m], ``arms`` [rad] of each."""
    stops = sorted((p.way, key) for key in landmarks if arms[key] for p in passes[key] if p.seen and p.distance < near)
    straight: Counter[tuple[int, int]] = Counter()
    bent: Counter[tuple[int, int]] = Counter()
    leaving: dict[tuple[int, int], tuple[float, float, float]] = {}
    for stop, following in pairwise(stops):
        # one key whichever way the robot goes
        (a, way_a), (b, way_b) = sorted((key, way) for way, key in (stop, following))
        if a == b:
            continue
        chord = places[b] - places[a]
        length = abs(track.travelled_at(way_b) - track.travelled_at(way_a))
        if hypot(*chord) < _APART:
            continue
        out, back = _direction(track, way_a, way_b), _direction(track, way_b, way_a)
        towards = atan2(chord[1], chord[0])
        is_straight = length < _DETOUR * hypot(*chord) + _SWERVE
        is_straight &= abs(wrap_any(out - towards)) < BENT and abs(wrap_any(back - towards - np.pi)) < BENT
        (straight if is_straight else bent)[a, b] += 1
        if not is_straight:
            leaving.setdefault((a, b), (out, back, length))
    ways = []
    for (a, b), travels in sorted(straight.items()):
        chord = places[b] - places[a]
        towards = atan2(chord[1], chord[0])
        at_a, at_b = _arm(arms[a], towards), _arm(arms[b], towards + np.pi)
        ways.append(Way(a, at_a, b, at_b, hypot(*chord), True, travels))
    for (a, b), travels in sorted(bent.items()):
        if (a, b) in straight:
            continue
        out, back, length = leaving[a, b]
        ways.append(Way(a, _arm(arms[a], out), b, _arm(arms[b], back), length, False, travels))
    return ways


def _direction(track: Track, start: float, end: float) -> float:
    """Direction [rad] in which the way leaves ``start`` towards ``end`` [m]."""
    there = start + min(_LEAVING, abs(end - start)) * (1 if end > start else -1)
    away = track.at(there) - track.at(start)
    return atan2(away[1], away[0])


def _arm(arms: Sequence[float], towards: float) -> int | None:
    off = [abs(wrap_any(arm - towards)) for arm in arms]
    return off.index(min(off)) if off and min(off) < _TAKEN else None
