"""What is alike in many maps: triangles of near landmarks, and the votes of those that are alike for a placement.

Which pairs of maps that makes worth trying: `index`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapfuse.datasets.arms import signature
from mapfuse.datasets.compiled import kernels
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
#: Votes for about one turn that are together worth less [nats] are not added up any further.
FAINT = 6.0
#: A triangle without arms that is like so many others, and so votes with less than this [nats], isn't asked.
MANY, COMMON = 300, 0.5
#: Maps whose triangles are laid out to be asked at once.
BLOCK = 64


class LengthNoise(NamedTuple):
    """Standard deviation of a length between two landmarks: a fixed part [m], and a share of the length."""

    fixed: float
    share: float

    def and_of(self, other: LengthNoise) -> LengthNoise:
        """Of the difference of a length in two maps."""
        return LengthNoise(float(np.hypot(self.fixed, other.fixed)), max(self.share, other.share))


@dataclass(frozen=True, eq=False, slots=True)
class MapTriangles:
    """What is kept of a map: landmarks around their middle, and places (k, 3) of its triangles in them.

    ``ways``, ``walls``: bits of the `SECTORS` that passable and blocked arms point to.
    """

    name: str
    known: frozenset[str]
    positions: NDArray[np.float32]
    labels: NDArray[np.int32]
    ways: NDArray[np.int64]
    walls: NDArray[np.int64]
    triangles: NDArray[np.int16]
    noise: LengthNoise


def triangles_of(recorded: LandmarkMap, number_from_label: dict[str, int]) -> MapTriangles:
    """What is kept of a map; ``number_from_label`` learns its labels."""
    ways, walls = np.zeros(len(recorded), dtype=np.int64), np.zeros(len(recorded), dtype=np.int64)
    for k, landmark in enumerate(recorded.landmarks):
        found = signature(landmark)
        for heading, passable in zip(found.headings, found.passable, strict=True):
            (ways if passable else walls)[k] |= 1 << round(heading * SECTORS / (2 * np.pi)) % SECTORS
    labels = [number_from_label.setdefault(type_, len(number_from_label)) for type_ in recorded.types]
    triangles = _triangles(recorded.positions)
    middle = recorded.positions.mean(axis=0) if len(recorded) else np.zeros(2)
    return MapTriangles(
        recorded.name,
        frozenset(other for of_landmark in recorded.same_as.values() for other in of_landmark),
        (recorded.positions - middle).astype(np.float32),
        np.array(labels, dtype=np.int32),
        ways,
        walls,
        triangles,
        _length_noise(recorded, triangles),
    )


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


def _length_noise(recorded: LandmarkMap, triangles: NDArray[np.int16]) -> LengthNoise:
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


def _rounded(fixed: float, share: float) -> LengthNoise:
    fixed, share = (float(2.0 ** np.round(np.log2(x))) for x in (min(max(fixed, 1e-3), 1e3), max(share, 1e-3)))
    return LengthNoise(fixed, min(max(share, LEAST_PER_METRE), PER_METRE))


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

    def points(self, noise: LengthNoise) -> Array:
        """Points (k, 3) whose distance is in standard deviations."""
        return np.asarray(np.sign(self.shape) * np.log1p(np.abs(self.shape) * noise.share / noise.fixed) / noise.share)

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
    def of(cls, maps: Iterable[MapTriangles], ranked: Indices) -> _All:
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

    def corners(self, maps: Sequence[MapTriangles], low: int, high: int, slack: bool) -> _Corners:
        """Triangles of the maps from ``low`` up to ``high`` with their corners in the order that stands in the tree:
        the longest side first, the third corner nearer to its start. Where ``slack``, also in every other order that
        noise may make of that one."""
        map_ = np.repeat(np.arange(low, high), [len(m.triangles) for m in maps[low:high]])
        triangles = np.concatenate([m.triangles for m in maps[low:high]]).astype(np.intp) + self.first[map_][:, None]
        fixed, share = np.array([m.noise for m in maps[low:high]])[map_ - low].T
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
        together = _Corners(
            *(np.concatenate([getattr(p, n) for p in parts]) for n in ("map", "corners", "shape", "labels"))
        )
        return together.of(np.argsort(together.map, kind="stable"))


def _widened(bits: NDArray[np.int64]) -> NDArray[np.int64]:
    """Bits of sectors with those up to `ARM_APART` beside them."""
    wide = np.zeros_like(bits)
    for by in range(-ARM_APART, ARM_APART + 1):
        turned = bits << (by % SECTORS)
        wide |= (turned | (turned >> SECTORS)) & ((1 << SECTORS) - 1)
    return wide


def votes(maps: list[MapTriangles], ranked: Indices) -> Iterator[tuple[int, Indices, Array]]:
    """Of each map its place, those (k,) of other maps whose triangles agree with its own, and how much [nats] (k,).

    ``ranked``: of each label its place in alphabetical order, so that nothing depends on which map came first.
    """
    if not any(len(m.triangles) for m in maps):
        return
    kernel = kernels("_index_kernels", __package__, "the index of maps")
    landmarks = _All.of(maps, ranked)
    search = _Search(landmarks.corners(maps, 0, len(maps), slack=False), [m.noise for m in maps], landmarks, kernel)
    for low in range(0, len(maps), BLOCK):
        high = min(low + BLOCK, len(maps))
        asked = landmarks.corners(maps, low, high, slack=True)
        ends = np.searchsorted(asked.map, np.arange(low, high + 1))
        for k in range(low, high):
            yield k, *search.of_map(k, asked.of(np.arange(ends[k - low], ends[k - low + 1])))


class _Search:
    """Triangles of one map that are like those of others, and what they say together."""

    def __init__(self, stored: _Corners, noise: Sequence[LengthNoise], landmarks: _All, kernel: ModuleType) -> None:
        self.stored, self.landmarks, self.kernel, self.maps = stored, landmarks, kernel, len(noise)
        self.noises = sorted(set(noise))
        self.noise_of = np.array([self.noises.index(of_map) for of_map in noise])
        self.armed = (landmarks.ways | landmarks.walls) != 0
        self.grids: dict[int, tuple[Indices, Array, Indices, Indices, Indices]] = {}

    def of_map(self, own: int, asked: _Corners) -> tuple[Indices, Array]:
        """Places of other maps, in their order, and what the best placement of each is worth [nats]."""
        kernel, landmarks = self.kernel, self.landmarks
        mine = self.noises[self.noise_of[own]]
        points = np.array([asked.points(mine.and_of(theirs)) for theirs in self.noises])
        bare = ~self.armed[asked.corners].any(axis=1)
        order, stored, labels, cell, map_of = self._grid(int(self.noise_of[own]))
        compared = (stored, labels, cell, ALIKE, map_of)
        hits = kernel.alike(points, asked.labels, *compared, own, bare, self.maps, MANY, COMMON)
        asked_of, stored_of = hits[:, 0], order[hits[:, 1]]
        shift, turn, against = kernel.placements(
            asked.corners[asked_of],
            self.stored.corners[stored_of],
            landmarks.positions,
            landmarks.ways,
            landmarks.walls,
            landmarks.near_ways,
            landmarks.near_walls,
            SECTORS,
        )
        may = against <= MAX_CONTRADICTIONS
        asked_of, map_of = asked_of[may], self.stored.map[stored_of[may]]
        weight = kernel.weights(asked_of, map_of, against[may], self.maps, RAREST, CONTRADICTED)
        others, worth = kernel.fullest(map_of, shift[may], turn[may], weight, np.array(CELL), FAINT)
        return np.asarray(others), np.asarray(worth)

    def _grid(self, mine: int) -> tuple[Indices, Array, Indices, Indices, Indices]:
        """All triangles as they compare with those of one class of noise, in the order of their cells: their places,
        points, labels, cells and maps."""
        if mine not in self.grids:
            theirs = self.noise_of[self.stored.map]
            points = np.empty((len(theirs), 3))
            for k, noise in enumerate(self.noises):
                points[theirs == k] = self.stored.of(theirs == k).points(self.noises[mine].and_of(noise))
            labels = self.stored.labels * len(self.noises) + theirs
            cell = self.kernel.cells(points, labels, ALIKE)
            order = np.argsort(cell, kind="stable")
            self.grids[mine] = order, points[order], labels[order], cell[order], self.stored.map[order]
        return self.grids[mine]
