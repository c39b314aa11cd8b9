"""`propose`: two maps to ranked hypotheses of T12."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import chain, zip_longest

import numpy as np
from scipy.spatial import KDTree

from mapfuse.datasets.arms import heading_of
from mapfuse.datasets.maps import LandmarkMap

from .assignment import PointGrid
from .config import MatchingConfig
from .exhaustive import match_exhaustively
from .hypothesis import Hypothesis
from .modes import distinct_modes
from .point_pairs import match_point_pairs

#: Pairs tried times landmarks counted, times those that crowd around one: what the default mode spends on proposals
#: by headings (some seconds).
MAX_TRIALS = 30_000_000


def propose(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig | None = None) -> list[Hypothesis]:
    """Hypotheses of the transformation of map 2 into map 1, best first; empty where no landmarks can correspond.

    Paper mode is the exact, exhaustive matcher. The default mode lets doors propose as well and leaves the compass
    to the evidence (indoor compasses are bent by steel), adds what landmarks without heading propose in pairs, and
    keeps distinct modes only.

    >>> from mapfuse.datasets.maps import Landmark, Link
    >>> arms = (Link("open", 0.0), Link("blocked", 1.57), Link("blocked", 3.14), Link("open", -1.57))
    >>> one = LandmarkMap("one", (Landmark("c", "corner", 1.0, 2.0, links=arms),))
    >>> two = LandmarkMap("two", (Landmark("e", "corner", 0.0, 0.0, links=arms),))
    >>> [(h.T12.x, h.T12.y, h.count) for h in propose(one, two)]
    [(1.0, 2.0, 1)]
    """
    config = config or MatchingConfig()
    if config.mode == "paper":
        return list(match_exhaustively(map1, map2, config).hypotheses)
    headed = _from_headings(map1, map2, config)
    points = match_point_pairs(_without_heading(map1), _without_heading(map2), config)
    distinct = distinct_modes(headed, map2.positions, config.tolerance_m, config.max_hypotheses)
    # both kinds of proposals are ranked, but by figures that don't compare: take turns
    turns = chain.from_iterable(zip_longest(distinct, points))
    return [hypothesis for hypothesis in turns if hypothesis is not None][: config.max_hypotheses]


def _from_headings(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig) -> list[Hypothesis]:
    """What single pairs of landmarks propose and count: all of them, or, in large maps, a part of map 2's landmarks.

    A hypothesis needs one seed only, and any of the common landmarks will do. The part is that of the rarest types;
    within a type by the distance to the nearest other landmark, so that it is spread over the whole map, which may
    overlap anywhere, and is the same in whatever frame and order the map is written.
    """
    every_kind = replace(config, use_h2=False, use_compass=False)
    frequency, seeds = Counter(map1.types), len(map2)
    budget = MAX_TRIALS / max(PointGrid(map1.positions, config.tolerance_m).crowding, 1)
    if len(map1) * seeds**2 > budget:
        at = map2.positions
        near = np.asarray(KDTree(at).query(at, k=[2])[0])[:, 0].round(6)
        rarest = sorted(range(seeds), key=lambda k: (frequency[map2.types[k]], -near[k], *at[k].tolist()))
        trials = np.cumsum([frequency[map2.types[k]] for k in rarest]) * np.arange(1, seeds + 1)
        seeds = max(1, int(np.searchsorted(trials, budget, side="right")))
    chosen = map2 if seeds == len(map2) else _part(map2, sorted(rarest[:seeds]))
    return list(match_exhaustively(map1, chosen, every_kind).best(8 * config.max_hypotheses))


def _part(recorded: LandmarkMap, chosen: list[int]) -> LandmarkMap:
    """Some of the map's landmarks, for the matcher's eyes only: links to others are left as they are."""
    landmarks = tuple(recorded.landmarks[k] for k in chosen)
    return recorded.replace(landmarks=landmarks, joint_covariance=None, same_as={})


def _without_heading(recorded: LandmarkMap) -> LandmarkMap:
    """The map's landmarks that propose only in pairs."""
    bare = [k for k, landmark in enumerate(recorded.landmarks) if heading_of(landmark) is None]
    return _part(recorded, bare)
