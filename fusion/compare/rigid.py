"""Two maps laid on each other as they were recorded: what every method does that knows only T12 and matches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.factors.heading import headings_of

from ..coverage import Segments, passed
from ..prepared import straight_corridors
from .method import Merge, MergedLandmark

Array = NDArray[np.float64]
IdPair = tuple[str, str]

#: A landmark this close [m] to where the other robot drove was passed by it.
PASSED_M = 1.0
#: A link that strays further [rad] from its arm isn't straight: where the robot drove isn't known.
STRAY = float(np.deg2rad(20.0))


def corridors_of(map_: LandmarkMap, positions: Array) -> Segments:
    """Straight ways from landmark to landmark that the robot drove, the landmarks being at ``positions`` (n, 2)."""
    of = headings_of(map_)
    headings = np.array([np.nan if of[name] is None else of[name] for name in map_.ids], dtype=float)
    ends = straight_corridors(map_, map_.positions, headings, STRAY)
    return Segments(positions[ends[:, 0]], positions[ends[:, 1]])


def was_passed(points: Array, ways: Segments) -> NDArray[np.bool_]:
    """Which points (n, 2) the robot passed that drove these ways, (n,)."""
    return np.asarray(passed(points, ways, PASSED_M).any(axis=1), dtype=bool)


def merged_rigidly(
    map1: LandmarkMap, map2: LandmarkMap, T12: Transform, correspondences: Sequence[IdPair]
) -> tuple[MergedLandmark, ...]:
    """Map 2 moved by T12 onto map 1; what matches stands once, in the middle.

    >>> from mapfuse.datasets.maps import Landmark
    >>> one = LandmarkMap("one", (Landmark("a", "door", 0.0, 0.0),))
    >>> two = LandmarkMap("two", (Landmark("b", "door", 0.0, 0.2), Landmark("c", "door", 3.0, 0.0)))
    >>> [(l.x, l.y, l.ids1, l.ids2) for l in merged_rigidly(one, two, Transform(0.0, 0.0, 0.0), [("a", "b")])]
    [(0.0, 0.1, ('a',), ('b',)), (3.0, 0.0, (), ('c',))]
    """
    return merged_at(map1, map2, map1.positions, T12.apply(map2.positions), correspondences)


def merged_at(
    map1: LandmarkMap, map2: LandmarkMap, p1: Array, p2: Array, correspondences: Sequence[IdPair]
) -> tuple[MergedLandmark, ...]:
    """Both maps' landmarks at ``p1`` (n1, 2) and ``p2`` (n2, 2) in one frame; what matches stands once, in the middle.

    The paper's false alarms (section 4.1): what one robot has and the other, which passed there, has not, isn't kept.
    """
    partner2 = dict(correspondences)
    matched2 = set(partner2.values())
    passed1 = was_passed(p1, corridors_of(map2, p2)).tolist()
    passed2 = was_passed(p2, corridors_of(map1, p1)).tolist()
    found = []
    for k, name in enumerate(map1.ids):
        if name in partner2:
            x, y = ((p1[k] + p2[map2.index_from_id[partner2[name]]]) / 2).tolist()
            found.append(MergedLandmark(x, y, (name,), (partner2[name],)))
        else:
            found.append(MergedLandmark(float(p1[k, 0]), float(p1[k, 1]), (name,), (), not passed1[k]))
    found += [
        MergedLandmark(float(p2[k, 0]), float(p2[k, 1]), (), (name,), not passed2[k])
        for k, name in enumerate(map2.ids)
        if name not in matched2
    ]
    return tuple(found)


def rigid_merge(
    map1: LandmarkMap, map2: LandmarkMap, T12: Transform | None, correspondences: Sequence[IdPair]
) -> Merge:
    """The merge of a method that merges whatever it finds; nothing overlaps where it finds nothing."""
    if T12 is None or not correspondences:
        return Merge("no_overlap", T12)
    return Merge("merged", T12, tuple(correspondences), merged_rigidly(map1, map2, T12, correspondences))
