"""The optimised merge: `fuse` on two maps."""

from __future__ import annotations

from mapfuse.datasets.maps import LandmarkMap

from ..config import FuseConfig
from ..groups import fuse
from ..result import FusedMap
from .method import Merge, MergedLandmark

#: A landmark whose existence is less probable isn't kept.
DOUBTFUL = 0.5


def merge_optimised(map1: LandmarkMap, map2: LandmarkMap, config: FuseConfig | None = None) -> Merge:
    """`fuse` of two maps as a `Merge`; chi-square and its expectation are those of both maps' own measurements."""
    return merge_of(fuse([map1, map2], config))


def merge_of(fused: FusedMap) -> Merge:
    """What a result of two maps says, as a `Merge`."""
    pair = fused.pairs[0]
    name1, name2 = pair.maps
    landmarks = tuple(
        MergedLandmark(
            l.x, l.y, tuple(l.sources.get(name1, ())), tuple(l.sources.get(name2, ())), l.existence >= DOUBTFUL
        )
        for l in fused.landmarks
        if pair.decision == "merged"
    )
    fits = fused.noise.values()
    return Merge(
        pair.decision,
        pair.T12,
        tuple(pair.correspondences),
        landmarks,
        pair.probability,
        sum(fit.chi2 for fit in fits),
        sum(fit.redundancy for fit in fits),
    )
