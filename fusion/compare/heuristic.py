"""The paper's merge: the T12 with the highest count, map 2 laid on map 1 as a rigid body."""

from __future__ import annotations

from dataclasses import replace

from mapfuse.datasets.maps import LandmarkMap
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.exhaustive import match_exhaustively

from .method import Merge
from .rigid import rigid_merge


def merge_by_heuristic(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig | None = None) -> Merge:
    """Dedeoglu and Sukhatme (2000), section 3.2: always an answer where any candidate is left, never how sure it is.

    Raises `TooLargeError` where the exhaustive search would not end.
    """
    best = match_exhaustively(map1, map2, replace(config or MatchingConfig(), mode="paper")).best(1)
    if not best:
        return Merge("no_overlap", None)
    return rigid_merge(map1, map2, best[0].T12, best[0].correspondences)
