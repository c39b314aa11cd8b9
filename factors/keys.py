"""What is estimated, and its GTSAM key: landmarks, map frames, compasses and north, both ways.

Every unknown is a pose (x, y, theta) in the merged frame. Keys are a letter and a number that is unique across the
letters (GTSAM's ``writeG2o`` drops the letter), and follow the order of landmark ids, not that of the file: shuffling
a map's landmarks leaves the graph as it is.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import gtsam

from mapfuse.datasets.maps import LandmarkMap


@dataclass(frozen=True, slots=True, order=True)
class LandmarkKey:
    """Pose of a landmark in the merged frame; ``map`` is the place of its map in the problem."""

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


class KeyBook:
    """Unknown <-> GTSAM key, for all maps of a problem.

    >>> from mapfuse.datasets.maps import Landmark
    >>> book = KeyBook([LandmarkMap("D7", (Landmark("c1", "corner", 0.0, 0.0),))])
    >>> key = book.key(LandmarkKey(0, "c1"))
    >>> book.unknown(key), book.name(key)
    (LandmarkKey(map=0, id='c1'), 'landmark D7:c1')
    """

    __slots__ = ("_key_from_unknown", "_names", "_unknown_from_key")

    def __init__(self, maps: Sequence[LandmarkMap]) -> None:
        compasses = [r for r, recorded in enumerate(maps) if has_compass(recorded)]
        unknowns: list[Unknown] = [FrameKey(r) for r in range(len(maps))]
        unknowns += [LandmarkKey(r, name) for r, recorded in enumerate(maps) for name in sorted(recorded.ids)]
        unknowns += [CompassKey(r) for r in compasses]
        unknowns += [NorthKey()] if compasses else []
        self._names = tuple(recorded.name for recorded in maps)
        self._key_from_unknown: dict[Unknown, int] = {
            unknown: gtsam.symbol(_LETTERS[type(unknown)], k) for k, unknown in enumerate(unknowns)
        }
        self._unknown_from_key = {key: unknown for unknown, key in self._key_from_unknown.items()}

    def __len__(self) -> int:
        return len(self._key_from_unknown)

    def __iter__(self) -> Iterator[Unknown]:
        return iter(self._key_from_unknown)

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
        return self._unknown_from_key[key]

    def landmarks(self, r: int) -> tuple[LandmarkKey, ...]:
        """All landmarks of map ``r``, by id."""
        return tuple(u for u in self._key_from_unknown if isinstance(u, LandmarkKey) and u.map == r)

    def name(self, key: int) -> str:
        """What a key stands for, in words."""
        unknown = self._unknown_from_key[key]
        if isinstance(unknown, LandmarkKey):
            return f"landmark {self._names[unknown.map]}:{unknown.id}"
        if isinstance(unknown, NorthKey):
            return "north"
        kind = "frame" if isinstance(unknown, FrameKey) else "compass"
        return f"{kind} of {self._names[unknown.map]}"

    def mentioned(self, message: str) -> tuple[Unknown, ...]:
        """The unknowns that a text of GTSAM names, as its "indeterminate linear system ... variable <key>" does."""
        found = (self._unknown_from_key.get(int(number)) for number in re.findall(r"\d{6,}", message))
        return tuple(dict.fromkeys(unknown for unknown in found if unknown is not None))
