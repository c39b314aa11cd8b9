"""Two maps to one answer; the story of the whole library on a page."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.arms import heading_of
from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.factors import pair_problem
from mapfuse.matching.hypothesis import Hypothesis
from mapfuse.matching.modes import displacement
from mapfuse.matching.propose import propose

from .background import Background
from .config import FuseConfig, SolvingConfig
from .decide import Verdict, decide
from .elastic import Joined
from .evidence import Weighed, weigh
from .growth import Growth, Pairs, compatible, grow
from .known import check_known, credited, grow_known, known_pairs
from .prepared import PreparedMap
from .repetition import repeats
from .solve import Solution, solve

Array = NDArray[np.float64]


#: A hypothesis less probable than this gets no graph of its own.
NEGLIGIBLE = 1e-4
#: Log odds against no overlap [nats] below which a rival is no image of another placement.
LEAST_RIVAL = -5.0


@dataclass(frozen=True, eq=False)
class PairOutcome:
    """What is known of two maps: the verdict over all hypotheses, and the solved graphs of the best (by rank)."""

    m1: PreparedMap
    m2: PreparedMap
    background: Background
    verdict: Verdict
    solutions: dict[int, Solution]


def straightened(m: PreparedMap) -> LandmarkMap:
    """The recorded map with positions and arm headings at its own optimum, for the matcher."""
    landmarks = []
    for landmark, (x, y), heading in zip(m.map.landmarks, m.positions, m.headings, strict=True):
        turn = 0.0 if np.isnan(heading) else float(heading) - (heading_of(landmark) or 0.0)
        landmarks.append(_turned(replace(landmark, x=float(x), y=float(y)), turn))
    return m.map.replace(landmarks=tuple(landmarks))


def _turned(landmark: Landmark, turn: float) -> Landmark:
    links = tuple(
        link if link.heading is None else replace(link, heading=float(se2.wrap(link.heading + turn)))
        for link in landmark.links
    )
    heading = None if landmark.heading is None else float(se2.wrap(landmark.heading + turn))
    return replace(landmark, links=links, heading=heading)


def grow_all(
    m1: PreparedMap, m2: PreparedMap, hypotheses: list[Hypothesis], config: SolvingConfig, known: Pairs = ()
) -> list[Growth]:
    """Every distinct hypothesis grown; those whose seed an earlier one explains are the same answer.

    Where landmarks are ``known`` to be the same, they propose too.
    """
    may = compatible(m1, m2, known)
    grown: list[Growth] = []
    explained: list[tuple[frozenset[tuple[int, int]], float]] = []
    for hypothesis in hypotheses:
        seed = _seed(m1, m2, hypothesis)
        theta = hypothesis.T12.theta
        if any(set(seed) <= pairs and abs(se2.wrap(theta - turn)) < 0.5 for pairs, turn in explained):
            continue
        growth = grow(m1, m2, hypothesis.T12.array, seed, config, may)
        explained.append((growth.pairs | set(seed), float(growth.joined.T12[2])))
        grown.append(growth)
    by_known = grow_known(m1, m2, known, config)
    grown = [by_known, *grown] if by_known is not None else grown
    return [g for g in grown if g.places_map2]


def _seed(m1: PreparedMap, m2: PreparedMap, hypothesis: Hypothesis) -> tuple[tuple[int, int], ...]:
    """The pairs to grow from: what proposed the hypothesis, or, where that has no heading, all that match under it."""
    seed = tuple((m1.map.index_from_id[a], m2.map.index_from_id[b]) for a, b in hypothesis.seed)
    if all(m1.headed[i] and m2.headed[j] for i, j in seed):
        return seed
    return tuple((m1.map.index_from_id[a], m2.map.index_from_id[b]) for a, b in hypothesis.correspondences) or seed


def _one_answer(a: Growth, b: Growth, tolerance_m: float) -> bool:
    """Whether two grown hypotheses are variants of one answer.

    So they are where half of the smaller one's matches are the other's too, or where both lay map 2 on the same
    place: twins that stand close together may be matched either way.
    """
    if 2 * len(a.pairs & b.pairs) >= min(len(a.pairs), len(b.pairs)):
        return True
    # the root mean square over n landmarks is no less than the distance of any one of them by the root of n
    x, y = (a.placed2[a.j[0]] - b.placed2[a.j[0]]).tolist()
    if x * x + y * y > (len(a.j) + len(b.j)) * tolerance_m**2:
        return False
    overlap = a.joined.m2.positions[np.union1d(a.j, b.j)]
    return bool(displacement(a.joined.T12, b.joined.T12, overlap) < tolerance_m)


def _distinct(weighed: list[Weighed], tolerance_m: float) -> list[Weighed]:
    """The best variant of each answer."""
    kept: list[Weighed] = []
    for w in sorted(weighed, key=lambda w: -w.log_odds):
        if not any(_one_answer(w.growth, other.growth, tolerance_m) for other in kept):
            kept.append(w)
    return kept


def _solved(w: Weighed, background: Background, config: FuseConfig) -> tuple[Weighed, Solution]:
    """The hypothesis' graph solved; weighed again where the gate took out a match."""
    joined = w.growth.joined
    m1, m2 = joined.m1, joined.m2
    matches = [(m1.map.ids[i], m2.map.ids[j]) for i, j in zip(joined.i, joined.j, strict=True)]
    starts = tuple(np.column_stack([m.positions, np.nan_to_num(m.headings)]) for m in (m1, m2))
    solution = solve(pair_problem(m1.map, m2.map, joined.T12, matches, starts=(starts[0], starts[1])), config.solving)
    if solution.rejected:
        gone = {tuple(key.id for key in match.pair) for match in solution.rejected}
        keep = np.array([match not in gone for match in matches], dtype=bool)
        if keep.any():
            growth = Growth(Joined(m1, m2, joined.T12, joined.i[keep], joined.j[keep]), w.growth.rounds)
            w = weigh(growth, background, config.evidence)
    return w, solution


def _decided(weighed: list[Weighed], background: Background, config: FuseConfig) -> Verdict:
    """The verdict; rivals of the best hypothesis that may be its images are looked for in the maps themselves."""
    best = max(weighed, key=lambda w: w.log_odds, default=None)
    alias = np.zeros((len(weighed), 2))
    for k, w in enumerate(weighed):
        assert best is not None
        of_building = None
        if w is not best and w.log_odds > LEAST_RIVAL:
            of_building = repeats(background, config.evidence, best.growth.joined.T12, w.growth.joined.T12)
        alias[k] = best.alias(of_building), w.alias(of_building)
    return decide(weighed, alias, config.evidence, config.decision)


def fuse_pair(m1: PreparedMap, m2: PreparedMap, config: FuseConfig) -> PairOutcome:
    """Propose, grow, weigh, solve, decide."""
    background = Background(m1, m2)
    hypotheses = propose(straightened(m1), straightened(m2), config.matching)
    known = known_pairs(m1.map, m2.map)
    grown = grow_all(m1, m2, hypotheses, config.solving, known)
    weighed = [credited(weigh(g, background, config.evidence), known) for g in grown]
    weighed = _distinct(weighed, config.matching.tolerance_m)
    verdict = _decided(weighed, background, config)
    solved: dict[int, tuple[Weighed, Solution]] = {}
    for w, probability in zip(verdict.ranked[: config.solving.shortlist], verdict.probabilities, strict=False):
        if probability >= NEGLIGIBLE:  # what cannot be the answer keeps the elastic match's T12
            solved[id(w)] = _solved(w, background, config)
    first = verdict.ranked
    again = [credited(solved[id(w)][0], known) if id(w) in solved else w for w in first]
    verdict = _decided(again, background, config)
    check_known(verdict.ranked, m1, m2, known)
    solutions = {
        id(after): solved[id(before)][1] for before, after in zip(first, again, strict=True) if id(before) in solved
    }
    best = verdict.ranked[0] if verdict.decision == "merged" else None
    if best is not None and id(best) not in solutions:  # weighed again, one beyond the shortlist may come out first
        solutions[id(best)] = _solved(best, background, config)[1]
    by_rank = {k: solutions[id(w)] for k, w in enumerate(verdict.ranked) if id(w) in solutions}
    return PairOutcome(m1, m2, background, verdict, by_rank)
