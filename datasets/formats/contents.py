"""What a map holds, sort by sort, so that a format can say what it loses and a test can take that away."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any

from ..arms import heading_of
from ..maps import Landmark, LandmarkMap, Link, Noise


def _any_link(map_: LandmarkMap, test: Callable[[Link], bool]) -> bool:
    return any(test(link) for landmark in map_.landmarks for link in landmark.links)


def _any_landmark(map_: LandmarkMap, test: Callable[[Landmark], bool]) -> bool:
    return any(map(test, map_.landmarks))


_HELD: Mapping[str, Callable[[LandmarkMap], bool]] = {
    "name": lambda m: True,
    "robot": lambda m: m.robot is not None,
    "recorded_at": lambda m: m.recorded_at is not None,
    "landmarks": lambda m: bool(m.landmarks),
    "ids": lambda m: bool(m.landmarks),
    "types": lambda m: bool(m.landmarks),
    "heading": lambda m: _any_landmark(m, lambda l: heading_of(l) is not None),
    "arms": lambda m: _any_link(m, lambda link: link.connected_to_id is None or link.type != "unknown"),
    "ways": lambda m: _any_link(m, lambda link: link.connected_to_id is not None),
    "distances": lambda m: _any_link(m, lambda link: link.distance is not None),
    "compass": lambda m: _any_link(m, lambda link: link.compass is not None),
    "counters": lambda m: (
        _any_landmark(m, lambda l: (l.visit_counter, l.detection_counter) != (1, 1))
        or _any_link(m, lambda link: link.travel_counter != 0)
    ),
    "covariance": lambda m: _any_landmark(m, lambda l: l.covariance is not None),
    "joint covariance": lambda m: m.joint_covariance is not None,
    "existence": lambda m: _any_landmark(m, lambda l: l.existence is not None),
    "noise": lambda m: m.noise != Noise(),
    "walls": lambda m: bool(m.walls),
    "path": lambda m: m.path is not None,
    "same_as": lambda m: bool(m.same_as),
    "extra": lambda m: (
        bool(m.extra) or _any_landmark(m, lambda l: bool(l.extra)) or _any_link(m, lambda k: bool(k.extra))
    ),
}

#: Everything that a map may hold beside positions, by the words that formats use for what they lose.
SORTS: tuple[str, ...] = tuple(_HELD)


def contents(map_: LandmarkMap) -> tuple[str, ...]:
    """The sorts of things that a map holds.

    >>> contents(LandmarkMap("D7", (Landmark("c1", "corner", 0.0, 0.0, existence=0.9),)))
    ('name', 'landmarks', 'ids', 'types', 'existence')
    """
    return tuple(sort for sort, held in _HELD.items() if held(map_))


def extra_keys(map_: LandmarkMap) -> set[str]:
    """All keys that our own format doesn't know, of the map, its landmarks and their links."""
    own = set(map_.extra)
    for landmark in map_.landmarks:
        own.update(landmark.extra, *(link.extra for link in landmark.links))
    return own


_MAP_DEFAULTS: Mapping[str, dict[str, Any]] = {
    "robot": {"robot": None},
    "recorded_at": {"recorded_at": None},
    "landmarks": {"landmarks": (), "joint_covariance": None, "same_as": {}},
    "joint covariance": {"joint_covariance": None},
    "noise": {"noise": Noise()},
    "walls": {"walls": ()},
    "path": {"path": None},
    "same_as": {"same_as": {}},
    "extra": {"extra": {}},
}
_LANDMARK_DEFAULTS: Mapping[str, dict[str, Any]] = {
    "heading": {"heading": None},
    "counters": {"visit_counter": 1, "detection_counter": 1},
    "covariance": {"covariance": None},
    "existence": {"existence": None},
    "extra": {"extra": {}},
}
_LINK_DEFAULTS: Mapping[str, dict[str, Any]] = {
    "distances": {"distance": None},
    "compass": {"compass": None},
    "counters": {"travel_counter": 0},
    "extra": {"extra": {}},
}


def without(map_: LandmarkMap, lost: Collection[str]) -> LandmarkMap:
    """The map without some sorts of things (of `SORTS`), as a format that loses them gives it back.

    Names, ids and types stay: a format that loses these gives new ones. A landmark whose arms go keeps the heading
    that they gave it, unless headings go too.

    >>> without(LandmarkMap("D7", (Landmark("c1", "corner", 0.0, 0.0, existence=0.9),)), ["existence"])["c1"].existence
    """
    changes = _gathered(_MAP_DEFAULTS, lost)
    landmarks = changes.pop("landmarks", tuple(_less(landmark, lost) for landmark in map_.landmarks))
    return map_.replace(landmarks=landmarks, **changes)


def _gathered(defaults: Mapping[str, dict[str, Any]], lost: Collection[str]) -> dict[str, Any]:
    return {field: value for sort in lost for field, value in defaults.get(sort, {}).items()}


def _less(landmark: Landmark, lost: Collection[str]) -> Landmark:
    changes = _gathered(_LANDMARK_DEFAULTS, lost)
    links = tuple(less for link in landmark.links if (less := _less_link(link, lost)) is not None)
    covariance = landmark.covariance
    if "arms" in lost and "heading" not in lost:
        changes["heading"] = heading_of(landmark)
    if "heading" in lost and covariance is not None:
        changes.setdefault("covariance", covariance[:2, :2])
    return replace(landmark, links=links, **changes)


def _less_link(link: Link, lost: Collection[str]) -> Link | None:
    changes = _gathered(_LINK_DEFAULTS, lost)
    if "ways" in lost:
        changes |= {"connected_to_id": None, "distance": None}
    if "arms" in lost:
        if link.connected_to_id is None or "ways" in lost:
            return None
        changes |= {"type": "unknown", "heading": None}
    return replace(link, **changes)
