"""Hypotheses of T12 from landmarks without heading: pairs of pairs that have equal labels and equal distances.

One landmark of each map leaves the rotation open; two of each fix it. So every two neighbours (i, i') of map 1 and
(j, j') of map 2 with equal labels and, within tolerance, equal distance vote for "i is j, and map 2 is turned by the
difference of their directions". Votes are counted per (i, j, rotation): the position is anchored at i and j, where it
is exact, so that neither the distance to an origin nor a bend of the maps far away blurs the peak. The strongest peaks
are refined, all at once, by assignment and weighted closed-form alignment, and ranked by a log likelihood ratio.
Each vote is a proper rotation: a mirrored map is never proposed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mapfuse.datasets import se2
from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform

from .assignment import PointGrid, label_codes, one_to_one
from .config import MatchingConfig
from .hypothesis import Hypothesis
from .modes import distinct

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_BINS = 72
_ACCUMULATOR_CELLS = 8_000_000


@dataclass(frozen=True, slots=True)
class PointPairConfig:
    """How landmarks without heading propose.

    ``distance_sigmas``: two distances are equal when they differ by at most that many standard deviations.
    ``neighbours``: each landmark is paired with at most so many others, the nearest. ``votes``: cast at most, those
    of the shortest pairs first. ``seeds``: peaks that are refined. ``gate_sigmas``: landmarks match within that many.
    """

    distance_sigmas: float = 2.0
    neighbours: int = 60
    votes: int = 400_000
    seeds: int = 256
    gate_sigmas: float = 3.0

    def __post_init__(self) -> None:
        for name in ("distance_sigmas", "neighbours", "votes", "seeds", "gate_sigmas"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"matching.point_pairs.{name} is {getattr(self, name)!r}; it must be greater than 0")


@dataclass(frozen=True, slots=True)
class _Points:
    """What the search needs of one map, all (n, ...): positions [m], label codes, variance per axis [m^2]."""

    xy: Array
    label: Indices
    variance: Array
    density: Array
    reach: Array
    detection: Array
    false_alarm: Array


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
    T12s, anchors = _peaks(one, two, drift, settings)
    if not len(T12s):
        return []
    return _ranked(map1, map2, one, two, T12s, anchors, drift, config, settings)
