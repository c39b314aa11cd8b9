"""Hypotheses of T12 from landmarks without heading: pairs of pairs that have equal labels and equal distances.

One landmark of each map leaves the rotation open; two of each fix it. So every two neighbours (i, i') of map 1 and
(j, j') of map 2 with equal labels and, within tolerance, equal distance vote for "i is j, and map 2 is turned by the
difference of their directions". Votes are counted per (i, j, rotation): the position is anchored at i and j, where it
is exact, so that neither the distance to an origin nor a bend of the maps far away blurs the peak. The strongest peaks
are refined, all at once, by assignment and weighted closed-form alignment, and ranked by a log likelihood ratio.
Each vote is a proper rotation: a mirrored map is never proposed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mapfuse.datasets import se2
from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform

from .assignment import PointGrid, label_codes, one_to_one
from .candidates import through
from .config import MatchingConfig
from .hypothesis import Hypothesis
from .modes import distinct

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_BINS = 72
_ACCUMULATOR_CELLS = 8_000_000
_DENSITY_NEIGHBOURS = 6
_REACH_NEIGHBOURS = 3
_LEAST_SIGMA = 0.035
_NOISE_PRIOR = 3.0
# Rotation [rad] by which a peak may be off before it is refined.
_COARSE_ROTATION = 0.06
_MOST_GROWTH = 4.0
# Probability that a place was looked at which is as near to a landmark as other landmarks are.
_COVERAGE = 0.5
_ASKED_NEIGHBOURS = 12
_FEWEST_ANCHORS = 16


@dataclass(frozen=True, slots=True)
class PointPairConfig:
    """How landmarks without heading propose.

    ``distance_sigmas``: two distances are equal when they differ by at most that many standard deviations.
    ``near``, ``far``: each landmark is paired with its so many nearest ones; both are tried. ``votes``: cast at most,
    those of the shortest pairs first. ``seeds``: peaks of each that are refined around their anchor; ``refined``:
    distinct ones of them that are refined everywhere. ``gate_sigmas``: landmarks match within that many standard
    deviations.
    """

    distance_sigmas: float = 2.0
    near: int = 10
    far: int = 60
    votes: int = 1_000_000
    seeds: int = 160
    refined: int = 96
    gate_sigmas: float = 3.0

    def __post_init__(self) -> None:
        for name in ("distance_sigmas", "near", "far", "votes", "seeds", "refined", "gate_sigmas"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"matching.point_pairs.{name} is {getattr(self, name)!r}; it must be greater than 0")


@dataclass(frozen=True, slots=True)
class _Points:
    """What the search needs of one map's landmarks, (n, ...): positions [m], label codes, variance per axis [m^2].

    ``density`` [1 / m^2]: of recorded landmarks of that label around each; ``reach`` [m]: how far around each the
    robot has looked, as far as one can tell from its neighbours; ``recorded``: probability that a true one is in it
    and that it is true, ``detection_rate (1 - false_alarm_rate)``.
    """

    xy: Array
    label: Indices
    variance: Array
    density: Array
    reach: Array
    recorded: Array

    def grid(self, other: _Points, gate_sigmas: float) -> PointGrid:
        """These points in cells as large as the widest gate to those of the other map."""
        widest = _MOST_GROWTH * (self.variance.max() + other.variance.max())
        return PointGrid(self.xy, gate_sigmas * float(np.sqrt(widest)))


def match_point_pairs(
    map1: LandmarkMap,
    map2: LandmarkMap,
    config: MatchingConfig | None = None,
    settings: PointPairConfig | None = None,
) -> list[Hypothesis]:
    """Distinct hypotheses of T12 from the positions and types of all landmarks, best first, at most ``max_hypotheses``.

    Headings and arms are not looked at. Positions are taken to have ``noise.position_sigma`` [m] per axis or their own
    covariance, and distances ``noise.distance_sigma_per_metre``; noise that is stated too large by up to four is
    noticed. ``count``, ``correspondences``: the one-to-one matches; ``score`` [nats]: see `_scores`. Two landmarks of
    each map that match are the least for a hypothesis; fewer give an empty list.

    >>> from mapfuse.datasets.maps import Landmark
    >>> at = [(0.0, 0.0), (9.0, 0.0), (3.0, 7.0), (12.0, 5.0)]
    >>> one = LandmarkMap("one", tuple(Landmark(f"a{k}", "tree", x, y) for k, (x, y) in enumerate(at)))
    >>> two = LandmarkMap("two", tuple(Landmark(f"b{k}", "tree", y, -x + 2) for k, (x, y) in enumerate(at)))
    >>> best = match_point_pairs(one, two)[0]
    >>> best.count, round(best.T12.theta, 3), round(best.T12.x, 3), round(best.T12.y, 3)
    (4, 1.571, 2.0, 0.0)
    """
    config, settings = config or MatchingConfig(), settings or PointPairConfig()
    if len(map1) < 2 or len(map2) < 2:
        return []
    label1, label2 = label_codes(map1.types, map2.types)
    if not config.use_h1:
        label1, label2 = np.zeros_like(label1), np.zeros_like(label2)
    one, two = _points(map1, label1), _points(map2, label2)
    drift = float(np.hypot(map1.noise.distance_sigma_per_metre, map2.noise.distance_sigma_per_metre))
    # Near neighbours find maps that overlap in a corner, far ones find maps that have few landmarks in common.
    scales = sorted({min(k, max(len(map1), len(map2)) - 1) for k in (settings.near, settings.far)})
    peaks = [_peaks(one, two, drift, neighbours, settings) for neighbours in scales]
    T12s, anchors = (np.concatenate(found) for found in zip(*peaks, strict=True))
    if not len(T12s):
        return []
    return _ranked(map1, map2, one, two, (T12s, anchors), drift, config, settings)


def _points(landmarks: LandmarkMap, label: Indices) -> _Points:
    xy, noise = landmarks.positions, landmarks.noise
    variance = np.full(len(xy), noise.position_sigma**2)
    joint = landmarks.joint_covariance
    if joint is not None:
        diagonal = np.diag(joint.matrix).reshape(-1, joint.rows)
        for identifier, of_axes in zip(joint.order, diagonal, strict=True):
            variance[landmarks.index_from_id[identifier]] = of_axes[:2].mean()
    for k, landmark in enumerate(landmarks.landmarks):
        if landmark.covariance is not None:
            variance[k] = np.trace(landmark.covariance[:2, :2]) / 2
    # The largest decide how far everything is searched, so that one that is hardly known must not blow it up.
    variance = np.clip(variance, _LEAST_SIGMA**2, max(_MOST_GROWTH * float(np.median(variance)), _LEAST_SIGMA**2))
    nearest = np.asarray(KDTree(xy).query(xy, k=min(_DENSITY_NEIGHBOURS + 1, len(xy)))[0])
    # Landmarks at one spot would have infinite density; closer than their noise they can't be told apart anyway.
    furthest = np.maximum(nearest[:, -1], 2 * np.sqrt(variance))
    share = np.bincount(label)[label] / len(xy)
    density = share * (nearest.shape[1] - 1) / (np.pi * furthest**2)
    recorded = np.array([noise.detection(t) * (1 - noise.false_alarm(t)) for t in landmarks.types])
    reach = nearest[:, min(_REACH_NEIGHBOURS, nearest.shape[1] - 1)]
    return _Points(xy, label, variance, density, reach, np.clip(recorded, 0.01, 0.99))


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Directed pairs of landmarks of one map, (m,): places, length [m], direction [rad], code of their two labels."""

    start: Indices
    end: Indices
    length: Array
    direction: Array
    labels: Indices

    def taken(self, places: Indices) -> _Pairs:
        return _Pairs(*(getattr(self, name)[places] for name in ("start", "end", "length", "direction", "labels")))


def _neighbour_pairs(points: _Points, neighbours: int, n_labels: int, shortest: float) -> _Pairs:
    """Each landmark with its nearest others that are at least ``shortest`` [m] away."""
    n = len(points.xy)
    _, near = KDTree(points.xy).query(points.xy, k=min(neighbours + 1, n))
    start, end = np.repeat(np.arange(n), near.shape[1]), near.ravel().astype(np.intp)
    offset = points.xy[end] - points.xy[start]
    length = np.hypot(offset[:, 0], offset[:, 1])
    labels = points.label[start] * n_labels + points.label[end]
    pairs = _Pairs(start, end, length, np.arctan2(offset[:, 1], offset[:, 0]), labels)
    return pairs.taken(np.flatnonzero((length >= shortest) & (start != end)))


def _equal_pairs(
    one: _Pairs, two: _Pairs, tolerance: Array, anchors_of: Callable[[Indices], Indices], budget: int
) -> tuple[Indices, Indices, Indices]:
    """All that have equal labels and lengths: places (pair of 1, pair of 2), and the anchors they start from in map 2.

    ``tolerance`` [m] is per pair of 2; ``anchors_of`` says, from how many equals each pair of 2 has, which landmarks
    of map 2 are asked; of those the shortest pairs count, up to ``budget``. A sorted join: memory grows with what is
    returned.
    """
    apart = 4 * (one.length.max() + two.length.max() + tolerance.max())
    key1, key2 = one.labels * apart + one.length, two.labels * apart + two.length
    order = np.argsort(key1, kind="stable")
    low = np.searchsorted(key1[order], key2 - tolerance, side="left")
    n = np.searchsorted(key1[order], key2 + tolerance, side="right") - low
    anchors = anchors_of(n)
    shortest_first = np.argsort(two.length, kind="stable")
    shortest_first = shortest_first[np.isin(two.start[shortest_first], anchors)]
    within = max(1, int(np.searchsorted(np.cumsum(n[shortest_first]), budget, side="right")))
    take = shortest_first[:within]
    n, low = n[take], low[take]
    place = np.repeat(low - (np.cumsum(n) - n), n) + np.arange(n.sum())
    return order[place], np.repeat(take, n), anchors


def _anchors(one: _Points, two: _Points, pairs2: _Pairs, equals: Indices, budget: int) -> Indices:
    """Landmarks of map 2 from which votes are cast: all, or so many that each can cast enough.

    A few that ask a dozen neighbours find more than many that can ask but two.
    """
    n = len(two.xy)
    first = np.searchsorted(pairs2.start, np.arange(n))
    nearest = np.arange(len(pairs2.start)) - first[pairs2.start] < _ASKED_NEIGHBOURS
    each = max(1.0, float(equals[nearest].sum()) / n)
    n_anchors = max(1, min(max(_FEWEST_ANCHORS, int(budget / each)), _ACCUMULATOR_CELLS // (_BINS * len(one.xy))))
    if n_anchors >= n:
        return np.arange(n)
    # Evenly by density: a choice in which neither the order of the landmarks nor the frame has a say.
    spread = np.linspace(0, n - 1, n_anchors).astype(np.intp)
    return np.sort(np.argsort(two.density, kind="stable")[spread])


def _peaks(
    one: _Points, two: _Points, drift: float, neighbours: int, settings: PointPairConfig
) -> tuple[Array, Indices]:
    """The T12s (s, 3) with most votes, strongest first, and the (s, 2) landmarks that each is anchored at."""
    sigma = np.sqrt(2) * _sigma(one, two)  # of the difference of two distances
    n_labels = 1 + int(max(one.label.max(), two.label.max()))
    shortest = settings.distance_sigmas * sigma
    pairs1, pairs2 = (_neighbour_pairs(p, neighbours, n_labels, shortest) for p in (one, two))
    if not len(pairs1.start) or not len(pairs2.start):
        return np.zeros((0, 3)), np.zeros((0, 2), dtype=np.intp)
    tolerance = settings.distance_sigmas * np.hypot(sigma, drift * pairs2.length)
    k1, k2, anchors = _equal_pairs(
        pairs1, pairs2, tolerance, lambda n: _anchors(one, two, pairs2, n, settings.votes), settings.votes
    )

    turn = (pairs1.direction[k1] - pairs2.direction[k2]) / (2 * np.pi) * _BINS
    slot = np.zeros(len(two.xy), dtype=np.intp)
    slot[anchors] = np.arange(len(anchors))
    row = pairs1.start[k1] * len(anchors) + slot[pairs2.start[k2]]
    cell = row * _BINS + np.floor(turn).astype(np.intp) % _BINS
    votes = np.bincount(cell, minlength=len(one.xy) * len(anchors) * _BINS).reshape(-1, _BINS).astype(np.float32)
    before, after = np.roll(votes, 1, axis=1), np.roll(votes, -1, axis=1)
    together = votes + (before + after) / 2
    peak = (together >= np.roll(together, 1, axis=1)) & (together > np.roll(together, -1, axis=1))
    surplus = together - votes.sum(axis=1, keepdims=True) * np.float32(2 / _BINS)
    row, bin_ = np.nonzero(peak)
    strongest = np.argsort(-surplus[row, bin_], kind="stable")[: settings.seeds]
    row, bin_ = row[strongest], bin_[strongest]
    shift = (after[row, bin_] - before[row, bin_]) / 2 / together[row, bin_]
    rotation = se2.wrap((bin_ + 0.5 + shift) * (2 * np.pi / _BINS))
    i, j = row // len(anchors), anchors[row % len(anchors)]
    return through(one.xy[i], two.xy[j], rotation), np.stack([i, j], axis=1)


@dataclass(frozen=True, slots=True)
class _Matched:
    """Matches of s transformations at once, (e,): which T12, landmark 1, landmark 2, squared distance, variance."""

    mode: Indices
    i: Indices
    j: Indices
    squared: Array
    variance: Array


def _match(
    one: _Points, two: _Points, T12s: Array, centre2: Array, drift: float, gate_sigmas: float, near_only: bool
) -> _Matched:
    """One-to-one matches under each T12; the variance grows with ``drift`` times the distance from ``centre2`` (s, 2).

    It grows to four times what it is at the centre; landmarks further away are left out if ``near_only``, and else
    matched with that much.
    """
    away = np.sum((two.xy - centre2[:, None]) ** 2, axis=2)
    grown = drift**2 * away
    most = (_MOST_GROWTH - 1) * (np.median(one.variance) + two.variance)
    asked = np.flatnonzero(grown <= most) if near_only else np.arange(grown.size)
    x, y = np.moveaxis(se2.transform(T12s[:, None], two.xy[None]), -1, 0)
    place, i, squared = one.grid(two, gate_sigmas).within_reach(x.ravel()[asked], y.ravel()[asked])
    mode, j = np.divmod(asked[place], len(two.xy))
    variance = one.variance[i] + two.variance[j] + np.minimum(grown, most)[mode, j]
    keep = (one.label[i] == two.label[j]) & (squared <= gate_sigmas**2 * variance)
    mode, i, j, squared, variance = (values[keep] for values in (mode, i, j, squared, variance))
    chosen = one_to_one(mode, i, j, squared)
    return _Matched(*(values[chosen] for values in (mode, i, j, squared, variance)))


def _aligned(one: _Points, two: _Points, T12s: Array, m: _Matched) -> tuple[Array, Array]:
    """Weighted closed-form alignment (`se2.align`) of all modes at once: T12s (s, 3), centres (s, 2) in frame 2.

    Modes with less than two distinct matches stay as they are.
    """
    n = len(T12s)
    weight = 1 / m.variance
    total = np.bincount(m.mode, weight, n)
    safe = np.where(total > 0, total, 1.0)
    p1, p2 = one.xy[m.i], two.xy[m.j]
    centre1, centre2 = (
        np.stack([np.bincount(m.mode, weight * axis, n) / safe for axis in points.T], axis=1) for points in (p1, p2)
    )
    q1, q2 = p1 - centre1[m.mode], p2 - centre2[m.mode]
    cross = np.bincount(m.mode, weight * (q2[:, 0] * q1[:, 1] - q2[:, 1] * q1[:, 0]), n)
    dot = np.bincount(m.mode, weight * np.sum(q1 * q2, axis=1), n)
    fixed = np.hypot(cross, dot) > 1e-9 * total
    out = np.where(fixed[:, None], through(centre1, centre2, np.arctan2(cross, dot)), T12s)
    centre2 = np.where(total[:, None] > 0, centre2, two.xy.mean(axis=0))
    return out, centre2


def _refined(
    one: _Points, two: _Points, T12s: Array, anchors: Indices, drift: float, settings: PointPairConfig
) -> tuple[Array, Indices, _Matched]:
    """Assignment and alignment by turns, all modes at once: first around the anchors, where a coarse rotation does
    no harm, then the distinct ones everywhere. Returns T12s (s, 3), which seed each was, and their matches."""
    centre2 = two.xy[anchors[:, 1]]
    for around in (_COARSE_ROTATION, _COARSE_ROTATION / 2):
        matched = _match(one, two, T12s, centre2, max(around, drift), settings.gate_sigmas, near_only=True)
        T12s, centre2 = _aligned(one, two, T12s, matched)
    order = np.argsort(-np.round(_gains(one, two, len(T12s), matched), 9), kind="stable")
    seed = order[distinct(T12s[order], two.xy, _sigma(one, two) / 2, settings.refined)]
    T12s, centre2 = T12s[seed], centre2[seed]
    for around in (max(_COARSE_ROTATION / 4, drift), drift):
        matched = _match(one, two, T12s, centre2, around, settings.gate_sigmas, near_only=False)
        T12s, centre2 = _aligned(one, two, T12s, matched)
    return T12s, seed, _match(one, two, T12s, centre2, drift, settings.gate_sigmas, near_only=False)


def _sigma(one: _Points, two: _Points) -> float:
    """Typical standard deviation [m] per axis of the residual of a match."""
    return float(np.sqrt(np.median(one.variance) + np.median(two.variance)))


def _gains(one: _Points, two: _Points, n: int, m: _Matched) -> Array:
    """What the matches of n modes say [nats] (n,): see `_scores`."""
    count = np.bincount(m.mode, minlength=n)
    normalised = np.bincount(m.mode, m.squared / m.variance, n)
    factor = np.minimum((normalised / 2 + _NOISE_PRIOR) / (count + _NOISE_PRIOR), 1.0)
    density = np.sqrt(one.density[m.i] * two.density[m.j])
    recorded = np.sqrt(one.recorded[m.i] * two.recorded[m.j])
    gain = np.bincount(m.mode, np.log(recorded / (2 * np.pi * m.variance * density)), n)
    gain -= count * np.log(factor) + normalised / (2 * factor)
    return np.asarray(gain - _NOISE_PRIOR * (np.log(factor) + 1 / factor - 1))


def _scores(one: _Points, two: _Points, T12s: Array, m: _Matched) -> Array:
    """Log likelihood ratio [nats] (s,) of each mode against "the maps show different places", but for a constant.

    Every match: density of its residual against that of landmarks of its label, times the rate at which both robots
    record a place. Every landmark where the other robot is likely to have looked: the failure to record it, if it
    has no match, and for its share of the area the void on which both robots agree. The noise may be smaller than
    stated: one factor f <= 1 on the variance, at the maximum of its posterior under an inverse gamma prior of weight
    `_NOISE_PRIOR` matches around f = 1.
    """
    gain = _gains(one, two, len(T12s), m)
    tree1, tree2 = KDTree(one.xy), KDTree(two.xy)
    for here, there, tree, poses, mine in (
        (two, one, tree1, T12s, m.j),
        (one, two, tree2, se2.inverse(T12s), m.i),
    ):
        distance, nearest = tree.query(se2.transform(poses[:, None], here.xy[None]))
        looked_at = distance <= there.reach[nearest]
        matched = np.zeros_like(looked_at)
        matched[m.mode, mine] = True
        rate = _COVERAGE * np.median(there.recorded)
        gain += np.sum(looked_at, axis=1) * rate / 2 + np.sum(looked_at & ~matched, axis=1) * np.log(1 - rate)
    return gain


def _ranked(
    map1: LandmarkMap,
    map2: LandmarkMap,
    one: _Points,
    two: _Points,
    seeds: tuple[Array, Indices],
    drift: float,
    config: MatchingConfig,
    settings: PointPairConfig,
) -> list[Hypothesis]:
    """Refined seeds as distinct hypotheses, best first."""
    T12s, seed_of_mode, matched = _refined(one, two, *seeds, drift, settings)
    score = _scores(one, two, T12s, matched)
    count = np.bincount(matched.mode, minlength=len(T12s))
    order = np.argsort(-np.round(score, 9), kind="stable")
    order = order[count[order] >= 2]
    kept = order[distinct(T12s[order], two.xy, 2 * _sigma(one, two), config.max_hypotheses)]
    out = []
    for k in kept:
        mine = np.flatnonzero(matched.mode == k)
        mine = mine[np.argsort(matched.i[mine])]
        pairs = tuple((map1.ids[i], map2.ids[j]) for i, j in zip(matched.i[mine], matched.j[mine], strict=True))
        i, j = seeds[1][seed_of_mode[k]]
        seed = (map1.ids[i], map2.ids[j])
        out.append(Hypothesis(Transform(*T12s[k].tolist()), len(pairs), pairs, (seed,), float(score[k])))
    return out
