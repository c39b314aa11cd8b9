"""What speaks for and against a hypothesis: its log odds against "these maps show different places".

Derivation and what each term buys: docs/evidence.md. The terms are kept apart so that a reason can be given.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from mapfuse.datasets import se2
from mapfuse.datasets.arms import Kind, signature
from mapfuse.datasets.maps import DOOR

from .background import Background, false_alarm, label
from .config import EvidenceConfig
from .coverage import END_MARGIN_M, Segments, overlap_length, passed
from .elastic import Joined
from .growth import PRIOR_SIGMA, Growth
from .prepared import PreparedMap
from .visits import visits

Array = NDArray[np.float64]

#: Ways a landmark of a kind can lie on a corridor; a match by chance hits one of them.
ORIENTATIONS = {Kind.CORNER: 4, Kind.T_JUNCTION: 4, Kind.END: 2, Kind.DOOR: 2, Kind.CORRIDOR: 1, Kind.CROSSING: 1}
#: Probability that a compass agrees by chance although its robot was misled by steel everywhere.
STEEL_RATE = 0.003
#: Shares of its landmarks that an imperfect alias may lack.
LACKING = (0.1, 0.3, 0.5, 0.7, 0.9)


@dataclass(frozen=True, slots=True)
class Terms:
    """The parts of a hypothesis' log odds [nats]; their sum is `total`.

    ``prior``: density of T12 before looking. ``matches``: corridor landmarks that coincide. ``points``: point landmarks
    that coincide. ``misses``: landmarks the other robot passed and didn't record. ``void``: emptiness both agree on.
    ``arms``: blocked arms that the other robot drove through, or that contradict. ``compass``: agreement of north.
    ``known``: landmarks that the maps themselves say are the same (``same_as``).
    """

    prior: float = 0.0
    matches: float = 0.0
    points: float = 0.0
    junctions: float = 0.0
    misses: float = 0.0
    void: float = 0.0
    arms: float = 0.0
    compass: float = 0.0
    known: float = 0.0

    @property
    def total(self) -> float:
        """Sum of all terms."""
        return float(sum(getattr(self, f.name) for f in fields(self)))


@dataclass(frozen=True, eq=False)
class Weighed:
    """A grown hypothesis with its evidence.

    ``contradiction`` [nats]: what alone may tell apart two hypotheses that a repeating building makes alike: misses,
    blocked arms and compass, as the odds of being the right place against being an alias of it. ``missed1``,
    ``missed2``: landmarks of map 1, map 2 that the other robot passed without recording them.
    """

    growth: Growth
    terms: Terms
    contradiction: float
    missed1: tuple[int, ...]
    missed2: tuple[int, ...]

    @property
    def log_odds(self) -> float:
        """Log odds against no overlap [nats], before the overlap prior."""
        return self.terms.total


def _normal_log(x: float, variance: float) -> float:
    return -0.5 * x * x / variance - 0.5 * float(np.log(2 * np.pi * variance))


def _detections(m1: PreparedMap, m2: PreparedMap, i: int, j: int) -> float:
    """log (1 - fa1)(1 - fa2): both recorded landmarks are there."""
    return float(np.log1p(-false_alarm(m1, i)) + np.log1p(-false_alarm(m2, j)))


def _corridor_matches(joined: Joined, background: Background) -> float:
    """Matched corridor landmarks [nats]: density of the residual along the corridor, given those before.

    The order and the corridors are those of either map; the mean of both, so that neither map is the first.
    """
    corridor = np.flatnonzero(~background.points1[joined.i] & ~background.points2[joined.j])
    if not len(corridor):
        return 0.0
    on = _subset(joined, corridor)
    order1, along1 = visits(on.m1, on.i)
    order2, along2 = visits(on.m2, on.j)
    turned2 = along2 @ se2.rotation(joined.T12[2]).T
    return (
        _sequence(_subset(on, order1), along1, background) + _sequence(_subset(on, order2), turned2, background)
    ) / 2


def _sequence(joined: Joined, directions: Array, background: Background) -> float:
    """Log odds [nats] of matches in the order given, each along its direction (k, 2) in frame 1."""
    m1, m2 = joined.m1, joined.m2
    innovation, V = joined.sequential()
    total = 0.0
    for k, (i, j) in enumerate(zip(joined.i.tolist(), joined.j.tolist(), strict=True)):
        met = joined.arms.coincide[i, j] >= 2
        ways = ORIENTATIONS.get(signature(m1.map.landmarks[i]).kind, 1) if met else 1
        odds = _detections(m1, m2, i, j) + np.log(ways) - np.log(background.rate[label(m1, i)])
        if k:  # the first one is what places map 2: its density is the prior of T12
            u = directions[k]
            if np.isnan(u).any():
                u = np.linalg.eigh(V[k][:2, :2])[1][:, 1]
            odds += _normal_log(float(u @ innovation[k][:2]), float(u @ V[k][:2, :2] @ u))
        total += float(odds)
    return total


def _subset(joined: Joined, which: NDArray[np.intp]) -> Joined:
    return Joined(joined.m1, joined.m2, joined.T0, joined.arms, joined.i[which], joined.j[which], joined.prior_sigma)


def _point_matches(joined: Joined, background: Background) -> float:
    """Matched point landmarks: density of the residual in the plane, given the corridor landmarks and those before."""
    m1, m2 = joined.m1, joined.m2
    is_point = background.points1[joined.i] & background.points2[joined.j]
    if not is_point.any():
        return 0.0
    order = np.concatenate([np.flatnonzero(~is_point), np.flatnonzero(is_point)])
    sub = _subset(joined, order)
    innovation, V = sub.sequential()
    total = 0.0
    for k in range(int((~is_point).sum()), len(order)):
        i, j = int(sub.i[k]), int(sub.j[k])
        C = V[k][:2, :2]
        d2 = float(innovation[k][:2] @ np.linalg.solve(C, innovation[k][:2]))
        density = -0.5 * d2 - 0.5 * float(np.log(np.linalg.det(C))) - np.log(2 * np.pi)
        total += density + _detections(m1, m2, i, j) - float(np.log(background.area_rate[label(m1, i)]))
    return total


def _point_prior(background: Background) -> float:
    """Density of T12 before looking [nats], where only points place map 2.

    Uniform over the turns and over the shifts that let the two seen areas touch, in place of the wide normal prior
    under which the residuals were weighed.
    """
    extent = sum(float(np.sqrt(max(area.area(), 1.0) / np.pi)) for area in (background.area1, background.area2))
    wide = float(np.log(2 * np.pi) * 1.5 + np.log(PRIOR_SIGMA).sum())
    return wide - float(np.log(np.pi * extent**2 * 2 * np.pi))


def _detected(m: PreparedMap, type_: str) -> float:
    return m.map.noise.detection(type_)


@dataclass(frozen=True, eq=False)
class Passing:
    """Who passed what: places of unmatched landmarks that the other robot passed, and blocked arms driven through.

    ``corridor_overlap`` [m]: corridor that both travelled; ``void_overlap`` [m]: the part of it where a landmark would
    count as passed, which is not at the ends of links; ``area_overlap`` [m^2]: where both would have seen points.
    """

    missed1: NDArray[np.intp]
    missed2: NDArray[np.intp]
    blocked: int
    corridor_overlap: float
    void_overlap: float
    area_overlap: float


def _through_blocked(
    m: PreparedMap, positions: Array, turn: float, by: NDArray[np.bool_], segments: Segments, angle: float
) -> int:
    """How many blocked arms of passed landmarks point along the other robot's way."""
    count = 0
    ways = np.arctan2(segments.direction[:, 1], segments.direction[:, 0]) if len(segments) else np.zeros(0)
    for k, s in zip(*np.nonzero(by), strict=True):
        blocked = m.arm_headings[k][~m.arm_passable[k] & ~np.isnan(m.arm_headings[k])] + turn
        for way in (ways[s], ways[s] + np.pi):
            count += int((np.abs(se2.wrap(blocked - way)) < angle).any())
    return count


def passing(growth: Growth, background: Background, config: EvidenceConfig) -> Passing:
    """What each robot passed of the other's map, both maps bent onto each other."""
    joined = growth.joined
    p1, p2 = joined.corrected()
    return passing_at(joined.T12, (p1, p2), (joined.i, joined.j), background, config)


def passing_at(
    T12: Array,
    placed: tuple[Array, Array],
    matched: tuple[NDArray[np.intp], NDArray[np.intp]],
    background: Background,
    config: EvidenceConfig,
) -> Passing:
    """What each robot passed of the other's map, map 2 lying at ``T12`` (3,).

    ``placed``: where the landmarks of both maps then are, (n1, 2) and (n2, 2) in frame 1; ``matched``: places of those
    that are the same.
    """
    m1, m2 = background.m1, background.m2
    p1, p2 = placed
    angle = np.deg2rad(config.corridor_angle_deg)
    s1, s2 = Segments.of(m1, p1), Segments.of(m2, p2)
    by1, by2 = passed(p2, s1, config.corridor_width_m), passed(p1, s2, config.corridor_width_m)
    blocked = _through_blocked(m2, p2, float(T12[2]), by1, s1, angle)
    blocked += _through_blocked(m1, p1, 0.0, by2, s2, angle)
    free1, free2 = np.ones(len(m1), dtype=bool), np.ones(len(m2), dtype=bool)
    free1[matched[0]], free2[matched[1]] = False, False
    # where both have a landmark of another kind the place was recorded, only differently
    in1 = background.area1.contains(p2) & background.points2
    in2 = background.area2.moved(T12).contains(p1) & background.points1
    missed1 = np.flatnonzero(free1 & ((by2.any(axis=1) & ~background.points1) | in2))
    missed2 = np.flatnonzero(free2 & ((by1.any(axis=1) & ~background.points2) | in1))
    overlap = overlap_length(s1, s2, config.corridor_width_m, angle)
    between_ends = overlap_length(s1, s2, config.corridor_width_m, angle, END_MARGIN_M)
    area = background.area1.area(background.area2.moved(T12)) if background.area_rate else 0.0
    return Passing(missed1, missed2, blocked, overlap, between_ends, area)


def emptiness(way: Passing, background: Background, config: EvidenceConfig) -> tuple[float, float, float]:
    """Misses, void and arms [nats]: what is said by what two robots did not see of each other's maps (`Terms`)."""
    m1, m2 = background.m1, background.m2
    void = sum(
        rate * _detected(m1, name) * _detected(m2, name) * extent
        for rates, extent in ((background.rate, way.void_overlap), (background.area_rate, way.area_overlap))
        for name, rate in rates.items()
    )
    misses = sum(_miss(m1, k, m2) for k in way.missed1) + sum(_miss(m2, k, m1) for k in way.missed2)
    return float(misses), float(void), _per_arm(config) * way.blocked


def _per_arm(config: EvidenceConfig) -> float:
    """What an arm that contradicts takes off [nats]."""
    return float(np.log(config.arm_error_rate / 0.5))


def _miss(m: PreparedMap, k: int, other: PreparedMap) -> float:
    """log probability that the other robot passed this recorded landmark and did not record it."""
    return float(np.log1p(-_recorded_rate(m, k, other)))


def _compass(m1: PreparedMap, m2: PreparedMap, theta: float) -> float:
    """log density of the rotation given both compasses, against any rotation."""
    if m1.north is None or m2.north is None:
        return 0.0
    off = float(se2.wrap(theta - (m1.north[0] - m2.north[0])))
    density = np.exp(_normal_log(off, m1.north[1] ** 2 + m2.north[1] ** 2))
    return float(np.log((1 - STEEL_RATE) * density + STEEL_RATE / (2 * np.pi)) + np.log(2 * np.pi))


def _alias(hits: Array, misses: Array) -> float:
    """log P(what was seen | an alias of the right place) - log P(... | the right place) [nats].

    ``hits``, ``misses``: probability q that a landmark there is recorded, for those that were and those that weren't.
    A repeating building has at the alias all the landmarks (half of the prior), or lacks a share of them (the other
    half, `LACKING`). An excellent agreement therefore never counts for more than log 2 against an alias: only what is
    missing tells.
    """
    if not len(hits) and not len(misses):
        return 0.0
    there = 1 - np.array(LACKING)
    odds = len(hits) * np.log(there) + np.log1p(-misses[:, None] * there).sum(axis=0) - np.log1p(-misses).sum()
    return float(np.logaddexp(0.0, logsumexp(odds) - np.log(len(there))) - np.log(2))


def _recorded_rate(m: PreparedMap, k: int, other: PreparedMap) -> float:
    """Probability that the other robot, passing, records a landmark that stands in this map."""
    q = (1 - false_alarm(m, k)) * _detected(other, m.map.types[k])
    return min(max(q, 1e-6), 1 - 1e-6)


def weigh(growth: Growth, background: Background, config: EvidenceConfig) -> Weighed:
    """The evidence of a grown hypothesis."""
    joined = growth.joined
    m1, m2 = joined.m1, joined.m2
    way = passing(growth, background, config)
    corridor = ~background.points1[joined.i]
    prior = -config.look_elsewhere
    if corridor.any():
        # a random stretch of corridor 1 lies on a random stretch of corridor 2, in one of two directions
        overlap = max(way.corridor_overlap, 1.0)
        prior += float(np.log(overlap / (2 * max(m1.corridor_length, 1.0) * max(m2.corridor_length, 1.0))))
    elif len(joined.i):
        prior += _point_prior(background)
    spatial = sum(m1.map.types[i] != DOOR for i in joined.i[corridor])
    misses, void, arms = emptiness(way, background, config)
    arms += _per_arm(config) * int(joined.arms.contradict[joined.i, joined.j].sum())
    compass = _compass(m1, m2, float(joined.T12[2]))
    terms = Terms(
        prior=prior,
        matches=_corridor_matches(joined, background),
        points=_point_matches(joined, background),
        junctions=-config.junction_discount * max(0, spatial - 1),
        misses=misses,
        void=void,
        arms=arms,
        compass=compass,
    )
    sides = [(m1, k, m2) for k in way.missed1] + [(m2, k, m1) for k in way.missed2]
    misses_q = np.array([_recorded_rate(*side) for side in sides])
    hits_q = np.array([_recorded_rate(m1, i, m2) for i in joined.i] + [_recorded_rate(m2, j, m1) for j in joined.j])
    alias = _alias(hits_q, misses_q)
    return Weighed(
        growth,
        terms,
        -alias + arms + compass,
        tuple(way.missed1.tolist()),
        tuple(way.missed2.tolist()),
    )
