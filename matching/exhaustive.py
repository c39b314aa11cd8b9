"""The paper's matcher, exact and exhaustive: try every candidate transformation, count what overlaps and matches.

Dedeoglu & Sukhatme (2000), section 3.2, step by step:

1. the search space is the set of all landmark pairs; H1 and H2 leave the *selected* ones;
2. the compass gate drops a turn of a pair when most comparable readings of the arms that coincide differ by more than
   30 degrees, actual or hypothesised for opposite travel (`candidates.compass_readings`);
3. each turn of the remaining pairs gives one T12, by making positions and arm types coincide;
4. T12 is applied to *all* of map 2's landmarks, doors and points included; its count is the size of the largest
   one-to-one matching between landmarks that lie within ``tolerance_m`` of each other and match, that is, are of one
   type where H1 is on;
5. the highest count wins. Equal counts: the smaller rms distance of the matched landmarks, then the smaller rotation.

The paper doesn't say whether the arms of overlapping landmarks must coincide too, so only the type is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.errors import TooLargeError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.values import frozen_array

from .assignment import PointGrid, label_codes, one_to_one
from .candidates import CandidateCounts, arm_table, count_selected, select_pairs, through, turns_of_pairs
from .config import MatchingConfig
from .hypothesis import Hypothesis

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Selected pairs times landmarks of map 2 times how many of map 1 crowd within reach of one: at most that many are
#: tried; about a minute of one core.
MAX_EVALUATIONS = 1_000_000_000

_PLACES_AT_ONCE = 1 << 17
_EDGES_AT_ONCE = 1 << 21


@dataclass(frozen=True, eq=False)
class ExhaustiveResult:
    """All candidate transformations of a pair of maps, best first, one per remaining pair and turn.

    ``T12s`` (k, 3); ``match_counts`` (k,); ``rms`` (k,) [m]: of the matched landmarks' distances; ``seeds`` (k, 2):
    places in map 1 and map 2 of the pair that proposed each. ``counts``: what each heuristic left.
    """

    map1: LandmarkMap
    map2: LandmarkMap
    config: MatchingConfig
    T12s: Array
    match_counts: Indices
    rms: Array
    seeds: Indices
    counts: CandidateCounts

    def __len__(self) -> int:
        return len(self.T12s)

    @cached_property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """All of them as values with their correspondences, best first; ``score`` is the count."""
        return self.best(len(self))

    def best(self, k: int) -> tuple[Hypothesis, ...]:
        """The first ``k`` hypotheses; cheaper than `hypotheses` where there are thousands."""
        ids1, ids2 = self.map1.ids, self.map2.ids
        matched: list[list[tuple[str, str]]] = [[] for _ in self.T12s[:k]]
        for candidate, i, j, _ in _overlaps(self.map1, self.map2, self.T12s[:k], self.config):
            order = np.lexsort((i, candidate))
            for c, a, b in zip(candidate[order].tolist(), i[order].tolist(), j[order].tolist(), strict=True):
                matched[c].append((ids1[a], ids2[b]))
        return tuple(
            Hypothesis(Transform(*T12), count, tuple(pairs), ((ids1[a], ids2[b]),), float(count))
            for T12, count, pairs, (a, b) in zip(
                self.T12s[:k].tolist(), self.match_counts[:k].tolist(), matched, self.seeds[:k].tolist(), strict=True
            )
        )


def match_exhaustively(map1: LandmarkMap, map2: LandmarkMap, config: MatchingConfig | None = None) -> ExhaustiveResult:
    """Ranked T12s of all candidate pairs by the paper's algorithm, see the module's text.

    Memory is bounded but for 48 bytes a transformation. Raises `TooLargeError`, before any work, where the selected
    pairs times the landmarks of map 2 (times those that crowd within reach of one) exceed `MAX_EVALUATIONS`.

    >>> from mapfuse.datasets.maps import Landmark, Link
    >>> arms = (Link("open", 0.0), Link("blocked", 1.57), Link("blocked", 3.14), Link("open", -1.57))
    >>> one = LandmarkMap("one", (Landmark("c", "corner", 1.0, 2.0, links=arms), Landmark("d", "door", 5.0, 2.0)))
    >>> two = LandmarkMap("two", (Landmark("e", "corner", 0.0, 0.0, links=arms), Landmark("f", "door", 4.1, 0.0)))
    >>> result = match_exhaustively(one, two)
    >>> result.counts.total, result.counts.selected, result.hypotheses[0].count, result.hypotheses[0].T12.x
    (4, 1, 2, 1.0)
    """
    config = config or MatchingConfig()
    total, after_h1, selected = count_selected(map1, map2, config)
    if selected * len(map2) * PointGrid(map1.positions, config.tolerance_m).crowding > MAX_EVALUATIONS:
        raise TooLargeError(
            f"the exhaustive matcher would try {selected} pairs on {len(map2)} landmarks, more than"
            f" {MAX_EVALUATIONS} evaluations; use matching mode 'default' for maps of this size"
        )
    index1, index2 = select_pairs(map1, map2, config)
    gate_rad = np.deg2rad(config.compass_gate_deg)
    turns = turns_of_pairs(arm_table(map1), arm_table(map2), index1, index2, gate_rad)
    keep = turns.agrees if config.use_compass else np.ones_like(turns.agrees)
    dropped = np.setdiff1d(turns.pair[~keep], turns.pair[keep])
    pair, rotation = turns.pair[keep], turns.rotation[keep]

    T12s = through(map1.positions[index1[pair]], map2.positions[index2[pair]], rotation)
    match_counts, rms = _count_matches(map1, map2, T12s, config)
    # Rounded, so that equal candidates keep the pairs' order whatever the last bits say.
    order = np.lexsort((*np.round(T12s.T, 6), np.round(rms, 6), -match_counts))
    counts = CandidateCounts(total, after_h1, selected, selected - len(dropped), len(pair))
    seeds = np.stack([index1[pair], index2[pair]], axis=1)
    return ExhaustiveResult(
        map1, map2, config, frozen_array(T12s[order]), match_counts[order], rms[order], seeds[order], counts
    )


def matched_under(
    map1: LandmarkMap, map2: LandmarkMap, T12: Transform, config: MatchingConfig | None = None
) -> tuple[tuple[str, str], ...]:
    """The (id in map 1, id in map 2) that the paper's count (step 4) counts under one T12, in the order of map 1.

    >>> from mapfuse.datasets.maps import Landmark
    >>> one, two = (LandmarkMap(name, (Landmark("d", "door", 0.0, y),)) for name, y in (("one", 0.0), ("two", 0.4)))
    >>> matched_under(one, two, Transform(0.0, 0.0, 0.0)), matched_under(one, two, Transform(0.0, 1.0, 0.0))
    ((('d', 'd'),), ())
    """
    found = [(i, j) for _, i, j, _ in _overlaps(map1, map2, T12.array[None], config or MatchingConfig())]
    if not found:
        return ()
    ((index1, index2),) = found
    order = np.argsort(index1)
    return tuple((map1.ids[i], map2.ids[j]) for i, j in zip(index1[order], index2[order], strict=True))


def _overlaps(
    map1: LandmarkMap, map2: LandmarkMap, T12s: Array, config: MatchingConfig
) -> Iterator[tuple[Indices, Indices, Indices, Array]]:
    """Matched landmarks of all T12s, a bounded number at once: (T12, landmark 1, landmark 2, squared distance)."""
    if not len(map1) or not len(map2) or not len(T12s):
        return
    grid = PointGrid(map1.positions, config.tolerance_m)
    labels1, labels2 = label_codes(map1.types, map2.types)
    x2, y2 = map2.positions.T
    step = min(_PLACES_AT_ONCE // max(len(map1), len(map2)), _EDGES_AT_ONCE // (len(map2) * grid.most_listed))
    step = max(1, step)
    for begin in range(0, len(T12s), step):
        x, y, theta = T12s[begin : begin + step].T[:, :, None]
        c, s = np.cos(theta), np.sin(theta)
        place, i, squared = grid.within_reach((x + c * x2 - s * y2).ravel(), (y + s * x2 + c * y2).ravel())
        candidate, j = np.divmod(place, len(map2))
        if config.use_h1:
            same = labels1[i] == labels2[j]
            candidate, i, j, squared = candidate[same], i[same], j[same], squared[same]
        chosen = one_to_one(candidate, i, j, squared)
        yield candidate[chosen] + begin, i[chosen], j[chosen], squared[chosen]


def _count_matches(map1: LandmarkMap, map2: LandmarkMap, T12s: Array, config: MatchingConfig) -> tuple[Indices, Array]:
    count, total = np.zeros(len(T12s), dtype=np.intp), np.zeros(len(T12s))
    for candidate, _, _, squared in _overlaps(map1, map2, T12s, config):
        count += np.bincount(candidate, minlength=len(T12s))
        total += np.bincount(candidate, weights=squared, minlength=len(T12s))
    return count, np.sqrt(total / np.maximum(count, 1))
