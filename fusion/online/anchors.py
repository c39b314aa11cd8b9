"""What ties a growing map to its frame: one landmark of those that links hold together, the nearest to the start."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable

from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.factors.frame import anchor, nearest_to_start

from .segment import Segment
from .terms import stripped
from .tree import Tree


class Anchors:
    """Of map number ``r``: which landmarks hang together by links, and which one of those is anchored.

    Where a joint covariance speaks of any of them, none is: it ties them to the frame itself.
    """

    def __init__(self, segment: Segment, r: int, tree: Tree) -> None:
        self.segment, self.r, self.tree = segment, r, tree
        self.joined: frozenset[str] = frozenset()
        self._ties: dict[str, set[str]] = defaultdict(set)
        self._part: dict[str, str] = {}
        self._members: dict[str, set[str]] = {}
        self._anchored: dict[str, str] = {}

    def tie(self, one: str, two: str, tied: bool) -> bool:
        """Whether two landmarks are held together by a link, from now on; whether that parts what hung together."""
        parts = two in self._ties[one] and not tied
        for a, b in ((one, two), (two, one)):
            if tied:
                self._ties[a].add(b)
            else:
                self._ties[a].discard(b)
        return parts

    def drop(self, name: str) -> bool:
        """A landmark is gone; whether that may part what hung together."""
        self._loosen(name)
        parted = self._ties.pop(name, set())
        for others in self._ties.values():
            others.discard(name)
        return len(parted) > 0 or name in self._part

    def update(self, ids: Iterable[str], known: Collection[str], *, afresh: bool) -> None:
        """Anchor what these landmarks belong to; ``afresh``: all that are ``known``."""
        if afresh:
            ids = tuple(known)
            for name in self._anchored.values():
                self._loosen(name)
            self._part, self._members, self._anchored = {}, {}, {}
        for name in ids:
            if name not in known:
                continue
            own = self._part.setdefault(name, name)
            if own == name:
                self._members.setdefault(name, {name})
            for other in self._ties[name]:
                if other in self._part and self._part[other] != self._part[name]:
                    self._unite(self._part[name], self._part[other])
            self._anchor(self._part[name], {name})

    def _unite(self, one: str, two: str) -> None:
        if len(self._members[one]) < len(self._members[two]):
            one, two = two, one
        moved = self._members.pop(two)
        self._members[one] |= moved
        for name in moved:
            self._part[name] = one
        other = self._anchored.pop(two, None)
        if other is not None:
            self._loosen(other)
            self._anchor(one, {other})

    def _anchor(self, part: str, also: set[str]) -> None:
        """The nearest to the start of the one anchored and of these, of a part."""
        was = self._anchored.get(part)
        if not self.joined.isdisjoint(self._members[part]):
            if was is not None:
                self._loosen(self._anchored.pop(part))
            return
        near = {*also, *([was] if was is not None else [])}
        few = self._few([stripped(l) for n in sorted(near) if (l := self.segment.local(n)) is not None])
        nearest = nearest_to_start(few, few.ids)
        if nearest.id == was and was not in also:
            return
        if was is not None and was != nearest.id:
            self._loosen(was)
        self._anchored[part] = nearest.id
        self.tree.put((self.segment.name, "anchor", nearest.id), (anchor(few, self.r, nearest),))

    def _loosen(self, name: str) -> None:
        self.tree.put((self.segment.name, "anchor", name), ())

    def _few(self, landmarks: Iterable[Landmark]) -> LandmarkMap:
        """A map of some of the landmarks, with its robot's start."""
        segment = self.segment
        return LandmarkMap(segment.name, tuple(landmarks), noise=segment.noise, path=segment.local_path)
