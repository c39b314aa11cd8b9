"""Rival placements of every pair of maps, kept up as landmarks come: a new one votes with all of the other map.

Two landmarks of a type propose the T12 that lays one on the other, by their directions; where landmarks have none,
two near ones of one map and two as far apart of the other do. Each proposal is a vote for a cell in (x, y, theta).
Nothing is decided here: the table says which placements are worth a look, and when to weigh (`mapfuse.fusion.evidence`
does that). It depends on where the landmarks are by now and not on the way there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import product
from math import pi
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.arms import Kind, heading_of, signature
from mapfuse.datasets.maps import Landmark

from .config import OnlineConfig
from .segment import Segment

Array = NDArray[np.float64]
Cell: TypeAlias = tuple[int, int, int]

#: Size of a cell [m] and how many there are around the circle.
CELL_M, TURNS = 2.0, 24
#: A landmark votes again once it has moved or turned by more than this [m, rad].
MOVED_M, TURNED = 0.5, 0.1
#: Neighbours with which a landmark without direction votes, how near they are [m], and how equal two distances [m].
NEIGHBOURS, NEAR_M, EQUAL_M = 6, 15.0, 0.3
#: Placements that are kept in sight per pair of maps.
IN_SIGHT = 64
_AROUND = tuple(product((-1, 0, 1), repeat=3))
#: Turns that lay a kind onto itself.
_SYMMETRY = {Kind.CROSSING: 4, Kind.CORRIDOR: 2}


class Rival(NamedTuple):
    """A placement that landmarks vote for: T12 about, as x, y [m], theta [rad], and by how many pairs of them."""

    T12: tuple[float, float, float]
    votes: int


@dataclass
class _Side:
    """One map's landmarks as they voted last: place by id, x, y, direction (NaN: none), type, kind."""

    ids: list[str] = field(default_factory=list)
    place: dict[str, int] = field(default_factory=dict)
    poses: Array = field(default_factory=lambda: np.zeros((0, 3)))
    types: list[str] = field(default_factory=list)
    symmetry: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    size: int = 0
    of_type: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))

    def put(self, landmark: Landmark) -> bool:
        """Take a landmark in; whether it has to vote (again)."""
        heading = heading_of(landmark)
        pose = np.array([landmark.x, landmark.y, np.nan if heading is None else heading])
        symmetry = _SYMMETRY.get(signature(landmark).kind, 1)
        k = self.place.get(landmark.id)
        if k is not None:
            was = self.poses[k]
            turned = np.isnan(was[2]) != np.isnan(pose[2]) or abs(se2.wrap(was[2] - pose[2])) > TURNED
            same = self.types[k] == landmark.type and self.symmetry[k] == symmetry
            if same and not turned and np.hypot(*(was[:2] - pose[:2])) < MOVED_M:
                return False
            self.drop(landmark.id)
        if self.size == len(self.poses):
            self.poses = np.vstack([self.poses, np.full((max(16, self.size), 3), np.nan)])
            self.symmetry = np.append(self.symmetry, np.ones(max(16, self.size), dtype=np.intp))
        k = self.size
        self.size += 1
        self.ids.append(landmark.id)
        self.types.append(landmark.type)
        self.place[landmark.id] = k
        self.poses[k], self.symmetry[k] = pose, symmetry
        self.of_type[landmark.type].append(k)
        return True

    def drop(self, name: str) -> None:
        """Forget a landmark."""
        k = self.place.pop(name)
        self.of_type[self.types[k]].remove(k)
        if 2 * len(self.place) + 32 < self.size:
            self._compact()

    def _compact(self) -> None:
        kept = sorted(self.place.values())
        names = [self.ids[k] for k in kept]
        self.types = [self.types[k] for k in kept]
        self.poses, self.symmetry = self.poses[kept], self.symmetry[kept]
        self.ids, self.size = names, len(kept)
        self.place = {name: k for k, name in enumerate(names)}
        self.of_type = defaultdict(list)
        for k, type_ in enumerate(self.types):
            self.of_type[type_].append(k)

    def neighbours(self, k: int) -> NDArray[np.intp]:
        """Places of the landmarks nearest to one, itself left out."""
        others = np.array([other for other in self.place.values() if other != k], dtype=np.intp)
        if not len(others):
            return others
        apart = np.hypot(*(self.poses[others, :2] - self.poses[k, :2]).T)
        order = np.lexsort((others, apart))[:NEIGHBOURS]
        return np.asarray(others[order][apart[order] < NEAR_M])


class _Table:
    """Votes of one pair of maps: cells by (landmark of 1, landmark of 2), and how many each cell has."""

    def __init__(self) -> None:
        self.cast: dict[tuple[str, str], tuple[Cell, ...]] = {}
        self.by1: dict[str, set[str]] = defaultdict(set)
        self.by2: dict[str, set[str]] = defaultdict(set)
        self.counts: dict[Cell, int] = defaultdict(int)
        self.strong: set[Cell] = set()
        self.bound = 2

    def vote(self, a: str, b: str, cells: tuple[Cell, ...]) -> None:
        self.cast[a, b] = cells
        self.by1[a].add(b)
        self.by2[b].add(a)
        for cell in cells:
            self.counts[cell] += 1
            if self.counts[cell] >= self.bound:
                self.strong.add(cell)
        if len(self.strong) > 8 * IN_SIGHT:
            self._narrow()

    def _narrow(self) -> None:
        """Keep in sight what has most votes, by count alone."""
        while len(self.strong) > 8 * IN_SIGHT:
            self.bound += 1
            self.strong = {cell for cell in self.strong if self.counts[cell] >= self.bound}

    def forget1(self, a: str) -> None:
        for b in self.by1.pop(a, set()):
            self._take_back(a, b)
            self.by2[b].discard(a)

    def forget2(self, b: str) -> None:
        for a in self.by2.pop(b, set()):
            self._take_back(a, b)
            self.by1[a].discard(b)

    def _take_back(self, a: str, b: str) -> None:
        for cell in self.cast.pop((a, b)):
            self.counts[cell] -= 1
            if self.counts[cell] < self.bound:
                self.strong.discard(cell)
            if not self.counts[cell]:
                del self.counts[cell]

    def around(self, cell: Cell) -> int:
        """Votes of a cell and those it touches."""
        x, y, turn = cell
        return sum(self.counts.get((x + i, y + j, (turn + k) % TURNS), 0) for i, j, k in _AROUND)

    def best(self) -> list[tuple[int, Cell]]:
        """Cells in sight with the votes around them, best first, one of each that touch."""
        ranked = sorted(
            ((self.around(cell), self.counts[cell], cell) for cell in self.strong), key=lambda r: (-r[0], -r[1], r[2])
        )
        kept: list[tuple[int, Cell]] = []
        for votes, _, cell in ranked[: 4 * IN_SIGHT]:
            if not any(_touch(cell, other) for _, other in kept):
                kept.append((votes, cell))
            if len(kept) == IN_SIGHT:
                break
        return kept


def _touch(a: Cell, b: Cell) -> bool:
    turn = (a[2] - b[2]) % TURNS
    return abs(a[0] - b[0]) <= 2 and abs(a[1] - b[1]) <= 2 and min(turn, TURNS - turn) <= 2


class Rivals:
    """The tables of all pairs of maps."""

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self._sides: dict[str, _Side] = {}
        self._tables: dict[tuple[str, str], _Table] = defaultdict(_Table)

    def changed(self, segment: Segment, ids: Iterable[str]) -> None:
        """Landmarks of a map are new, gone, or elsewhere: they vote."""
        name = segment.name
        side = self._sides.setdefault(name, _Side())
        anew: list[str] = []
        for identifier in ids:
            landmark = segment.landmark(identifier)
            if landmark is None:
                if identifier in side.place:
                    side.drop(identifier)
                    self._forget(name, identifier)
            elif side.put(landmark):
                self._forget(name, identifier)
                anew.append(identifier)
        for other in sorted(self._sides):
            if other != name:
                for identifier in anew:
                    self._vote(name, identifier, other)

    def votes(self, map1: str, map2: str) -> int:
        """How many pairs of landmarks vote for the best placement."""
        found = self.best(map1, map2)
        return found[0].votes if found else 0

    def best(self, map1: str, map2: str) -> tuple[Rival, ...]:
        """Placements of map 2 on map 1 in sight, best first."""
        one, two = sorted((map1, map2))
        table = self._tables.get((one, two))
        if table is None:
            return ()
        found = []
        for votes, (x, y, turn) in table.best():
            T = np.array([(x + 0.5) * CELL_M, (y + 0.5) * CELL_M, se2.wrap((turn + 0.5) * 2 * pi / TURNS)])
            T = T if (one, two) == (map1, map2) else np.asarray(se2.inverse(T))
            found.append(Rival((float(T[0]), float(T[1]), float(T[2])), votes))
        return tuple(found)

    def _forget(self, name: str, identifier: str) -> None:
        for (one, two), table in self._tables.items():
            if one == name:
                table.forget1(identifier)
            elif two == name:
                table.forget2(identifier)

    def _vote(self, name: str, identifier: str, other: str) -> None:
        mine, theirs = self._sides[name], self._sides[other]
        k = mine.place[identifier]
        first = name < other
        table = self._tables[(name, other) if first else (other, name)]
        proposals = self._by_heading(mine, k, theirs) if not np.isnan(mine.poses[k, 2]) else {}
        for partner, T in self._by_distance(mine, k, theirs).items() if not proposals else ():
            proposals[partner] = T
        for partner, T in proposals.items():
            T12 = T if first else np.asarray(se2.inverse(T))
            cells = tuple(dict.fromkeys(_cells(T12)))
            pair = (identifier, theirs.ids[partner]) if first else (theirs.ids[partner], identifier)
            if pair not in table.cast:
                table.vote(*pair, cells)

    @staticmethod
    def _by_heading(mine: _Side, k: int, theirs: _Side) -> dict[int, Array]:
        """Of each landmark of the same type the T that lays it on the k-th of mine, (m, 3)."""
        same = np.array(theirs.of_type.get(mine.types[k], ()), dtype=np.intp)
        same = same[~np.isnan(theirs.poses[same, 2])]
        if not len(same):
            return {}
        pose = mine.poses[k]
        found: dict[int, list[tuple[float, float, float]]] = {}
        ways = np.maximum(theirs.symmetry[same], mine.symmetry[k])
        there = theirs.poses[same]
        for way in range(int(ways.max())):
            theta = se2.wrap(pose[2] - there[:, 2] + way * 2 * pi / ways)
            c, s = np.cos(theta), np.sin(theta)
            x = pose[0] - c * there[:, 0] + s * there[:, 1]
            y = pose[1] - s * there[:, 0] - c * there[:, 1]
            for n, partner in enumerate(same.tolist()):
                if way < ways[n]:
                    found.setdefault(partner, []).append((x[n], y[n], theta[n]))
        return {partner: np.array(Ts) for partner, Ts in found.items()}

    @staticmethod
    def _by_distance(mine: _Side, k: int, theirs: _Side) -> dict[int, Array]:
        """The same from pairs of near landmarks that are as far apart there as here."""
        found: dict[int, list[Array]] = {}
        near = mine.neighbours(k)
        for partner in theirs.of_type.get(mine.types[k], ()):
            for there in theirs.neighbours(partner).tolist():
                for here in near.tolist():
                    if theirs.types[there] != mine.types[here]:
                        continue
                    d1, d2 = (
                        mine.poses[here, :2] - mine.poses[k, :2],
                        theirs.poses[there, :2] - theirs.poses[partner, :2],
                    )
                    r1, r2 = float(np.hypot(*d1)), float(np.hypot(*d2))
                    if abs(r1 - r2) > EQUAL_M or min(r1, r2) < EQUAL_M:
                        continue
                    theta = float(se2.wrap(np.arctan2(d1[1], d1[0]) - np.arctan2(d2[1], d2[0])))
                    at = mine.poses[k, :2] - se2.rotation(theta) @ theirs.poses[partner, :2]
                    found.setdefault(partner, []).append(np.array([*at, theta]))
        return {partner: np.array(Ts) for partner, Ts in found.items()}


def _cells(Ts: Array) -> list[Cell]:
    """The cell of each T12 (m, 3)."""
    x, y = np.floor(Ts[:, 0] / CELL_M).astype(int), np.floor(Ts[:, 1] / CELL_M).astype(int)
    turn = np.floor(np.mod(Ts[:, 2], 2 * pi) * TURNS / (2 * pi)).astype(int) % TURNS
    return list(zip(x.tolist(), y.tolist(), turn.tolist(), strict=True))
