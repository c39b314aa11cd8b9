"""Hypotheses of T12 from landmarks with headings, by votes in SE(2); fast for any number of landmarks.

1. *Turns*: two landmarks of one label propose the rotations that lay arms on arms. A histogram of all of them over the
   circle has peaks, the *rotation modes*: four in a right-angled building, others in others.
2. *Votes*: for each mode every pair that proposes it votes for its translation, in a grid of counters. In large maps
   some hundreds of map 2's landmarks do. Small maps need no vote: each pair is a candidate.
3. *Refinement*: the strongest peaks are matched one to one, aligned, and matched again.
4. *Score*: log likelihood ratio against "these maps show different places": what matches, what doesn't although the
   other robot passed it, and the emptiness that both agree on; less what the building's repetition wins everywhere
   (docs/matching.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.compiled import kernels
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform

from .config import MatchingConfig
from .hypothesis import Correspondences, Hypothesis
from .landmark_arrays import LandmarkArrays, landmark_arrays, shared_labels
from .scene import Assessed, Candidates, Scene
from .settings import SETTINGS, Settings

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


#: Hypotheses behind the first that say how much the building repeats, and what [nats] the best of many wins by luck.
RIVALS, LUCK = 5, 6.0


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
    proposed = pair.proposals()
    repetition = pair.ranked(proposed).repetition if len(proposed) else 0.0
    found = pair.refined(Candidates(T12.array[None], pair.two.xy.mean(axis=0)[None]))
    count = int(found.count[0])
    return Transform(*found.candidates.T12s[0].tolist()), float(found.score[0]) - repetition * count, count


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
        settings, scene = self.settings, Scene(self)
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
        kept = order[self._distinct(found.candidates.taken(order), self.config.tolerance_m, len(order))]
        repetition = repetition_of(score[kept], found.count[kept]) if settings.repeats else 0.0
        score = score - repetition * found.count
        kept = kept[_best_first(score[kept], found.candidates.T12s[kept])][: self.config.max_hypotheses]
        partner, seed = scene.in_map_order(found, kept)
        return Assessed(found.candidates.taken(kept), score[kept], found.count[kept], partner, seed, repetition)

    def refined(self, candidates: Candidates) -> Assessed:
        """Candidates refined and scored, all of them, in their order."""
        loose = self.settings.looseness
        found = Scene(self).assess(candidates, (loose, loose / 3, 0.0))
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


def repetition_of(score: Array, count: NDArray[np.int32]) -> float:
    """What each match [nats] is worth less where a building repeats.

    Of distinct hypotheses, best first: ``score`` (k,) [nats], ``count`` (k,) of matches.

    The score takes it for chance where landmarks stand. In a building that repeats, a wrong hypothesis meets many on
    its lattice, and the more the larger its overlap. What those behind the first win with each match, beyond what the
    best of many win by luck, isn't evidence for a place but for the building.

    >>> repetition_of(np.array([60.0, 46.0, 45.0, 44.0]), np.array([20, 40, 39, 38]))
    1.0
    >>> repetition_of(np.array([60.0, 5.0, 4.0]), np.array([20, 4, 3]))
    0.0
    """
    rivals = slice(1, 1 + RIVALS)
    if len(score) < 2:
        return 0.0
    return max(0.0, float(np.median((score[rivals] - LUCK) / count[rivals])))


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
