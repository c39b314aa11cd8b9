"""Hypotheses of T12 from landmarks without heading: pairs of pairs that have equal labels and equal distances.

One landmark of each map leaves the rotation open; two of each fix it. So every two neighbours (i, i') of map 1 and
(j, j') of map 2 with equal labels and, within tolerance, equal distance vote for "i is j, and map 2 is turned by the
difference of their directions". Votes are counted per (i, j, rotation): the position is anchored at i and j, where it
is exact, so that neither the distance to an origin nor a bend of the maps far away blurs the peak. The strongest are
refined around their anchors; the best of those grow over the maps: a landmark is looked for where the alignment and
the bend of its matched neighbours predict it, as soon as the prediction is sure enough. What has grown is ranked by a
log likelihood ratio. Each vote is a proper rotation: a mirrored map is never proposed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets import se2
from mapfuse.datasets.compiled import kernels
from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform

from .candidates import through
from .config import MatchingConfig
from .hypothesis import Correspondences, Hypothesis
from .landmark_arrays import landmark_arrays, shared_labels
from .point_arrays import PointArrays, point_arrays

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_NOISE_PRIOR = 3.0
#: Rotation [rad] by which a peak may be off before it is refined.
_COARSE_ROTATION = 0.06
#: Without a stated bend its variance is so many times that of the noise.
_BEND_VARIANCE = 3.0
#: Probability that a place was looked at which is as near to a landmark as other landmarks are.
_COVERAGE = 0.5
#: What a match must be worth [nats] under its prediction.
_LEAST_GAIN = 0.0
_FEWEST_ANCHORS = 16
#: Pairs (i, j) times pairs of their far neighbours that are looked at.
_FAR_PAIRS = 6_000_000
_ROUNDS = 6
_NEAR = 24


def _kernels() -> ModuleType:
    return kernels("_point_kernels", __package__, "the search among points")


@dataclass(frozen=True, slots=True)
class PointPairConfig:
    """How landmarks without heading propose.

    ``distance_sigmas``: two distances are equal when they differ by at most that many standard deviations.
    ``near``, ``far``: each landmark is paired with its so many nearest ones; both are tried, far ones in small maps.
    ``anchors``: pairs (i, j) that are asked at most; of larger maps a part of the smaller one's landmarks asks, rare
    labels first. ``seeds``: peaks that are refined around their anchor, times the square root of a hundredth of the
    landmarks; ``grown``: landmarks in all the modes that grow over the maps, the best of the refined, at least
    ``least_grown`` modes. ``gate_sigmas``: landmarks match within that many standard deviations.
    """

    distance_sigmas: float = 2.0
    near: int = 16
    far: int = 40
    anchors: int = 500_000
    seeds: int = 600
    grown: int = 4_000
    least_grown: int = 24
    gate_sigmas: float = 3.0

    def __post_init__(self) -> None:
        for name in ("distance_sigmas", "near", "far", "anchors", "seeds", "grown", "least_grown", "gate_sigmas"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"matching.point_pairs.{name} is {getattr(self, name)!r}; it must be greater than 0")


@dataclass(frozen=True, slots=True)
class _Problem:
    """Both maps with common label codes, and the scales [m] of noise and bend between them.

    ``rarity1``, ``rarity2`` (n,): log of what a match is worth but for its residual, half of it from each map.
    """

    one: PointArrays
    two: PointArrays
    label1: NDArray[np.int32]
    label2: NDArray[np.int32]
    rarity1: Array
    rarity2: Array
    variance: float
    drift: float
    bend: float
    scale: float

    @property
    def sigma(self) -> float:
        """Typical standard deviation [m] per axis of the residual of a match."""
        return float(np.sqrt(self.variance))


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
    each map that match are the least for a hypothesis; fewer give an empty list. Swapped maps give the inverses.

    >>> from mapfuse.datasets.maps import Landmark
    >>> at = [(0.0, 0.0), (9.0, 0.0), (3.0, 7.0), (12.0, 5.0)]
    >>> one = LandmarkMap("one", tuple(Landmark(f"a{k}", "tree", x, y) for k, (x, y) in enumerate(at)))
    >>> two = LandmarkMap("two", tuple(Landmark(f"b{k}", "tree", y, -x + 2) for k, (x, y) in enumerate(at)))
    >>> best = match_point_pairs(one, two)[0]
    >>> best.count, round(best.T12.theta, 3), round(best.T12.x, 3), round(best.T12.y, 3)
    (4, 1.571, 2.0, 0.0)
    """
    config, settings = config or MatchingConfig(), settings or PointPairConfig()
    problem = _problem(map1, map2, config)
    if problem is None:
        return []
    # The larger map is looked up and the smaller one moved, whichever comes first: so swapping changes nothing.
    swapped = problem.two.key > problem.one.key
    if swapped:
        problem = replace(
            problem,
            one=problem.two,
            two=problem.one,
            label1=problem.label2,
            label2=problem.label1,
            rarity1=problem.rarity2,
            rarity2=problem.rarity1,
        )
    modes = _searched(problem, config, settings)
    return [] if modes is None else _hypotheses(map1, map2, problem, modes, swapped)


def _problem(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig) -> _Problem | None:
    """None where no two landmarks of one map can match two of the other."""
    arrays1, arrays2 = landmark_arrays(map1), landmark_arrays(map2)
    one, two = point_arrays(arrays1), point_arrays(arrays2)
    if one is None or two is None:
        return None
    label1, label2, _ = shared_labels(arrays1, arrays2)
    label1, label2 = label1[one.order], label2[two.order]
    if not config.use_h1:
        label1, label2 = np.zeros_like(label1), np.zeros_like(label2)
    variance = float(np.median(one.variance) + np.median(two.variance))
    drift = float(np.hypot(map1.noise.distance_sigma_per_metre, map2.noise.distance_sigma_per_metre))
    bend = config.bend_sigma_m if config.bend_sigma_m > 0 else float(np.sqrt(_BEND_VARIANCE * variance))
    scale = config.bend_length_m if config.bend_length_m > 0 else None
    if scale is None:
        scale = bend / drift if drift > 0 else 1e6 * bend + 1.0
    if drift == 0 and config.bend_sigma_m == 0:
        bend = 0.0
    rarity1, rarity2 = (
        0.5 * (np.log(side.recorded) - np.log(2 * np.pi * side.density * (side.share if config.use_h1 else 1.0)))
        for side in (one, two)
    )
    return _Problem(one, two, label1, label2, rarity1, rarity2, variance, max(drift, bend / scale), bend, scale)


@dataclass(frozen=True, slots=True)
class _Modes:
    """Distinct modes, best first: T12s (s, 3), the matched ``partner`` (s, n2) of map 2's landmarks in map 1 or -1,
    scores [nats] (s,), and the ``anchors`` (s, 2) that proposed each; all in the order of `PointArrays`."""

    T12s: Array
    partner: NDArray[np.int32]
    score: Array
    anchors: Indices


def _searched(problem: _Problem, config: MatchingConfig, settings: PointPairConfig) -> _Modes | None:
    one, two = problem.one, problem.two
    T12s, anchors = _peaks(problem, settings)
    if not len(T12s):
        return None
    kernel = _kernels()
    widest = float(one.variance.max() + two.variance.max() + 1.5 * problem.bend**2)
    grid = one.grid(settings.gate_sigmas * float(np.sqrt(max(widest, 4 * problem.variance))))
    cells = (grid.start, grid.members, grid.box, grid.shape)
    side1 = (one.xy, one.variance, problem.label1, problem.rarity1)
    side2 = (two.xy, two.variance, problem.label2, problem.rarity2)
    # Refined around the anchor, where a coarse rotation does no harm.
    around = max(_COARSE_ROTATION, problem.drift)
    gate = settings.gate_sigmas
    gain = kernel.refine_near(T12s, anchors[:, 1].copy(), *side1, *side2, two.near, _NEAR, *cells, around, gate)
    order = np.argsort(-np.round(gain, 9), kind="stable")
    order = order[gain[order] > -1e8]
    n_grown = max(settings.least_grown, settings.grown // len(two))
    seed = order[_distinct(T12s[order], two, problem.sigma / 2, n_grown)]
    T12s, anchors = np.ascontiguousarray(T12s[seed]), anchors[seed]
    partner, gain, normalised, freedom = kernel.grow(
        T12s, anchors[:, 1].copy(), *side1, *side2, two.near, two.length, _NEAR, *cells,
        problem.bend, problem.scale, around / 4, gate, problem.variance, _ROUNDS, _LEAST_GAIN,
    )  # fmt: skip
    score = _scores(problem, T12s, partner, gain, normalised) + freedom
    count = np.sum(partner >= 0, axis=1)
    order = np.argsort(-np.round(score, 9), kind="stable")
    order = order[count[order] >= 2]
    kept = order[_distinct(T12s[order], two, 2 * problem.sigma, config.max_hypotheses)]
    return _Modes(T12s[kept], partner[kept], score[kept], anchors[kept])


def _distinct(T12s: Array, two: PointArrays, tolerance_m: float, limit: int) -> Indices:
    """The same as `modes.distinct`, compiled."""
    x, y = two.xy.mean(axis=0).tolist()
    spread = float(np.mean((two.xy - (x, y)) ** 2) * 2)
    kept: Indices = _kernels().distinct(T12s, x, y, spread, tolerance_m**2, limit)
    return kept


def _peaks(problem: _Problem, settings: PointPairConfig) -> tuple[Array, Indices]:
    """The T12s (s, 3) that most pairs of pairs speak for, strongest first, and the (s, 2) places of their anchors."""
    one, two = problem.one, problem.two
    asked = _anchors(problem, settings.anchors)
    n_seeds = int(settings.seeds * np.sqrt(max(1.0, len(two) / 100)))
    far = min(settings.far, int(np.sqrt(_FAR_PAIRS / max(len(asked) * len(one), 1))))
    # Near neighbours find maps that overlap in a corner, far ones find maps that have few landmarks in common.
    scales = [(settings.near, n_seeds), (far, n_seeds // 2)] if far > settings.near else [(settings.near, n_seeds)]
    found = [_strongest(problem, settings, asked, neighbours, n) for neighbours, n in scales]
    T12s, anchors = (np.concatenate(values) for values in zip(*found, strict=True))
    return T12s, anchors


def _strongest(
    problem: _Problem, settings: PointPairConfig, asked: Indices, neighbours: int, n_seeds: int
) -> tuple[Array, Indices]:
    """The ``n_seeds`` strongest T12s by the votes of so many neighbours of each, and their anchors."""
    one, two = problem.one, problem.two
    sigma = np.sqrt(2) * problem.sigma  # of the difference of two distances
    tolerance = settings.distance_sigmas * np.hypot(sigma, problem.drift * two.length)
    listed1 = (one.length, one.angle, problem.label1[one.near])
    listed2 = (two.length, two.angle, problem.label2[two.near], tolerance)
    length1, angle1, near_label1 = (np.ascontiguousarray(values[:, :neighbours]) for values in listed1)
    length2, angle2, near_label2, within = (np.ascontiguousarray(values[:, :neighbours]) for values in listed2)
    strength, turn = _kernels().vote(
        length1, angle1, near_label1, problem.label1, length2, angle2, near_label2, problem.label2, within,
        settings.distance_sigmas * sigma, asked,
    )  # fmt: skip
    flat = strength.reshape(-1)
    least = np.partition(flat, len(flat) - n_seeds)[len(flat) - n_seeds] if len(flat) > n_seeds else 0.0
    place = np.flatnonzero(flat >= max(least, 0.0))
    place = place[np.argsort(-flat[place], kind="stable")][:n_seeds]
    a, i = np.divmod(place, len(one))
    rotation = se2.wrap(turn.reshape(-1)[place] + one.direction[i] - two.direction[asked[a]])
    return through(one.xy[i], two.xy[asked[a]], rotation), np.stack([i, asked[a]], axis=1)


def _anchors(problem: _Problem, budget: int) -> Indices:
    """Places of map 2's landmarks that ask all of map 1 with their label: all, or so many that the budget allows.

    Those of rare labels first, whole labels at a time; within the label that doesn't fit whole, evenly by density: a
    choice in which neither the order of the landmarks nor the frame has a say.
    """
    n_labels = 1 + int(max(problem.label1.max(), problem.label2.max()))
    of_label1 = np.bincount(problem.label1, minlength=n_labels)
    asked = np.flatnonzero(of_label1[problem.label2] > 0)
    cost = of_label1[problem.label2[asked]]
    if cost.sum() <= budget:
        return asked
    chosen: list[Indices] = []
    for label in np.argsort(of_label1 * np.bincount(problem.label2, minlength=n_labels), kind="stable").tolist():
        members = asked[problem.label2[asked] == label]
        if not len(members):
            continue
        affordable = budget // max(int(of_label1[label]), 1)
        if affordable < len(members):
            affordable = max(affordable, 0 if chosen else _FEWEST_ANCHORS)
            by_density = members[np.argsort(problem.two.density[members], kind="stable")]
            even = np.linspace(0, len(members) - 1, min(affordable, len(members))).astype(np.intp)
            chosen.append(by_density[even])
            break
        chosen.append(members)
        budget -= len(members) * int(of_label1[label])
    return np.sort(np.concatenate(chosen)) if chosen else asked[:0]


def _scores(problem: _Problem, T12s: Array, partner: NDArray[np.int32], gain: Array, normalised: Array) -> Array:
    """Log likelihood ratio [nats] (s,) of each mode against "the maps show different places", but for a constant.

    Every match: density of its residual under the bend that its neighbours predict against that of landmarks of its
    label, times the rate at which both robots record a place. Every landmark where the other robot is likely to have
    looked: the failure to record it, if it has no match, and for its share of the area the void on which both robots
    agree. The noise may be smaller than stated: one factor f <= 1 on the variance, at the maximum of its posterior
    under an inverse gamma prior of weight `_NOISE_PRIOR` matches around f = 1.
    """
    one, two = problem.one, problem.two
    kernel = _kernels()
    count = np.sum(partner >= 0, axis=1)
    factor = np.minimum((normalised / 2 + _NOISE_PRIOR) / (count + _NOISE_PRIOR), 1.0)
    score = gain - count * np.log(factor) - normalised / (2 * factor)
    score -= _NOISE_PRIOR * (np.log(factor) + 1 / factor - 1)
    matched1 = np.zeros((len(T12s), len(one)), dtype=bool)
    mode, j = np.nonzero(partner >= 0)
    matched1[mode, partner[mode, j]] = True
    for here, there, poses, matched in (
        (two, one, T12s, partner >= 0),
        (one, two, se2.inverse(T12s), matched1),
    ):
        grid = there.reach_grid
        at = np.ascontiguousarray(np.moveaxis(se2.transform(poses[:, None], here.xy[None]), -1, 0)).reshape(2, -1)
        seen = kernel.looked_at(
            at[0], at[1], there.xy, there.reach, grid.start, grid.members, grid.box, grid.shape
        ).reshape(matched.shape)
        rate = _COVERAGE * float(np.median(there.recorded))
        score += np.sum(seen, axis=1) * rate / 2 + np.sum(seen & ~matched, axis=1) * np.log(1 - rate)
    return np.asarray(score)


def _hypotheses(
    map1: LandmarkMap, map2: LandmarkMap, problem: _Problem, modes: _Modes, swapped: bool
) -> list[Hypothesis]:
    """Modes in the maps' own order and terms."""
    one, two, ids1, ids2 = problem.one.order, problem.two.order, map1.ids, map2.ids
    T12s = se2.inverse(modes.T12s) if swapped else modes.T12s
    out = []
    for T12, found, score, (i0, j0) in zip(T12s, modes.partner, modes.score.tolist(), modes.anchors, strict=True):
        j = np.flatnonzero(found >= 0)
        index1, index2 = one[found[j]], two[j]
        seed1, seed2 = int(one[i0]), int(two[j0])
        if swapped:
            index1, index2, seed1, seed2 = index2, index1, seed2, seed1
        partner = np.full(len(ids2), -1, dtype=np.int32)
        partner[index2] = index1
        pairs = Correspondences(ids1, ids2, partner, len(j))
        out.append(Hypothesis(Transform(*T12.tolist()), len(j), pairs, ((ids1[seed1], ids2[seed2]),), score))
    return out
