"""Pairs that the index left out and a solved group asks for: maps that put the same kind of landmark at one place, and
maps that have many landmarks in common by way of others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from itertools import combinations

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from ..members import MAY_BE_SAME_M
from ..placing import Pair

#: Maps with so many landmarks in common can say themselves whether they lie rightly on each other.
ENOUGH = 5


class _Landmark(msgspec.Struct):
    type: str
    x: float
    y: float
    sources: dict[str, list[str]]


class _Fused(msgspec.Struct):
    landmarks: list[_Landmark]


def unpaired(fused: bytes, compared: Container[Pair]) -> set[Pair]:
    """Pairs of a group's maps, not ``compared`` yet, that may have landmarks in common.

    ``fused``: the group's file. Two merged landmarks of one type, no farther apart than those that may be one, and from
    different maps only, ask for all pairs of these. So do `ENOUGH` merged landmarks that two maps both have: what ties
    these maps to each other by way of others should be borne out by them, or contradicted.

    >>> there = b'{"type": "tree", "x": 1.0, "y": 2.0, "sources": {"a": ["t1"], "b": ["t7"]}}'
    >>> beside = b'{"type": "tree", "x": 1.5, "y": 2.0, "sources": {"c": ["t3"]}}'
    >>> sorted(unpaired(b'{"landmarks": [' + there + b", " + beside + b"]}", {("a", "c")}))
    [('b', 'c')]
    """
    landmarks = msgspec.json.decode(fused, type=_Fused).landmarks
    if len(landmarks) < 2:
        return set()
    common = Counter(pair for landmark in landmarks for pair in combinations(sorted(landmark.sources), 2))
    at = np.array([(landmark.x, landmark.y) for landmark in landmarks])
    found = {pair for pair, count in common.items() if count >= ENOUGH}
    for i, j in cKDTree(at).query_pairs(MAY_BE_SAME_M, output_type="ndarray").tolist():
        one, other = landmarks[i], landmarks[j]
        if one.type == other.type and not one.sources.keys() & other.sources.keys():
            found |= {(min(a, b), max(a, b)) for a in one.sources for b in other.sources}
    return {pair for pair in found if pair not in compared}
