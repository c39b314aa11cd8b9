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
from mapfuse.datasets.transform import Transform

from ..far import carried
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
#: Cells to either side of the origin.
_HALF = 1 << 20
_AROUND = tuple(product((-1, 0, 1), repeat=3))
#: Turns that lay a kind onto itself.
_SYMMETRY = {Kind.CROSSING: 4, Kind.CORRIDOR: 2}


class Rival(NamedTuple):
    """A placement that landmarks vote for: T12 about, as x, y [m], theta [rad], and by how many pairs of them."""

    T12: tuple[float, float, float]
    votes: int


@dataclass
class _Side:
    """One map's landmarks as they voted last: place by id, x, y, direction (NaN: none), type, kind. In local
    coordinates, of ``origin`` (2,) [m]."""

    ids: list[str] = field(default_factory=list)
    place: dict[str, int] = field(default_factory=dict)
    poses: Array = field(default_factory=lambda: np.zeros((0, 3)))
    types: list[str] = field(default_factory=list)
    symmetry: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    numbers: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    size: int = 0
    next_number: int = 0
    of_type: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    origin: Array = field(default_factory=lambda: np.zeros(2))

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
            self.numbers = np.append(self.numbers, np.zeros(max(16, self.size), dtype=np.int64))
        k = self.size
        self.size += 1
        self.ids.append(landmark.id)
        self.types.append(landmark.type)
        self.place[landmark.id] = k
        self.poses[k], self.symmetry[k], self.numbers[k] = pose, symmetry, self.next_number
        self.next_number += 1
        self.of_type[landmark.type].append(k)
        return True

    def number(self, name: str) -> int | None:
        """Under which number a landmark has voted; None: it hasn't."""
        k = self.place.get(name)
        return None if k is None else int(self.numbers[k])

    def alike(self, mine: NDArray[np.intp], theirs: _Side, others: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which landmarks here are of the type of which there, (n, m)."""
        here = np.array([self.types[k] for k in mine.tolist()])
        return np.asarray(here[:, None] == np.array([theirs.types[k] for k in others.tolist()]))

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
        self.poses, self.symmetry, self.numbers = self.poses[kept], self.symmetry[kept], self.numbers[kept]
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
    """Votes of one pair of maps: rows of (landmark of 1, landmark of 2, cell), and how many each cell has."""

    def __init__(self) -> None:
        self.rows = np.zeros((256, 3), dtype=np.int64)
        self.size = self.dead = 0
        self.counts: dict[int, int] = defaultdict(int)
        self.strong: set[int] = set()
        self.bound = 2

    def vote(self, a: NDArray[np.int64], b: NDArray[np.int64], cells: NDArray[np.int64]) -> None:
        """Votes by pairs of landmarks, by their numbers."""
        end = self.size + len(cells)
        if end > len(self.rows):
            self.rows = np.concatenate([self.rows, np.zeros((max(len(self.rows), len(cells)), 3), dtype=np.int64)])
        self.rows[self.size : end, 0], self.rows[self.size : end, 1], self.rows[self.size : end, 2] = a, b, cells
        self.size = end
        for cell in cells.tolist():
            self.counts[cell] += 1
            if self.counts[cell] >= self.bound:
                self.strong.add(cell)
        while len(self.strong) > 8 * IN_SIGHT:
            self.bound += 1
            self.strong = {cell for cell in self.strong if self.counts[cell] >= self.bound}

    def forget(self, side: int, number: int) -> None:
        """Take back all votes that a landmark of map 1 (``side`` 0) or 2 has part in."""
        gone = np.flatnonzero(self.rows[: self.size, side] == number)
        for cell in self.rows[gone, 2].tolist():
            self.counts[cell] -= 1
            if self.counts[cell] < self.bound:
                self.strong.discard(cell)
            if not self.counts[cell]:
                del self.counts[cell]
        self.rows[gone] = -1
        self.dead += len(gone)
        if 2 * self.dead > self.size:
            kept = self.rows[: self.size][self.rows[: self.size, 0] >= 0]
            self.rows[: len(kept)] = kept
            self.size, self.dead = len(kept), 0

    def around(self, cell: int) -> int:
        """Votes of a cell and those it touches."""
        x, y, turn = _unpacked(cell)
        return sum(self.counts.get(_packed(x + i, y + j, (turn + k) % TURNS), 0) for i, j, k in _AROUND)

    def best(self) -> list[tuple[int, Cell]]:
        """Cells in sight with the votes around them, best first, one of each that touch."""
        ranked = sorted(((self.around(c), self.counts[c], c) for c in self.strong), key=lambda r: (-r[0], -r[1], r[2]))
        kept: list[tuple[int, Cell]] = []
        for votes, _, packed in ranked[: 4 * IN_SIGHT]:
            cell = _unpacked(packed)
            if not any(_touch(cell, other) for _, other in kept):
                kept.append((votes, cell))
            if len(kept) == IN_SIGHT:
                break
        return kept

    def most(self) -> int:
        """Votes of the cell that has most, and those around it."""
        fullest = sorted(self.strong, key=lambda c: (-self.counts[c], c))[:8]
        return max((self.around(c) for c in fullest), default=0)


def _packed(x: int, y: int, turn: int) -> int:
    return ((x + _HALF) * 2 * _HALF + y + _HALF) * TURNS + turn


def _unpacked(cell: int) -> Cell:
    rest, turn = divmod(cell, TURNS)
    x, y = divmod(rest, 2 * _HALF)
    return x - _HALF, y - _HALF, turn


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
        side.origin = segment.origin
        anew: list[str] = []
        for identifier in ids:
            landmark = segment.local(identifier)
            before = side.number(identifier)
            if landmark is None:
                if before is not None:
                    side.drop(identifier)
                    self._forget(name, before)
            elif side.put(landmark):
                if before is not None:
                    self._forget(name, before)
                anew.append(identifier)
        for other in sorted(self._sides):
            if other != name:
                for identifier in anew:
                    self._vote(name, identifier, other)

    def votes(self, map1: str, map2: str) -> int:
        """About how many pairs of landmarks vote for the best placement."""
        one, two = sorted((map1, map2))
        table = self._tables.get((one, two))
        return 0 if table is None else table.most()

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
            T12 = carried(Transform.from_array(T), self._sides[map1].origin, self._sides[map2].origin)
            found.append(Rival((T12.x, T12.y, T12.theta), votes))
        return tuple(found)

    def _forget(self, name: str, number: int) -> None:
        for (one, two), table in self._tables.items():
            if name in (one, two):
                table.forget(0 if one == name else 1, number)

    def _vote(self, name: str, identifier: str, other: str) -> None:
        mine, theirs = self._sides[name], self._sides[other]
        k = mine.place[identifier]
        first = name < other
        partners, Ts = (_by_distance if np.isnan(mine.poses[k, 2]) else _by_heading)(mine, k, theirs)
        if not len(partners):
            return
        numbers, own = theirs.numbers[partners], np.full(len(partners), mine.numbers[k])
        cells = _cells(Ts if first else np.asarray(se2.inverse(Ts)))
        table = self._tables[(name, other) if first else (other, name)]
        # a pair votes once for each cell
        votes = np.unique(np.column_stack([own, numbers, cells] if first else [numbers, own, cells]), axis=0)
        table.vote(votes[:, 0], votes[:, 1], votes[:, 2])


Proposals: TypeAlias = tuple[NDArray[np.intp], Array]
_NOTHING: Proposals = (np.zeros(0, dtype=np.intp), np.zeros((0, 3)))


def _by_heading(mine: _Side, k: int, theirs: _Side) -> Proposals:
    """Landmarks of the same type, and the T (m, 3) that lay them on the k-th of mine."""
    same = np.array(theirs.of_type.get(mine.types[k], ()), dtype=np.intp)
    same = same[~np.isnan(theirs.poses[same, 2])]
    if not len(same):
        return _NOTHING
    pose = mine.poses[k]
    ways = np.maximum(theirs.symmetry[same], mine.symmetry[k])
    nth = np.arange(ways.sum()) - np.repeat(np.cumsum(ways) - ways, ways)
    same, turn = np.repeat(same, ways), nth * 2 * pi / np.repeat(ways, ways)
    there = theirs.poses[same]
    theta = pose[2] - there[:, 2] + turn
    c, s = np.cos(theta), np.sin(theta)
    x = pose[0] - c * there[:, 0] + s * there[:, 1]
    y = pose[1] - s * there[:, 0] - c * there[:, 1]
    return same, np.column_stack([x, y, theta])


def _by_distance(mine: _Side, k: int, theirs: _Side) -> Proposals:
    """The same from pairs of near landmarks that are as far apart there as here."""
    near = mine.neighbours(k)
    there = theirs.of_type.get(mine.types[k], [])
    if not len(near) or not there:
        return _NOTHING
    d1 = mine.poses[near, :2] - mine.poses[k, :2]
    r1 = np.hypot(*d1.T)
    partners, Ts = [_NOTHING[0]], [_NOTHING[1]]
    for partner in there:
        far = theirs.neighbours(partner)
        if not len(far):
            continue
        d2 = theirs.poses[far, :2] - theirs.poses[partner, :2]
        r2 = np.hypot(*d2.T)
        equal = (np.abs(r1[:, None] - r2) < EQUAL_M) & (np.minimum(r1[:, None], r2) > EQUAL_M)
        here, also = np.nonzero(equal & mine.alike(near, theirs, far))
        if not len(here):
            continue
        theta = np.arctan2(d1[here, 1], d1[here, 0]) - np.arctan2(d2[also, 1], d2[also, 0])
        at = mine.poses[k, :2] - np.einsum("kij,j->ki", se2.rotation(theta), theirs.poses[partner, :2])
        Ts.append(np.column_stack([at, theta]))
        partners.append(np.full(len(here), partner, dtype=np.intp))
    return np.concatenate(partners), np.concatenate(Ts)


def _cells(Ts: Array) -> NDArray[np.int64]:
    """The cell of each T12 (m, 3)."""
    x, y = np.floor(Ts[:, 0] / CELL_M).astype(np.int64), np.floor(Ts[:, 1] / CELL_M).astype(np.int64)
    turn = np.floor(np.mod(Ts[:, 2], 2 * pi) * TURNS / (2 * pi)).astype(np.int64) % TURNS
    # placements beyond all bounds share the outermost cells
    x, y = np.clip(x, 2 - _HALF, _HALF - 2), np.clip(y, 2 - _HALF, _HALF - 2)
    return np.asarray(((x + _HALF) * 2 * _HALF + y + _HALF) * TURNS + turn)
