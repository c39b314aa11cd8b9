"""Hypotheses of T12 from landmarks with headings, by votes in SE(2); fast for any number of landmarks.

1. *Turns*: two landmarks of one label propose the rotations that lay arms on arms. A histogram of all of them over the
   circle has peaks, the *rotation modes*: four in a right-angled building, others in others.
2. *Votes*: for each mode every pair that proposes it votes for its translation, in a grid of counters. In large maps
   some hundreds of map 2's landmarks do. Small maps need no vote: each pair is a candidate.
3. *Refinement*: the strongest peaks are matched one to one, aligned, and matched again.
4. *Score*: log likelihood ratio against "these maps show different places": what matches, what doesn't although the
   other robot passed it, and the emptiness that both agree on (docs/matching.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.compiled import kernels
from mapfuse.datasets.maps import DOOR, LandmarkMap
from mapfuse.datasets.transform import Transform

from .config import MatchingConfig
from .hypothesis import Correspondences, Hypothesis
from .landmark_arrays import LandmarkArrays, frozen, landmark_arrays, shared_labels
from .travelled import Travelled

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


def turn_kernels() -> ModuleType:
    """The compiled loops over what pairs of landmarks propose."""
    return kernels("_turn_kernels", __package__, "the matcher's proposals")


def vote_kernels() -> ModuleType:
    """The compiled loops over votes."""
    return kernels("_vote_kernels", __package__, "the matcher's votes")


def match_kernels() -> ModuleType:
    """The compiled loops that match, align and score."""
    return kernels("_match_kernels", __package__, "the matcher")


@dataclass(frozen=True, slots=True)
class Settings:
    """Constants of the search; bounds of its work first.

    ``direct``: up to so many proposals are all tried without a vote. ``votes``: cast at most, by ``voters`` landmarks
    of map 2 at least. ``cells``: of the grid of counters, 40 a landmark
    between these bounds. ``peaks``: of each rotation mode; ``modes``: at most.
    ``glance``: landmarks of map 2 by which all candidates are compared, ``refined``: how many of them remain.
    ``sample``: landmarks by which these are refined where a map has more than ``full`` of them, and ``last``: how many
    are then still compared by all landmarks, at least, however large the maps are; ``few``: how many remain of large
    maps' after the glance, at least. Of more only those remain whose score is within ``behind`` [nats], times the root
    of the number of landmarks compared by, of the best one's: so the error of a sum over landmarks grows.
    ``ways``: how many places a robot's ways are sampled at. Maps of more than ``sorted`` landmarks are worked on in the
    order of place.
    ``cell_m`` [m]: of the grid. ``rotation_width`` [rad]: of a mode. ``looseness`` [rad]: by how much a candidate's
    rotation may be off. ``gate``: standard deviations. ``arm``, ``contradiction`` [nats]: for each arm that meets one
    of the same or of the other passability. ``least_gain`` [nats]: of a match. To measure what they are worth:
    ``against``: charge misses and credit the void; ``grow``: tolerance with distance; ``refine``: align.
    """

    direct: int = 2048
    votes: int = 200_000
    voters: int = 200
    cells: tuple[int, int] = (100_000, 2_000_000)
    peaks: int = 48
    modes: int = 32
    glance: int = 64
    refined: int = 80
    sample: int = 300
    full: int = 400
    last: int = 8
    few: int = 8
    behind: float = 4.0
    ways: int = 1500
    sorted: int = 2000
    cell_m: float = 1.5
    rotation_width: float = 0.12
    looseness: float = 0.04
    gate: float = 3.0
    most_sigma_m: float = 1.5
    arm: float = 0.5
    contradiction: float = 3.5
    least_gain: float = -1.0
    against: bool = True
    grow: bool = True
    refine: bool = True


SETTINGS = Settings()


@dataclass(frozen=True, eq=False)
class Candidates:
    """T12s (k, 3) and where in frame 2 each is known best (k, 2)."""

    T12s: Array
    centres: Array

    def __len__(self) -> int:
        return len(self.T12s)

    def taken(self, places: Indices) -> Candidates:
        """Some of them."""
        return Candidates(self.T12s.take(places, axis=0), self.centres.take(places, axis=0))


@dataclass(frozen=True, eq=False)
class Assessed:
    """Candidates matched and scored: ``score`` (k,) [nats], ``count`` (k,), ``partner`` (k, n2) in map 1 or -1,
    ``seed`` (k,): landmark of map 2 with the surest match, or -1."""

    candidates: Candidates
    score: Array
    count: NDArray[np.int32]
    partner: NDArray[np.int32]
    seed: NDArray[np.int32]

    def followed_by(self, other: Assessed) -> Assessed:
        """Both, one after the other."""
        T12s = np.concatenate([self.candidates.T12s, other.candidates.T12s])
        centres = np.concatenate([self.candidates.centres, other.candidates.centres])
        columns = [
            np.concatenate([getattr(side, name) for side in (self, other)])
            for name in ("score", "count", "partner", "seed")
        ]
        return Assessed(Candidates(T12s, centres), *columns)


def propose_by_votes(
    map1: LandmarkMap,
    map2: LandmarkMap,
    config: MatchingConfig | None = None,
    also: Sequence[Transform] = (),
    settings: Settings = SETTINGS,
) -> list[Hypothesis]:
    """Distinct hypotheses from the landmarks that have headings, best first, at most ``max_hypotheses``.

    ``also``: T12s from elsewhere, to be refined and ranked with the others. All landmarks count in the score, those
    without heading too. Empty where no turn lays a landmark on another and there is nothing else.
    """
    config = config or MatchingConfig()
    one, two = landmark_arrays(map1), landmark_arrays(map2)
    if not len(one) or not len(two):
        return []
    pair = Pair(one, two, config, settings)
    candidates = pair.proposals()
    if also:
        T12s = np.array([T12.array for T12 in also])
        centres = np.broadcast_to(two.xy.mean(axis=0), (len(also), 2))
        candidates = Candidates(np.concatenate([candidates.T12s, T12s]), np.concatenate([candidates.centres, centres]))
    if not len(candidates):
        return []
    return pair.hypotheses(map1, map2, pair.ranked(candidates))


def assessed(
    map1: LandmarkMap, map2: LandmarkMap, T12: Transform, config: MatchingConfig
) -> tuple[Transform, float, int]:
    """A T12 refined and scored as if it had been proposed: T12, score [nats], number of matches.

    Both maps have landmarks.
    """
    pair = Pair(landmark_arrays(map1), landmark_arrays(map2), config)
    found = pair.refined(Candidates(T12.array[None], pair.two.xy.mean(axis=0)[None]))
    return Transform(*found.candidates.T12s[0].tolist()), float(found.score[0]), int(found.count[0])


class Pair:
    """Two maps' arrays side by side, and the kernels run on them."""

    def __init__(
        self, one: LandmarkArrays, two: LandmarkArrays, config: MatchingConfig, settings: Settings = SETTINGS
    ) -> None:
        self.one, self.two, self.config, self.settings = one, two, config, settings
        self.kernels: ModuleType = match_kernels()
        label1, label2, _ = shared_labels(one, two)
        if not config.use_h1:
            label1, label2 = np.zeros_like(label1), np.zeros_like(label2)
        self.label1, self.label2 = label1, label2

    # proposals

    def proposals(self) -> Candidates:
        """Where T12 may be: every pair's turns in small maps, peaks of the vote in large ones."""
        k, p1, p2 = turn_kernels(), self.one.patterns, self.two.patterns
        if not len(p1.members) or not len(p2.members):
            return Candidates(np.zeros((0, 3)), np.zeros((0, 2)))
        own1, own2 = self.label1[p1.members[p1.start[:-1]]], self.label2[p2.members[p2.start[:-1]]]
        count, offset = k.turns_of_patterns(p1.arms, p1.open, own1, p2.arms, p2.open, own2)
        pattern2 = p2.pattern[p2.members]
        cast = k.votes_of_patterns(p1.start, count)[pattern2]
        total = int(cast.sum())
        if total <= self.settings.direct:
            T12s, pair = k.all_turns(
                p1.members, p1.start, p1.heading, p2.members, pattern2, p2.heading, count, offset,
                self.one.xy, self.two.xy, total,
            )  # fmt: skip
            return Candidates(T12s, self.two.xy[pair[:, 1]])
        voters = self._voters(cast)
        members = p2.members[voters]
        pattern2, heading2 = pattern2[voters], p2.heading[voters]
        xy1, xy2 = self.one.xy[p1.members], self.two.xy[members]
        votes = k.rotations(p1.start, p1.heading, pattern2, heading2, count, offset)
        modes = rotation_modes(votes, self.settings.rotation_width, self.settings.modes)
        size, shape = self._grid(xy1, xy2)

        # left empty by each vote: one does for all, unless they run at once
        only = np.zeros(shape, dtype=np.uint16) if self.config.threads <= 1 else None

        def vote(theta: float) -> tuple[Array, Array, Array]:
            grid = np.zeros(shape, dtype=np.uint16) if only is None else only
            found: tuple[Array, Array, Array] = vote_kernels().vote(
                p1.start, p1.heading, xy1, pattern2, heading2, xy2, count, offset,
                theta, self.settings.rotation_width, size, grid, self.settings.peaks,
            )  # fmt: skip
            return found

        T12s, centres, strength = (np.concatenate(part) for part in zip(*self.each(vote, modes), strict=True))
        strongest = np.argsort(-strength, kind="stable")[: 6 * self.settings.peaks]
        return Candidates(T12s[strongest], centres[strongest])

    def _voters(self, cast: NDArray[np.int64]) -> Indices:
        """Places among map 2's members of those who vote: all, or those with the fewest votes to cast first.

        Few votes mean a rare kind, whose votes say most. At least ``voters`` are heard, evenly spread over the kinds.
        """
        able = np.flatnonzero(cast > 0)
        if cast.sum() <= self.settings.votes:
            return able
        lonely = self.two.isolation_rank[self.two.patterns.members[able]]
        order = np.argsort(cast[able] * len(self.two) + lonely)
        within = int(np.searchsorted(np.cumsum(cast[able][order]), self.settings.votes / 2))
        rare = order[: max(within, 1)][: self.settings.voters]
        others = np.argsort(lonely)[np.linspace(0, len(lonely) - 1, self.settings.voters).astype(np.intp)]
        chosen = np.zeros(len(able), dtype=bool)
        chosen[rare] = chosen[others] = True
        return np.asarray(able[chosen])

    def _grid(self, xy1: Array, xy2: Array) -> tuple[float, tuple[int, int]]:
        """Size [m] of the cells of the counters, and how many there are along each axis."""
        diagonal2 = math.hypot(*_extent(xy2))
        extent = [length + diagonal2 for length in _extent(xy1)]
        least, most = self.settings.cells
        cells = float(min(max(40 * len(xy1), least), most))
        size = self.settings.cell_m
        wanted = (extent[0] / size + 3) * (extent[1] / size + 3)
        # larger cells up to a point; then the plane is folded
        size *= min(max(1.0, math.sqrt(wanted / cells)), 2.0)
        side = int(math.sqrt(cells))
        wide, high = (e / size + 3 for e in extent)
        nx, ny = int(min(wide, cells / min(side, high))), int(min(high, cells / min(side, wide)))
        return size, (max(nx, 3), max(ny, 3))

    def each(self, run: Callable[[Any], Any], jobs: Sequence[Any]) -> list[Any]:
        """Results of all jobs in order, on as many threads as the configuration says."""
        if self.config.threads <= 1 or len(jobs) <= 1:
            return [run(job) for job in jobs]
        with ThreadPoolExecutor(self.config.threads) as pool:
            return list(pool.map(run, jobs))

    # refinement and score

    def ranked(self, candidates: Candidates) -> Assessed:
        """Candidates refined, scored, distinct, best first.

        Large maps: compared by ever more of map 2's landmarks, ever fewer of them.
        """
        settings, scene = self.settings, _Scene(self)
        loose = settings.looseness
        if len(candidates) > 3 * settings.refined // 2:
            part = scene.part(settings.glance)
            rough = scene.assess(candidates, (loose,), part)
            fewest = settings.refined if scene.cost <= settings.full else settings.few
            candidates, _ = self._best(rough, settings.refined, fewest, settings.glance)
        cost = scene.cost
        if cost > settings.full:
            part = scene.part(settings.sample)
            if len(candidates) > 2 * settings.last:
                rough = scene.assess(candidates, (loose,), part)
                candidates, _ = self._best(rough, settings.refined, settings.last, settings.sample)
            limit = int(np.clip(settings.refined * settings.full / cost, settings.last, settings.refined))
            sampled = scene.assess(candidates, (loose, loose / 3, 0.0), part)
            candidates, behind = self._best(sampled, limit, settings.last, settings.sample)
            # a candidate of a very large map is known well enough by some hundred landmarks, and so is a hopeless one
            aligned = 0 if cost > settings.sorted else behind
            found = scene.assess(candidates.taken(np.arange(aligned, len(candidates))), (0.0,))
            if aligned:
                found = scene.assess(candidates.taken(np.arange(aligned)), (0.0, 0.0)).followed_by(found)
        else:
            found = scene.assess(candidates, (loose, loose / 3, 0.0))
        score = found.score + self._compass(found.candidates.T12s[:, 2])
        order = _best_first(score, found.candidates.T12s)
        order = order[found.count[order] > 0]
        kept = order[self._distinct(found.candidates.taken(order), self.config.tolerance_m, self.config.max_hypotheses)]
        partner, seed = scene.in_map_order(found, kept)
        return Assessed(found.candidates.taken(kept), score[kept], found.count[kept], partner, seed)

    def refined(self, candidates: Candidates) -> Assessed:
        """Candidates refined and scored, all of them, in their order."""
        loose = self.settings.looseness
        found = _Scene(self).assess(candidates, (loose, loose / 3, 0.0))
        return replace(found, score=found.score + self._compass(found.candidates.T12s[:, 2]))

    def _best(self, found: Assessed, limit: int, fewest: int, compared_by: int) -> tuple[Candidates, int]:
        """The distinct ones of the best candidates, ``limit`` at most, and how many of them aren't hopelessly behind.

        By their score, ``compared_by`` so many landmarks; others are only kept among the ``fewest`` first.
        """
        score = found.score + self._compass(found.candidates.T12s[:, 2])
        order = _best_first(score, found.candidates.T12s)
        ordered = found.candidates.taken(order)
        kept = self._distinct(ordered, self.config.tolerance_m / 2, limit)
        behind = score[order[0]] - score[order[kept]]
        near = int(np.searchsorted(behind, self.settings.behind * np.sqrt(compared_by), side="right"))
        return ordered.taken(kept[: max(near, fewest)]), near

    def _distinct(self, candidates: Candidates, tolerance_m: float, limit: int) -> Indices:
        # turns of a map of one landmark are distinct, too
        spread = max(self.two.spread, 4.0)
        kept: Indices = self.kernels.first_of_each(candidates.T12s, self.two.middle, spread, tolerance_m, limit)
        return kept

    def _compass(self, theta: Array) -> Array:
        """Log likelihood ratio [nats] of rotations by the compasses: mostly right, now and then bent by steel."""
        one, two = self.one, self.two
        if not self.config.use_compass or np.isnan(one.north) or np.isnan(two.north):
            return np.zeros(len(theta))
        sigma = np.hypot(one.north_sigma, two.north_sigma)
        off = se2.wrap(theta - (one.north - two.north))
        density = np.exp(-0.5 * (off / sigma) ** 2) * np.sqrt(2 * np.pi) / sigma
        return np.asarray(np.log(0.8 * density + 0.2))

    def hypotheses(self, map1: LandmarkMap, map2: LandmarkMap, found: Assessed) -> list[Hypothesis]:
        """As values."""
        ids1, ids2 = map1.ids, map2.ids
        columns = (found.candidates.T12s, found.score, found.count, found.seed)
        return [
            Hypothesis(
                Transform(*T12),
                count,
                Correspondences(ids1, ids2, partner, count),
                ((ids1[partner[j]], ids2[j]),),
                score,
            )
            for T12, score, count, j, partner in zip(*(c.tolist() for c in columns), found.partner, strict=True)
        ]


def rotation_modes(votes: Array, width: float, limit: int) -> list[float]:
    """Peaks [rad] of a histogram over the circle, strongest first, until nearly all votes are within ``width`` of one.

    >>> votes = np.zeros(360)
    >>> votes[[9, 10, 100]] = 50, 50, 20
    >>> np.rad2deg(rotation_modes(votes, np.deg2rad(5.0), 9)).round(1).tolist()
    [10.0, 100.5]
    """
    step = 2 * np.pi / len(votes)
    centres = turn_kernels().strongest_rotations(votes.astype(float), max(1, round(width / step)), limit)
    return [float(se2.wrap(centre * step)) for centre in centres.tolist()]


def _extent(xy: Array) -> tuple[float, float]:
    """Of points (n, 2) along both axes [m]; by columns, which numpy is quicker with."""
    x, y = xy[:, 0], xy[:, 1]
    return float(x.max() - x.min()), float(y.max() - y.min())


def _best_first(score: Array, T12s: Array) -> Indices:
    """Order by score, then by rotation and place, that equal ones have an order whatever the last bits say."""
    worst_last = -np.round(score, 9)
    order = np.argsort(worst_last, kind="stable")
    ordered = worst_last[order]
    if np.all(ordered[1:] > ordered[:-1]):
        return order
    return np.lexsort((*np.round(T12s.T, 6), worst_last))


@dataclass(frozen=True, eq=False)
class Part:
    """Some of map 2's landmarks, and some of the places where its robot was."""

    side: Any
    seen: Any


class _Scene:
    """Both maps as the kernels want them: what a match is worth, what a miss costs, and where the robots were."""

    def __init__(self, pair: Pair) -> None:
        one, two, settings = pair.one, pair.two, pair.settings
        self.pair = pair
        k = pair.kernels
        way1, way2 = one.travelled, two.travelled
        self.linear = way1.has_links and way2.has_links
        rate1, rate2 = one.rates[self.linear], two.rates[self.linear]
        # neighbours in space are neighbours in memory
        self.sorted = max(len(one), len(two)) > settings.sorted
        self.side1 = self._side(one, pair.label1, two)
        self.side2 = self._side(two, pair.label2, one)
        self.faced2 = self._seen_by(two, one), self.linear, self.sorted
        self.by_isolation2 = two.isolation_by_place if self.sorted else two.by_isolation
        void = _void(one, two, rate1, rate2, self.linear) * settings.against
        self.seen1, self.seen2 = (self._seen(way, void) for way in (way1, way2))
        least = one.largest_variance + two.largest_variance
        most = max(least, min(settings.most_sigma_m**2, 16 * least))
        self.rules = k.Rules(
            settings.gate,
            (one.bend + two.bend) * settings.grow,
            most,
            settings.arm,
            settings.contradiction,
            settings.least_gain,
            float(np.hypot(max(one.noise.heading_sigma, 1e-3), max(two.noise.heading_sigma, 1e-3))),
        )
        reach = settings.gate * float(np.sqrt(most))
        shared = pair.label1 is one.label
        self.cells, self.crowd = one.kept(
            # codes that the other map has a say in are another index
            ("cells", reach, self.sorted) if shared else None,
            lambda: _cells(k, self.side1.values, self.side1.label, reach),
        )

    @property
    def cost(self) -> float:
        """How many landmarks are looked at to assess one candidate once."""
        return len(self.pair.two) * max(1.0, min(self.crowd, 256.0) / 3) + len(self.pair.one) / 4

    def _side(self, own: LandmarkArrays, label: NDArray[np.int32], other: LandmarkArrays) -> Any:
        faced = own.facing(self._seen_by(own, other), self.linear, self.sorted)
        values = faced.values
        if not self.pair.settings.against:
            values = frozen(np.column_stack([values[:, :-1], np.zeros(len(own))]))
        if self.sorted:
            label = label[own.by_place]
        return self.pair.kernels.Side(values, faced.arms, frozen(label), faced.linear)

    @staticmethod
    def _seen_by(own: LandmarkArrays, other: LandmarkArrays) -> tuple[float, ...]:
        return tuple(other.noise.detection(name) for name in own.labels)

    def _seen(self, way: Travelled, void: float) -> Any:
        step = way.step if self.linear else 2 * way.step * way.width if way.has_links else way.step**2
        every = -(-len(way.samples) // self.pair.settings.ways) or 1
        samples = way.samples if every == 1 else frozen(way.samples[::every])
        x, y = way.low.tolist()
        return self.pair.kernels.Seen(x, y, 1 / way.size, way.cells, samples, 0.5 * void * step * every)

    def in_map_order(self, found: Assessed, kept: Indices) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """`Assessed.partner` and `Assessed.seed` of some of what was found in the scene's order: places in the maps."""
        if not self.sorted:
            return found.partner[kept], found.seed[kept]
        order1, order2 = self.pair.one.by_place, self.pair.two.by_place
        partner = self.pair.kernels.in_map_order(found.partner, kept, order1, order2)
        return partner, order2[found.seed[kept]].astype(np.int32)

    def part(self, size: int) -> Part:
        """``size`` of map 2's landmarks, evenly by how far each is from the next: wherever, in whatever order."""
        two, ways, share = self.pair.two, self.seen2.samples, min(1.0, size / len(self.pair.two))
        every = max(1, len(ways) // size)

        def make() -> tuple[tuple[NDArray[Any], ...], Array]:
            columns = tuple(self.side2)
            if len(two) > size:
                chosen = np.sort(self.by_isolation2[np.linspace(0, len(two) - 1, size).astype(np.intp)])
                columns = tuple(frozen(values[chosen]) for values in columns)
            return columns, frozen(ways[::every])

        # codes that the other map has a say in make another part, as the measuring of misses does
        own = self.pair.label2 is two.label and self.pair.settings.against
        columns, samples = two.kept(("part", size, len(ways), *self.faced2) if own else None, make)
        void = 2 * self.seen2.void * every * share
        return Part(self.pair.kernels.Side(*columns), self.seen2._replace(samples=samples, void=void))

    def assess(self, candidates: Candidates, looseness: tuple[float, ...], part: Part | None = None) -> Assessed:
        """Candidates matched and aligned in turns, the last of which scores; see the kernel.

        With a ``part`` of map 2 only what that lacks is charged, not what map 1 has more.
        """
        side2, seen2 = (self.side2, self.seen2) if part is None else (part.side, part.seen)

        if not self.pair.settings.refine:
            looseness = (0.0,)

        def run(few: Candidates) -> Any:
            return self.pair.kernels.assess(
                few.T12s, few.centres, np.array(looseness), part is None,
                self.side1, side2, self.cells, self.seen1, seen2, self.rules,
            )  # fmt: skip

        n_parts = min(self.pair.config.threads, len(candidates))
        jobs = [candidates]
        if n_parts > 1:
            jobs = [candidates.taken(c) for c in np.array_split(np.arange(len(candidates)), n_parts)]
        T12s, centres, score, count, partner, seed = (
            np.concatenate(column) if len(column) > 1 else column[0]
            for column in zip(*self.pair.each(run, jobs), strict=True)
        )
        return Assessed(Candidates(T12s, centres), score, count, partner, seed)


def _void(one: LandmarkArrays, two: LandmarkArrays, rate1: Array, rate2: Array, linear: bool) -> float:
    """What a metre of corridor (or a square metre) says [nats] on which both have been."""
    total = 0.0
    for k1, label in enumerate(one.labels):
        if label in two.labels:
            k2 = two.labels.index(label)
            armed = label in ("corner", "junction", DOOR)
            if armed or not linear:
                both = one.noise.detection(label) * two.noise.detection(label)
                total += float(np.sqrt(rate1[k1] * rate2[k2])) * both
    return total


def _cells(k: ModuleType, xy: Array, label: NDArray[np.int32], size: float) -> tuple[Any, float]:
    """Points in cells as large as the widest gate, four million of them at most, and how many an occupied one lists."""
    low, high = xy[:, :2].min(axis=0), xy[:, :2].max(axis=0)
    extent = high - low
    size = max(size, 1e-6, float(extent.max()) / 4000, float(np.sqrt(extent.prod() / 4_000_000)))
    low = low - 2 * size
    nx, ny = (int(e / size) + 5 for e in extent.tolist())
    layers = int(max(1, min(int(label.max()) + 1, 4_000_000 // (nx * ny))))
    start, members = k.sorted_into_cells(xy, label, 1 / size, nx, ny, layers, float(low[0]), float(low[1]))
    crowd = len(members) / max(1, int(np.count_nonzero(np.diff(start))))
    return k.Cells(float(low[0]), float(low[1]), 1 / size, nx, ny, layers, start, members), crowd
