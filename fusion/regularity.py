"""How regularly a building is laid out: what a place on its grid tells less than a place anywhere.

Landmarks of corridors are no Poisson process. Junctions stand on the lines of other corridors, and in buildings of one
pitch everything stands at the same few distances from what is before it. Two different buildings of one style agree
there for nothing, so a match at such a place is measured against a higher density (docs/evidence.md, "Regular
buildings").
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import rel_entr

from mapfuse.datasets.compiled import kernels
from mapfuse.datasets.maps import SPATIAL_TYPES

from .prepared import PreparedMap

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# `_corridor_kernels` has those of rhythms and lines once more, since numba's cache looks at no other file.
#: Distances [m] along a corridor up to which landmarks are taken to stand in a rhythm.
REACH_M = 25.0
#: Two distances are the same to within this [m] and this share of them.
SAME_DISTANCE_M, SAME_DISTANCE_SHARE = 0.5, 0.03
#: Share of the places where a corridor's line crosses another corridor at which a corner or junction stands.
ON_A_LINE = 0.5
#: Landmarks on one line through a corridor are at most this far from it [m].
LINE_WIDTH_M = 1.0
#: Pitches [m] that are tried: from, below, step. One is believed where multiples of it stand out by so many nats.
PITCHES_M = (4.0, 15.0, 0.1)
PITCH_ODDS = 10.0
#: Cosine of the angle within which two directions along corridors are the same.
SAME_WAY = 0.7
#: Exposures that are added to those seen, so that one repeated distance is no rhythm.
DOUBT = 2.0


def corridor_kernels() -> ModuleType:
    """The compiled loops (`_corridor_kernels`)."""
    return kernels("_corridor_kernels", __package__, "what matches are worth")


@dataclass(frozen=True, eq=False)
class Gaps:
    """Distances along one map's straight corridors: from landmark to landmark (g, 2), ``distance`` (g,) [m] in the
    direction ``toward`` (g, 2); and from which landmarks (e,) how far, ``exposure`` (e,) [m] in the direction
    ``outward`` (e, 2), one could have come upon something.

    ``label`` (n,): of the map's landmarks; ``spatial`` (n,): which are corners or junctions.
    """

    pairs: Index
    distance: Array
    toward: Array
    origin: Index
    exposure: Array
    outward: Array
    label: Index
    spatial: NDArray[np.bool_]

    @classmethod
    def of(cls, m: PreparedMap, label: Index, angle: float) -> Gaps:
        """Of a map whose landmarks have ``label`` (n,); corridors go straight on within ``angle`` [rad]."""
        spatial = np.array([name in SPATIAL_TYPES for name in m.map.types], dtype=bool)
        pairs, distance, toward, origin, exposure, outward = corridor_kernels().gaps(
            m.positions, m.corridors, REACH_M, float(np.cos(angle))
        )
        # what rather isn't there says nothing of the building's style
        there = m.false < 0.5
        both, starts = there[pairs].all(axis=1), there[origin]
        along = pairs[both], distance[both], toward[both]
        return cls(*along, origin[starts], exposure[starts], outward[starts], label, spatial)

    @cached_property
    def start(self) -> Index:
        """What a landmark is as a place to start from (n,): all corners and junctions are alike."""
        return np.where(self.spatial, -1, self.label)

    @cached_property
    def between_spatial(self) -> Array:
        """Distances (k,) [m] between corners and junctions along a straight corridor, each once."""
        a, b = self.pairs.T
        return np.asarray(self.distance[self.spatial[a] & self.spatial[b] & (a < b)])

    @cached_property
    def table(self) -> Any:
        """The same as the compiled loops take it (`_corridor_kernels.Rhythm`)."""
        return corridor_kernels().Rhythm(
            *(self.pairs, self.distance, self.toward, self.origin, self.exposure, self.outward),
            *(self.start, self.label, self.spatial),
        )


def pitch_of(distances: Array) -> float:
    """The pitch [m] of which the distances (k,) between corners and junctions are multiples, or 0 where there is none.

    The one for which the share of multiples stands out most against chance, by its log likelihood ratio, which must be
    `PITCH_ODDS` nats; then by least squares over those multiples.
    """
    if not len(distances):
        return 0.0
    pitches = np.arange(*PITCHES_M)
    steps = np.maximum(np.round(distances / pitches[:, None]), 1.0)
    tolerance = SAME_DISTANCE_M + SAME_DISTANCE_SHARE * distances
    share = (np.abs(distances - steps * pitches[:, None]) < tolerance).mean(axis=1)
    chance = np.minimum(2 * tolerance.mean() / pitches, 0.999)
    odds = len(distances) * (rel_entr(share, chance) + rel_entr(1 - share, 1 - chance))
    best = int(np.argmax(np.where(share > chance, odds, -np.inf)))
    if share[best] <= chance[best] or odds[best] <= PITCH_ODDS:
        return 0.0
    n = steps[best]
    multiple = np.abs(distances - n * pitches[best]) < tolerance
    return float((distances @ (n * multiple)) / (n @ (n * multiple)))


@dataclass(frozen=True, eq=False)
class Regularity:
    """Of two maps together: how surely something stands where a match stands, whichever buildings these are."""

    gaps1: Gaps
    gaps2: Gaps

    @cached_property
    def distances(self) -> int:
        """How many distances along straight corridors the maps hold, each once."""
        return sum(int((g.pairs[:, 0] < g.pairs[:, 1]).sum()) for g in (self.gaps1, self.gaps2))

    @cached_property
    def pitch(self) -> float:
        """Pitch [m] of both maps' corridors, or 0."""
        return pitch_of(np.concatenate([self.gaps1.between_spatial, self.gaps2.between_spatial]))

    def shares(self, i: Index, j: Index, at: Array, along: Array, turn: float, rate: Array) -> Array:
        """Share (k,) of other buildings of this style that have a landmark of match k's label where it stands.

        Matches (i, j) in the order in which they are come upon, standing ``at`` (k, 2) [m], each come upon in the
        direction ``along`` (k, 2), map 2 turned by ``turn`` [rad]; ``rate`` (k,) [1/m]: how common its label is
        anywhere.
        """
        found: Array = corridor_kernels().shares(
            self.gaps1.table, self.gaps2.table, i, j, at, along, turn, rate, float(self.pitch)
        )
        return found
