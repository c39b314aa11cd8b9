"""`MapIndex`: which of many maps are worth pairing, without looking at all pairs.

What is distinctive in a map are triangles of near neighbours: the labels of the three landmarks, the lengths between
them, and which way their arms point. Two that are alike vote for the T12 that lays one map on the other, the rarer they
are the more (`triangles`), and the votes for one T12 are what a pair is worth. A pair is tried where it is worth much,
or something and more than most others of one of its maps.

Measured: docs/batch.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.maps import LandmarkMap

from .triangles import FAINT, MapTriangles, triangles_of, votes

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Pairs worth this [nats] are tried; those worth `FAINT` where one of the maps has no more than `PARTNERS` better ones.
SURE, PARTNERS = 30.0, 20
#: With so few maps all pairs are tried: what is rare can't be told yet.
FEW = 12


@dataclass(frozen=True, slots=True)
class Proposal:
    """Two maps worth comparing, by name, the first in alphabetical order first; ``score`` [nats] says how much."""

    map1: str
    map2: str
    score: float


class MapIndex:
    """An index that maps are added to, one by one.

    >>> from mapfuse.datasets import read_map, recordings
    >>> index = MapIndex()
    >>> for name in recordings.SCENES["ground-floor"]:
    ...     index.add(read_map(recordings.path(name)))
    >>> [(proposal.map1, proposal.map2) for proposal in index.pairs()]
    [('ground-floor-milka', 'ground-floor-vespucci')]
    """

    def __init__(self) -> None:
        self._maps: list[MapTriangles] = []
        self._labels: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._maps)

    def add(self, recorded: LandmarkMap) -> None:
        """Take in a map; names differ."""
        self._maps.append(triangles_of(recorded, self._labels))

    def pairs(self) -> list[Proposal]:
        """The pairs worth comparing, by name; the same whatever order the maps came in."""
        maps = sorted(self._maps, key=lambda m: m.name)
        names = [m.name for m in maps]
        place = {name: k for k, name in enumerate(names)}
        said = {(min(k, place[o]), max(k, place[o])) for k, m in enumerate(maps) for o in m.known if o in place}
        if len(maps) <= FEW:
            scores = dict.fromkeys(combinations(range(len(maps)), 2), 0.0)
        else:
            scores = _kept(votes(maps, self._ranked_labels()))
        scores |= {pair: max(scores.get(pair, 0.0), SURE) for pair in said if pair[0] != pair[1]}
        return [Proposal(names[a], names[b], scores[a, b]) for a, b in sorted(scores)]

    def _ranked_labels(self) -> Indices:
        """Each label's place in alphabetical order."""
        ranked = {label: rank for rank, label in enumerate(sorted(self._labels))}
        return np.array([ranked[label] for label in self._labels], dtype=np.intp)


def _kept(scores: Iterable[tuple[int, Indices, Array]]) -> dict[tuple[int, int], float]:
    """The pairs to try, each with the larger of what either map thinks of the other."""
    best: dict[tuple[int, int], float] = {}
    for k, others, worth in scores:
        of_map = np.flatnonzero(worth >= FAINT)
        of_map = of_map[np.lexsort((others[of_map], -worth[of_map]))]
        for rank, m in enumerate(of_map.tolist()):
            if rank >= PARTNERS and worth[m] < SURE:
                break
            pair = (min(k, int(others[m])), max(k, int(others[m])))
            best[pair] = max(best.get(pair, 0.0), float(worth[m]))
    return best
