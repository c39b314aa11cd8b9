"""`MapIndex`: which of many maps are worth pairing, without looking at all pairs.

What is distinctive in a map are triangles of near neighbours: the labels of the three landmarks, the lengths between
them, and which way their arms point. The triangles of all maps stand in one KD-tree. Two that are alike vote for the
T12 that lays one map on the other, the rarer they are the more, and the votes for one T12 are what a pair is worth.
A pair is tried where it is worth much, or something and more than most others of one of its maps.

Measured: docs/batch.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapfuse.datasets import se2
from mapfuse.datasets.arms import signature
from mapfuse.datasets.maps import JointCovariance, LandmarkMap

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Landmarks whose triangles with each other are looked at: so many nearest ones around each.
NEIGHBOURS = 8
#: How far two triangles may be apart to be alike, in standard deviations of the difference of their sides.
ALIKE = 3.0
#: A length differs between two maps by this share of it at one sigma, besides its fixed part: where a map doesn't say,
#: and at least.
PER_METRE, LEAST_PER_METRE = 0.03, 0.004
#: What arms that contradict take off a vote: this factor each, up to so many.
CONTRADICTED, MAX_CONTRADICTIONS = 0.5, 1
#: Directions of arms are told in so many steps of a turn; those no further apart than `ARM_APART` steps are one.
SECTORS, ARM_APART = 24, 2
#: A vote counts no more than this [nats], however rare the triangle.
RAREST = 4.0
#: Votes for one T12 lie in one cell [m, m, rad] of the place and turn of map 2.
CELL = (3.0, 3.0, 0.2)
#: Pairs worth this [nats] are tried; those worth `FAINT` where one of the maps has no more than `PARTNERS` better ones.
SURE, FAINT, PARTNERS = 30.0, 6.0, 20
#: With so few maps all pairs are tried: what is rare can't be told yet.
FEW = 12
#: A triangle without arms that is like so many others, and so votes with less than this [nats], isn't asked.
MANY, COMMON = 300, 0.5
#: Maps looked up at once: so many, and fewer where that would be more hits than this.
BLOCK, MOST_HITS = 64, 1_000_000


@dataclass(frozen=True, slots=True)
class Proposal:
    """Two maps worth comparing, by name, the first in alphabetical order first; ``score`` [nats] says how much."""

    map1: str
    map2: str
    score: float


class _LengthNoise(NamedTuple):
    """Standard deviation of a length between two landmarks: a fixed part [m], and a share of the length."""

    fixed: float
    share: float

    def and_of(self, other: _LengthNoise) -> _LengthNoise:
        """Of the difference of a length in two maps."""
        return _LengthNoise(float(np.hypot(self.fixed, other.fixed)), max(self.share, other.share))


@dataclass(frozen=True, eq=False, slots=True)
class _Map:
    """What the index keeps of a map: landmarks, and places (k, 3) of its triangles in them.

    ``ways``, ``walls``: bits of the `SECTORS` that passable and blocked arms point to.
    """

    name: str
    known: frozenset[str]
    positions: NDArray[np.float32]
    labels: NDArray[np.int32]
    ways: NDArray[np.int64]
    walls: NDArray[np.int64]
    triangles: NDArray[np.int16]
    noise: _LengthNoise


class MapIndex:
    """An index that maps are added to, one by one.

    >>> from mapfuse.datasets import read_map, recordings
    >>> index = MapIndex()
    >>> for name in recordings.SCENES["ground-floor"]:
    ...     index.add(read_map(recordings.path(name)))
    >>> [(proposal.map1, proposal.map2) for proposal in index.pairs()]
    [('ground-floor-milka', 'ground-floor-vespucci')]
    """

    def __init__(self) -> None:
        self._maps: list[_Map] = []
        self._labels: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._maps)

    def add(self, recorded: LandmarkMap) -> None:
        """Take in a map; names differ."""
        ways, walls = np.zeros(len(recorded), dtype=np.int64), np.zeros(len(recorded), dtype=np.int64)
        for k, landmark in enumerate(recorded.landmarks):
            found = signature(landmark)
            for heading, passable in zip(found.headings, found.passable, strict=True):
                (ways if passable else walls)[k] |= 1 << round(heading * SECTORS / (2 * np.pi)) % SECTORS
        labels = [self._labels.setdefault(type_, len(self._labels)) for type_ in recorded.types]
        triangles = _triangles(recorded.positions)
        middle = recorded.positions.mean(axis=0) if len(recorded) else np.zeros(2)
        self._maps.append(
            _Map(
                recorded.name,
                frozenset(other for of_landmark in recorded.same_as.values() for other in of_landmark),
                (recorded.positions - middle).astype(np.float32),
                np.array(labels, dtype=np.int32),
                ways,
                walls,
                triangles,
                _length_noise(recorded, triangles),
            )
        )

    def pairs(self) -> list[Proposal]:
        """The pairs worth comparing, by name; the same whatever order the maps came in."""
        maps = sorted(self._maps, key=lambda m: m.name)
        names = [m.name for m in maps]
        place = {name: k for k, name in enumerate(names)}
        said = {(min(k, place[o]), max(k, place[o])) for k, m in enumerate(maps) for o in m.known if o in place}
        if len(maps) <= FEW:
            scores = dict.fromkeys(combinations(range(len(maps)), 2), 0.0)
        else:
            scores = _kept(_scores(maps, self._ranked_labels()), len(maps))
        scores |= {pair: max(scores.get(pair, 0.0), SURE) for pair in said if pair[0] != pair[1]}
        return [Proposal(names[a], names[b], scores[a, b]) for a, b in sorted(scores)]

    def _ranked_labels(self) -> Indices:
        """Each label's place in alphabetical order."""
        ranked = {label: rank for rank, label in enumerate(sorted(self._labels))}
        return np.array([ranked[label] for label in self._labels], dtype=np.intp)


def _triangles(positions: Array) -> NDArray[np.int16]:
    """Places (k, 3) of the triangles that each landmark makes with its nearest neighbours."""
    n = len(positions)
    if n < 3:
        return np.zeros((0, 3), dtype=np.int16)
    near = cKDTree(positions).query(positions, k=min(NEIGHBOURS + 1, n))[1]
    found = {
        tuple(sorted((k, a, b)))
        for k, row in enumerate(np.asarray(near).tolist())
        for a, b in combinations([other for other in row if other != k], 2)
    }
    return np.array(sorted(found), dtype=np.int16).reshape(-1, 3)


def _length_noise(recorded: LandmarkMap, triangles: NDArray[np.int16]) -> _LengthNoise:
    """Of the sides of a map's triangles, in powers of two, so that few maps differ."""
    if recorded.joint_covariance is not None:
        stated = _stated_length_noise(recorded, recorded.joint_covariance, triangles)
        if stated is not None:
            return _rounded(*stated)
    linked = any(link.distance is not None for landmark in recorded.landmarks for link in landmark.links)
    own = [float(np.sqrt(np.trace(l.covariance[:2, :2]))) for l in recorded.landmarks if l.covariance is not None]
    sigma = np.sqrt(2) * recorded.noise.position_sigma
    if own:
        sigma = min(sigma, float(np.median(own)))
    if linked:
        sigma = min(sigma, recorded.noise.distance_sigma_floor + np.sqrt(2) * 0.05)
    return _rounded(float(sigma), PER_METRE)


def _rounded(fixed: float, share: float) -> _LengthNoise:
    fixed, share = (float(2.0 ** np.round(np.log2(x))) for x in (min(max(fixed, 1e-3), 1e3), max(share, 1e-3)))
    return _LengthNoise(fixed, min(max(share, LEAST_PER_METRE), PER_METRE))


def _stated_length_noise(
    recorded: LandmarkMap, joint: JointCovariance, triangles: NDArray[np.int16]
) -> tuple[float, float] | None:
    """Fixed part and share of the sides' standard deviations that a joint covariance gives; None where it has none."""
    place = {id_: k for k, id_ in enumerate(joint.order)}
    row = joint.rows * np.array([place.get(landmark.id, -1) for landmark in recorded.landmarks])
    sides = np.unique(np.concatenate([triangles[:, k] for k in ([0, 1], [1, 2], [0, 2])]), axis=0)
    i, j = sides[(row[sides] >= 0).all(axis=1)].T
    if not len(i):
        return None
    side = recorded.positions[i] - recorded.positions[j]
    length = np.maximum(np.hypot(*side.T), 1e-9)

    def block(a: Indices, b: Indices) -> Array:
        at = np.arange(2)
        return np.asarray(joint.matrix[(row[a, None] + at)[:, :, None], (row[b, None] + at)[:, None, :]])

    of_side = block(i, i) + block(j, j) - block(i, j) - block(j, i)
    variance = np.einsum("ka,kab,kb->k", side, of_side, side) / length**2
    # robustly: the fixed part by the shorter half of the sides, what the longer ones have more by their length
    short = length <= np.median(length)
    fixed = max(float(np.median(variance[short])), 1e-6)
    more = np.median((variance[~short] - fixed) / length[~short] ** 2) if (~short).any() else 0.0
    return float(np.sqrt(fixed)), float(np.sqrt(max(more, 0.0)))


@dataclass(frozen=True, eq=False, slots=True)
class _Corners:
    """Triangles, their corners in some order: ``map`` (k,), ``corners`` (k, 3) places among all landmarks, ``shape``
    (k, 3) [m]: length of the first side, and the third corner along and across it; ``labels`` (k,)."""

    map: Indices
    corners: Indices
    shape: Array
    labels: Indices

    def coordinates(self, noise: _LengthNoise) -> Array:
        """Points (k, 4) whose distance is in standard deviations; other labels are far away."""
        warped = np.sign(self.shape) * np.log1p(np.abs(self.shape) * noise.share / noise.fixed) / noise.share
        return np.column_stack([warped, self.labels * 1e4])

    def of(self, which: NDArray[np.bool_] | Indices) -> _Corners:
        return _Corners(self.map[which], self.corners[which], self.shape[which], self.labels[which])


@dataclass(frozen=True, eq=False)
class _All:
    """The landmarks of all maps behind each other; ``near_ways``, ``near_walls``: arms and what is close to them."""

    positions: Array
    labels: Indices
    ways: NDArray[np.int64]
    walls: NDArray[np.int64]
    near_ways: NDArray[np.int64]
    near_walls: NDArray[np.int64]
    first: Indices

    @classmethod
    def of(cls, maps: Iterable[_Map], ranked: Indices) -> _All:
        maps = list(maps)
        ways, walls = np.concatenate([m.ways for m in maps]), np.concatenate([m.walls for m in maps])
        return cls(
            np.concatenate([m.positions for m in maps]).astype(float),
            ranked[np.concatenate([m.labels for m in maps])],
            ways,
            walls,
            _widened(ways),
            _widened(walls),
            np.cumsum([0, *(len(m.positions) for m in maps)]),
        )

    def corners(self, maps: Sequence[_Map], low: int, high: int, slack: bool) -> _Corners:
        """Triangles of the maps from ``low`` up to ``high`` with their corners in the order that stands in the tree:
        the longest side first, the third corner nearer to its start. Where ``slack``, also in every other order that
        noise may make of that one."""
        map_ = np.repeat(np.arange(low, high), [len(m.triangles) for m in maps[low:high]])
        triangles = np.concatenate([m.triangles for m in maps[low:high]]).astype(np.intp) + self.first[map_][:, None]
        fixed, share = np.array([m.noise for m in maps])[map_].T
        parts = []
        for order in permutations(range(3)):
            corners = triangles[:, order]
            a, b, c = (self.positions[corners[:, k]] for k in range(3))
            length, second, third = (np.hypot(*(q - p).T) for p, q in ((a, b), (b, c), (a, c)))
            along = (b - a) / np.maximum(length, 1e-9)[:, None]
            x = np.einsum("ki,ki->k", c - a, along)
            y = (c - a)[:, 1] * along[:, 0] - (c - a)[:, 0] * along[:, 1]
            play = ALIKE * (fixed + share * length) if slack else 0.0
            which = (np.maximum(second, third) <= length + play) & (x <= length / 2 + play)
            labels = (self.labels[corners] * (1 + self.labels.max()) ** np.arange(3)).sum(axis=1)
            parts.append(_Corners(map_, corners, np.column_stack([length, x, y]), labels).of(which))
        return _Corners(
            *(np.concatenate([getattr(p, n) for p in parts]) for n in ("map", "corners", "shape", "labels"))
        )


def _widened(bits: NDArray[np.int64]) -> NDArray[np.int64]:
    """Bits of sectors with those up to `ARM_APART` beside them."""
    wide = np.zeros_like(bits)
    for by in range(-ARM_APART, ARM_APART + 1):
        turned = bits << (by % SECTORS)
        wide |= (turned | (turned >> SECTORS)) & ((1 << SECTORS) - 1)
    return wide


def _scores(maps: list[_Map], ranked: Indices) -> Iterator[tuple[Indices, Indices, Array]]:
    """What pairs of maps are worth, block by block: places of the one and the other map, and nats."""
    if not any(len(m.triangles) for m in maps):
        return
    landmarks = _All.of(maps, ranked)
    stored = landmarks.corners(maps, 0, len(maps), slack=False)
    lookup = _Lookup(stored, [m.noise for m in maps], landmarks)
    low, size = 0, 1
    while low < len(maps):
        high = min(low + size, len(maps))
        asked = landmarks.corners(maps, low, high, slack=True)
        hits = lookup.hits(asked)
        yield _voted(asked.of(hits[:, 0]), stored.of(hits[:, 1]), hits[:, 0], landmarks, len(maps))
        low, size = high, int(np.clip(size * MOST_HITS / max(len(hits), 1), 1, BLOCK))


class _Lookup:
    """Triangles of some maps that are like those of others, in bounded memory."""

    def __init__(self, stored: _Corners, noise: Sequence[_LengthNoise], landmarks: _All) -> None:
        self.stored = stored
        self.noises = sorted(set(noise))
        self.noise_of = np.array([self.noises.index(of_map) for of_map in noise])
        self.armed = (landmarks.ways | landmarks.walls) != 0
        self.trees: dict[tuple[int, int], tuple[cKDTree, Indices]] = {}

    def hits(self, asked: _Corners) -> Indices:
        """Pairs (k, 2) of triangles that are alike: places in ``asked``, and of triangles of other maps."""
        found = [np.zeros((0, 2), dtype=np.intp)]
        noise_of, bare = self.noise_of[asked.map], ~self.armed[asked.corners].any(axis=1)
        for mine in np.unique(noise_of).tolist():
            own, size = np.flatnonzero(noise_of == mine), 100
            while len(own):
                now, own = own[:size], own[size:]
                hits = np.concatenate([self._alike(asked, now, mine, theirs) for theirs in range(len(self.noises))])
                size = int(np.clip(size * MOST_HITS / max(len(hits), 1), 1, 10 * size))
                found.append(self._telling(hits, asked.map, bare))
        return np.concatenate(found)

    def _alike(self, asked: _Corners, own: Indices, mine: int, theirs: int) -> Indices:
        noise = self.noises[mine].and_of(self.noises[theirs])
        if (mine, theirs) not in self.trees:
            others = np.flatnonzero(self.noise_of[self.stored.map] == theirs)
            self.trees[mine, theirs] = cKDTree(self.stored.of(others).coordinates(noise)), others
        tree, others = self.trees[mine, theirs]
        here = cKDTree(asked.of(own).coordinates(noise))
        hits = here.sparse_distance_matrix(tree, ALIKE, output_type="ndarray")
        return np.column_stack([own[hits["i"]], others[hits["j"]]])

    def _telling(self, hits: Indices, asked_map: Indices, bare: NDArray[np.bool_]) -> Indices:
        """Those in another map; not of triangles without arms that are like many and tell little."""
        n = len(self.noise_of)
        theirs = self.stored.map[hits[:, 1]]
        hits, theirs = (values[asked_map[hits[:, 0]] != theirs] for values in (hits, theirs))
        triangles, number = np.unique(hits[:, 0], return_inverse=True)
        common = np.bincount(np.unique(number * n + theirs) // n, minlength=len(triangles))
        tells = ~bare[triangles] | (np.bincount(number) < MANY) | (np.log(n / np.maximum(common, 1)) >= COMMON)
        return np.asarray(hits[tells[number]])


def _voted(one: _Corners, other: _Corners, asked: Indices, landmarks: _All, n: int) -> tuple[Indices, Indices, Array]:
    """Votes of triangles that are alike, those of each pair of maps that agree added up."""
    p1, p2 = landmarks.positions[one.corners], landmarks.positions[other.corners]
    middle1, middle2 = p1.mean(axis=1), p2.mean(axis=1)
    off1, off2 = p1 - middle1[:, None], p2 - middle2[:, None]
    sine = (off2[..., 0] * off1[..., 1] - off2[..., 1] * off1[..., 0]).sum(axis=1)
    turn = np.arctan2(sine, (off2 * off1).sum(axis=(1, 2)))
    # maps lie around their middles: the shift is where map 2's middle comes to lie
    shift = middle1 - np.asarray(se2.transform(np.column_stack([np.zeros((len(turn), 2)), turn]), middle2))
    against = _contradictions(one.corners, other.corners, turn, landmarks)
    may = np.flatnonzero(against <= MAX_CONTRADICTIONS)
    asked, mine, theirs = asked[may], one.map[may], other.map[may]
    of_triangle = np.unique(asked * n + theirs) // n
    common = np.bincount(of_triangle, minlength=int(asked.max(initial=0)) + 1)
    weight = np.clip(np.log(n / np.maximum(common[asked], 1)), 0.0, RAREST) * CONTRADICTED ** against[may]
    return _densest(mine * n + theirs, shift[may], turn[may], weight, n)


def _contradictions(corners1: Indices, corners2: Indices, turn: Array, landmarks: _All) -> Indices:
    """How many arms of the corners meet one that says the opposite, map 2 being turned by ``turn`` (k,)."""
    steps = np.round(turn * SECTORS / (2 * np.pi)).astype(np.int64) % SECTORS
    count = np.zeros(len(turn), dtype=np.intp)
    for k in range(3):
        for arms, others in ((landmarks.ways, landmarks.near_walls), (landmarks.walls, landmarks.near_ways)):
            turned = others[corners2[:, k]] << steps
            turned = (turned | (turned >> SECTORS)) & ((1 << SECTORS) - 1)
            count += np.bitwise_count(arms[corners1[:, k]] & turned)
    return count


def _densest(pair: Indices, shift: Array, turn: Array, weight: Array, n: int) -> tuple[Indices, Indices, Array]:
    """Per pair the weight of the fullest cell, over grids that are shifted by half a cell each way."""
    turns = int(np.ceil(2 * np.pi / CELL[2]))
    enough = _enough(pair, turn, weight)
    pair, shift, turn, weight = pair[enough], shift[enough], turn[enough], weight[enough]
    pairs, number = np.unique(pair, return_inverse=True)
    best = np.zeros(len(pairs))
    # far shifts share cells with others: it happens seldom, and only adds a pair to try
    wide = 1 << 10
    for half in np.ndindex(2, 2, 2):
        x, y = (np.floor(shift[:, k] / CELL[k] + half[k] / 2).astype(np.int64) % wide for k in range(2))
        angle = np.floor((turn % (2 * np.pi)) / CELL[2] + half[2] / 2).astype(np.int64) % turns
        cell, where = np.unique(((number * wide + x) * wide + y) * turns + angle, return_inverse=True)
        np.maximum.at(best, cell // (wide * wide * turns), np.bincount(where, weights=weight))
    return pairs // n, pairs % n, best


def _enough(pair: Indices, turn: Array, weight: Array) -> NDArray[np.bool_]:
    """Votes of pairs whose votes for about that turn are together worth trying it."""
    wide = int(np.pi / CELL[2])
    enough = np.zeros(len(pair), dtype=bool)
    for half in range(2):
        angle = np.floor((turn % (2 * np.pi)) / (2 * np.pi) * wide + half / 2).astype(np.int64) % wide
        _, where = np.unique(pair * wide + angle, return_inverse=True)
        enough |= np.bincount(where, weights=weight)[where] >= FAINT
    return enough


def _kept(scores: Iterable[tuple[Indices, Indices, Array]], n: int) -> dict[tuple[int, int], float]:
    """The pairs to try, each with the larger of what either map thinks of the other."""
    best: dict[tuple[int, int], float] = {}
    for mine, others, worth in scores:
        for k in np.unique(mine).tolist():
            of_map = np.flatnonzero((mine == k) & (worth >= FAINT))
            of_map = of_map[np.lexsort((others[of_map], -worth[of_map]))]
            for rank, m in enumerate(of_map.tolist()):
                if rank >= PARTNERS and worth[m] < SURE:
                    break
                pair = (min(k, int(others[m])), max(k, int(others[m])))
                best[pair] = max(best.get(pair, 0.0), float(worth[m]))
    return best
