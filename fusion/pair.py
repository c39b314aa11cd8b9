"""Two maps to one answer; the story of the whole library on a page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.transform import Transform
from mapfuse.factors import pair_problem
from mapfuse.matching.hypothesis import Hypothesis
from mapfuse.matching.modes import displacement
from mapfuse.matching.propose import propose

from .background import Background
from .config import FuseConfig, SolvingConfig
from .decide import Verdict, decide
from .elastic import Joined
from .evidence import Weighed, weigh, weigh_all
from .growth import Growth, Pairs, compatible, grow_distinct
from .known import agreeing, check_known, credited, grow_known, known_pairs
from .prepared import PreparedMap
from .repetition import LACKING, alias, repeats
from .solve import Solution, solve
from .wallfit import weighed_by_conflicts, weighed_by_walls

Array = NDArray[np.float64]


#: A hypothesis less probable than this gets no graph of its own.
NEGLIGIBLE = 1e-4
#: A proposal whose score is so far [nats] below the best one's isn't grown,
HOPELESS = 30.0
#: unless it speaks for itself by more than this [nats]: however far behind, an image of the best is its rival in a
#: building that repeats. Of 240 tuning pairs, 12 of each class of `benchmarks/calibration_pairs.py`, no answer of its
#: own below both came above -1.9 nats.
SPEAKS = 5.0
#: How often the best hypotheses get graphs where walls speak; further ones are held against the walls without one.
WALL_ROUNDS = 5
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


def grow_all(
    m1: PreparedMap, m2: PreparedMap, hypotheses: list[Hypothesis], config: SolvingConfig, known: Pairs = ()
) -> list[Growth]:
    """Every distinct hypothesis grown (`mapfuse.fusion.growth.grow_distinct`).

    From the pairs that proposed it or, where these have no heading, from all that match under it. Where landmarks are
    ``known`` to be the same, they propose too.
    """
    seeds, matches = (np.full((len(hypotheses), len(m1)), -1, dtype=np.intp) for _ in range(2))
    place1, place2 = m1.map.index_from_id, m2.map.index_from_id
    headed1, headed2 = m1.headed.tolist(), m2.headed.tolist()
    for seed, all_matches, hypothesis in zip(seeds, matches, hypotheses, strict=True):
        for a, b in hypothesis.correspondences:
            all_matches[place1[a]] = place2[b]
        pairs = [(place1[a], place2[b]) for a, b in hypothesis.seed]
        if hypothesis.correspondences and not all(headed1[i] and headed2[j] for i, j in pairs):
            seed[:] = all_matches
        else:
            for i, j in pairs:
                seed[i] = j
    T12s = np.array([h.T12.array for h in hypotheses]).reshape(-1, 3)
    count = np.array([h.count for h in hypotheses], dtype=np.intp)
    grown = grow_distinct(m1, m2, T12s, count, seeds, matches, config, compatible(m1, m2, known))
    by_known = grow_known(m1, m2, known, config)
    grown = [by_known, *grown] if by_known is not None else grown
    return [g for g in grown if g.places_map2]


def _worth_growing(
    hypotheses: list[Hypothesis], m1: PreparedMap, m2: PreparedMap, config: FuseConfig
) -> list[Hypothesis]:
    """Those not far behind the best one, or likely by themselves; all, where scores are counts or of bent points."""
    if config.matching.mode == "paper" or not (m1.headed.any() and m2.headed.any()):
        return hypotheses
    best = max((h.score for h in hypotheses), default=0.0)
    return [h for h in hypotheses if h.score > min(best - HOPELESS, SPEAKS)]


def distinct(weighed: list[Weighed], tolerance_m: float) -> list[Weighed]:
    """The best variant of each answer.

    Two are variants of one where half of the smaller one's matches are the other's too, or where both lay map 2 on the
    same place: twins that stand close together may be matched either way.
    """
    ordered = sorted(weighed, key=lambda w: -w.log_odds)
    if len(ordered) < 2:
        return ordered
    growths = [w.growth for w in ordered]
    joined = growths[0].joined
    count = np.array([len(g.i) for g in growths])
    i, j = (np.concatenate(places) for places in zip(*((g.i, g.j) for g in growths), strict=True))
    of, match = np.repeat(np.arange(len(growths)), count), np.unique(i * len(joined.m2) + j, return_inverse=True)[1]
    has = np.zeros((len(growths), int(match.max()) + 1))
    has[of, match] = 1.0
    same = 2 * (has @ has.T) >= np.minimum(count[:, None], count)
    # the root mean square over n landmarks is no less than the distance of any one of them by the root of n
    placed = se2.transform(np.array([g.joined.T12 for g in growths])[:, None], joined.m2.positions)
    first = np.array([g.j[0] for g in growths])
    off = placed[np.arange(len(first)), first][:, None] - placed[:, first].swapaxes(0, 1)
    near = (off**2).sum(axis=2) <= (count[:, None] + count) * tolerance_m**2
    matched = np.zeros((len(growths), len(joined.m2)), dtype=bool)
    matched[of, j] = True
    related = np.tril(same | near, -1).any(axis=1)
    kept = ~related
    for k in np.flatnonzero(related).tolist():
        if (same[k, :k] & kept[:k]).any():
            continue
        # on one place, by the landmarks that either matches
        kept[k] = all(
            displacement(
                growths[k].joined.T12, growths[other].joined.T12, joined.m2.positions[matched[k] | matched[other]]
            )
            >= tolerance_m
            for other in np.flatnonzero(near[k, :k] & kept[:k]).tolist()
        )
    return [w for w, keep in zip(ordered, kept.tolist(), strict=True) if keep]


def _solved(w: Weighed, background: Background, config: FuseConfig) -> tuple[Weighed, Solution]:
    """The hypothesis' graph solved; weighed again where the gate took out a match."""
    joined = w.growth.joined
    m1, m2 = joined.m1, joined.m2
    matches = [(m1.map.ids[i], m2.map.ids[j]) for i, j in zip(joined.i, joined.j, strict=True)]
    problem = pair_problem(m1.map, m2.map, joined.T12, matches, starts=(m1.poses, m2.poses))
    solution = solve(problem, config.solving, max(m1.noise_scale, m2.noise_scale))
    if solution.rejected:
        gone = {tuple(key.id for key in match.pair) for match in solution.rejected}
        keep = np.array([match not in gone for match in matches], dtype=bool)
        if keep.any():
            growth = Growth(Joined(m1, m2, joined.T12, joined.i[keep], joined.j[keep]), w.growth.rounds)
            w = weigh(growth, background, config.evidence)
    return weighed_by_walls(w, solution, config.walls) if config.walls.use else (w, solution)


def judged(weighed: list[Weighed], background: Background, config: FuseConfig, self_match: bool = True) -> Verdict:
    """The verdict; rivals of the best hypothesis that may be its images are looked for in the maps themselves.

    ``self_match``: whether they are; without it, to measure what that is worth, only the rivals themselves speak.
    """
    if not weighed:
        return decide(weighed, np.zeros((0, 2)), config.evidence, config.decision)
    odds = [w.log_odds for w in weighed]
    best = weighed[odds.index(max(odds))]
    of_building = np.zeros((len(weighed), len(LACKING)))
    for k, w in enumerate(weighed):
        if self_match and w is not best and odds[k] > LEAST_RIVAL:
            of_building[k] = repeats(background, config, best.growth.joined.T12, w.growth.joined.T12)
    own = alias(np.array([w.lacking for w in weighed]), of_building) - [w.apart for w in weighed]
    at_best = alias(best.lacking, of_building) - best.apart
    return decide(weighed, np.column_stack([at_best, own]), config.evidence, config.decision)


def _against_walls(verdict: Verdict, asked: set[int], background: Background, config: FuseConfig) -> Verdict:
    """The verdict once walls have spoken on every hypothesis that is not negligible; ``asked``: ids of those they have.

    What walls take from the best ones would else go to many that they would speak against as well.
    """
    while True:
        answers = list(verdict.ranked)
        open_ = [
            k
            for k, (w, probability) in enumerate(zip(answers, verdict.probabilities, strict=False))
            if probability >= NEGLIGIBLE and id(w) not in asked
        ]
        if not open_:
            return verdict
        for k in open_:
            answers[k] = weighed_by_conflicts(answers[k], config.walls)
            asked.add(id(answers[k]))
        verdict = judged(answers, background, config)


def fuse_pair(m1: PreparedMap, m2: PreparedMap, config: FuseConfig, stated: Transform | None = None) -> PairOutcome:
    """Propose, grow, weigh, solve, decide; ``stated``: what the user knows of T12, with its covariance."""

    def told(w: Weighed) -> Weighed:
        return agreeing(credited(w, known), m1, m2, stated)

    background = Background(m1, m2)
    hypotheses = _worth_growing(propose(m1.straightened, m2.straightened, config.matching), m1, m2, config)
    known = known_pairs(m1.map, m2.map)
    grown = grow_all(m1, m2, hypotheses, config.solving, known)
    weighed = [told(w) for w in weigh_all(grown, background, config.evidence)]
    weighed = distinct(weighed, config.matching.tolerance_m)
    verdict = judged(weighed, background, config)
    answers = list(verdict.ranked)
    solutions: dict[int, Solution] = {}
    # walls may turn against the best ones, so that others come to the fore that no graph was solved of
    for _ in range(WALL_ROUNDS if config.walls.use else 1):
        shortlist = zip(verdict.ranked[: config.solving.shortlist], verdict.probabilities, strict=False)
        # what cannot be the answer keeps the elastic match's T12
        chosen = {id(w) for w, probability in shortlist if probability >= NEGLIGIBLE} - solutions.keys()
        if not chosen and solutions:
            break
        for k, w in enumerate(answers):
            if id(w) in chosen:
                after, solution = _solved(w, background, config)
                answers[k] = told(after)
                solutions[id(answers[k])] = solution
        verdict = judged(answers, background, config)
    if config.walls.use:
        verdict = _against_walls(verdict, set(solutions), background, config)
    check_known(verdict.ranked, m1, m2, known)
    best = verdict.ranked[0] if verdict.decision == "merged" else None
    if best is not None and id(best) not in solutions:  # weighed again, one beyond the shortlist may come out first
        solutions[id(best)] = _solved(best, background, config)[1]
    by_rank = {k: solutions[id(w)] for k, w in enumerate(verdict.ranked) if id(w) in solutions}
    return PairOutcome(m1, m2, background, verdict, by_rank)
