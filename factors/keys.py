"""What is estimated, and its GTSAM key: landmarks, map frames, compasses and north, both ways.

Every unknown is a pose (x, y, theta) in the merged frame. Keys are a letter and a number that is unique across the
letters (GTSAM's ``writeG2o`` drops the letter), and follow the order of landmark ids, not that of the file: shuffling
a map's landmarks leaves the graph as it is.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import gtsam

from mapfuse.datasets.maps import LandmarkMap


class LandmarkKey(NamedTuple):
    """Pose of a landmark in the merged frame; ``map`` is the place of its map in the problem.

    A tuple, since it is looked up most and those are hashed without a call into Python; the other unknowns, of which
    there are few, are none, so that no two kinds are ever equal.
    """

    map: int
    id: str


@dataclass(frozen=True, slots=True, order=True)
class FrameKey:
    """``T_r``: pose of a map's frame in the merged frame."""

    map: int


@dataclass(frozen=True, slots=True, order=True)
class CompassKey:
    """``c_r``: its theta is the direction in the merged frame of what a robot's compass calls zero."""

    map: int


@dataclass(frozen=True, slots=True)
class NorthKey:
    """Its theta is the direction of north in the merged frame, one for all maps."""


Unknown = LandmarkKey | FrameKey | CompassKey | NorthKey

_LETTERS = {FrameKey: "T", LandmarkKey: "l", CompassKey: "c", NorthKey: "n"}
#: Of a key's number, the lower bits count the unknowns of one map; north is none of any map's.
_MAP_BITS, _NORTH_BIT = 32, 54


class ByIdentity:
    """A map as a cache key that compares by identity: comparing two maps field by field costs more than it saves."""

    __slots__ = ("recorded",)

    def __init__(self, recorded: LandmarkMap) -> None:
        self.recorded = recorded

    def __hash__(self) -> int:
        return id(self.recorded)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByIdentity) and self.recorded is other.recorded


def has_compass(recorded: LandmarkMap) -> bool:
    """Whether the map carries a compass reading of an arm whose heading is known."""
    return any(link.compass is not None and link.heading is not None for l in recorded.landmarks for link in l.links)


@dataclass(frozen=True, eq=False, slots=True)
class MapKeys:
    """The unknowns of one map, the same objects in every problem that has it in the same place, and their keys.

    ``landmarks``: by id; ``compass`` None: the map has none.
    """

    frame: FrameKey
    landmarks: Mapping[str, LandmarkKey]
    compass: CompassKey | None
    key_from_unknown: Mapping[Unknown, int]


def map_keys(recorded: LandmarkMap, r: int) -> MapKeys:
    """The unknowns of map ``r``; kept for the maps used last."""
    return _map_keys(ByIdentity(recorded), r)


@lru_cache(maxsize=256)
def _map_keys(cached: ByIdentity, r: int) -> MapKeys:
    frame, compass = FrameKey(r), CompassKey(r) if has_compass(cached.recorded) else None
    landmarks = {name: LandmarkKey(r, name) for name in sorted(cached.recorded.ids)}
    first, letter = r << _MAP_BITS, _LETTERS[LandmarkKey]
    keys: dict[Unknown, int] = {frame: gtsam.symbol(_LETTERS[FrameKey], first)}
    keys |= {landmark: gtsam.symbol(letter, first + k) for k, landmark in enumerate(landmarks.values(), start=1)}
    if compass is not None:
        keys[compass] = gtsam.symbol(_LETTERS[CompassKey], first + (1 << _MAP_BITS) - 1)
    return MapKeys(frame, landmarks, compass, keys)


class KeyBook:
    """Unknown <-> GTSAM key, for all maps of a problem.

    The key of a map's unknown depends on that map and its place in the problem alone, so that GTSAM factors of a
    map's own measurements can be kept from one problem to the next.

    >>> from mapfuse.datasets.maps import Landmark
    >>> book = KeyBook([LandmarkMap("D7", (Landmark("c1", "corner", 0.0, 0.0),))])
    >>> key = book.key(LandmarkKey(0, "c1"))
    >>> book.unknown(key), book.name(key)
    (LandmarkKey(map=0, id='c1'), 'landmark D7:c1')
    """

    __slots__ = ("_key_from_unknown", "_landmarks", "_names", "in_order")

    def __init__(self, maps: Sequence[LandmarkMap]) -> None:
        parts = [map_keys(recorded, r) for r, recorded in enumerate(maps)]
        frames = [part.frame for part in parts]
        compasses = [part.compass for part in parts if part.compass is not None]
        north = [NorthKey()] if compasses else []
        self._names = tuple(recorded.name for recorded in maps)
        self._landmarks = tuple(tuple(part.landmarks.values()) for part in parts)
        self._key_from_unknown: dict[Unknown, int] = {}
        for part in parts:
            self._key_from_unknown |= part.key_from_unknown
        self._key_from_unknown |= dict.fromkeys(north, gtsam.symbol(_LETTERS[NorthKey], 1 << _NORTH_BIT))
        #: All unknowns in the order of their keys, as GTSAM sorts them.
        self.in_order: tuple[Unknown, ...] = (*frames, *compasses, *chain.from_iterable(self._landmarks), *north)

    def __len__(self) -> int:
        return len(self.in_order)

    def __iter__(self) -> Iterator[Unknown]:
        return iter(self.in_order)

    def __contains__(self, unknown: object) -> bool:
        return unknown in self._key_from_unknown

    def key(self, unknown: Unknown) -> int:
        """GTSAM key of an unknown; KeyError where the problem has no such unknown."""
        return self._key_from_unknown[unknown]

    def keys(self, unknowns: Iterable[Unknown]) -> list[int]:
        """GTSAM keys of several unknowns, in their order."""
        return [self._key_from_unknown[unknown] for unknown in unknowns]

    def unknown(self, key: int) -> Unknown:
        """The unknown of a GTSAM key; KeyError where the key is not of this book."""
        symbol = gtsam.Symbol(key)
        r, k = symbol.index() >> _MAP_BITS, symbol.index() % (1 << _MAP_BITS)
        found: Unknown = NorthKey()
        if r < len(self._names):
            among = self._landmarks[r]
            of_landmark = among[k - 1] if 0 < k <= len(among) else CompassKey(r)
            found = FrameKey(r) if k == 0 else of_landmark
        if self._key_from_unknown.get(found) != key:
            raise KeyError(key)
        return found

    def landmarks(self, r: int) -> tuple[LandmarkKey, ...]:
        """All landmarks of map ``r``, by id."""
        return self._landmarks[r]

    def name(self, key: int) -> str:
        """What a key stands for, in words."""
        unknown = self.unknown(key)
        if isinstance(unknown, LandmarkKey):
            return f"landmark {self._names[unknown.map]}:{unknown.id}"
        if isinstance(unknown, NorthKey):
            return "north"
        kind = "frame" if isinstance(unknown, FrameKey) else "compass"
        return f"{kind} of {self._names[unknown.map]}"

    def mentioned(self, message: str) -> tuple[Unknown, ...]:
        """The unknowns that a text of GTSAM names, as its "indeterminate linear system ... variable <key>" does."""
        found = []
        for number in re.findall(r"\d{6,}", message):
            with suppress(KeyError, TypeError):  # any other number
                found.append(self.unknown(int(number)))
        return tuple(dict.fromkeys(found))
