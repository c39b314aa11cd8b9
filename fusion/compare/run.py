"""Pairs of maps through every method."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations

from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.truth import Truth
from mapfuse.matching.candidates import count_selected
from mapfuse.matching.config import MatchingConfig

from .evaluation import Evaluation, evaluated
from .method import Merge, Method
from .methods import methods as all_methods


def all_pairs(maps: Mapping[str, LandmarkMap]) -> tuple[tuple[str, str], ...]:
    """Every pair of names once, in the maps' order."""
    return tuple(combinations(maps, 2))


def compare(
    maps: Mapping[str, LandmarkMap],
    pairs: Iterable[tuple[str, str]] | None = None,
    methods: Sequence[Method] | None = None,
    truth: Truth | None = None,
    advance: Callable[[float], None] = lambda _: None,
) -> tuple[Evaluation, ...]:
    """Every method on every pair of named maps, pair by pair; ``advance`` is told of each pair that is done.

    A pair that a method can't do is an evaluation with an ``error``, and everything else goes on.

    Raises KeyError for a pair of maps that aren't there, or that the truth doesn't know.

    >>> from mapfuse.datasets import read_map, recordings
    >>> from mapfuse.datasets.truth import read_truth
    >>> names = recordings.SCENES["ground-floor"]
    >>> maps = {name: read_map(recordings.path(name)) for name in names}
    >>> truth = read_truth(recordings.truth_path("ground-floor"))
    >>> [(e.method, e.decision, e.correctness) for e in compare(maps, methods=all_methods(["optimised"]), truth=truth)]
    [('optimised', 'merged', 1.0)]
    """
    methods = all_methods() if methods is None else methods
    found: list[Evaluation] = []
    for name1, name2 in all_pairs(maps) if pairs is None else pairs:
        found += compare_pair(maps[name1], maps[name2], methods, truth)
        advance(1)
    return tuple(found)


def compare_pair(
    map1: LandmarkMap, map2: LandmarkMap, methods: Sequence[Method], truth: Truth | None = None
) -> tuple[Evaluation, ...]:
    """Every method on one pair; matches gained and lost are those against the first method."""
    total, _, selected = count_selected(map1, map2, MatchingConfig())
    first: set[tuple[str, str]] | None = None
    found = []
    for k, method in enumerate(methods):
        merge, seconds, error = _merged(map1, map2, method)
        matches = None if merge is None else set(merge.correspondences)
        first = matches if k == 0 else first
        both = matches is not None and first is not None
        found.append(
            Evaluation(
                (map1.name, map2.name),
                method.name,
                total,
                selected,
                merge,
                len(matches - first) if both else None,  # type: ignore[operator]
                len(first - matches) if both else None,  # type: ignore[operator]
                seconds,
                None if truth is None or merge is None else evaluated(map1, map2, merge, truth),
                error,
            )
        )
    return tuple(found)


def _merged(map1: LandmarkMap, map2: LandmarkMap, method: Method) -> tuple[Merge | None, float | None, str]:
    if method.missing:
        return None, None, method.missing
    begin = time.perf_counter()
    try:
        merge = method.run(map1, map2)
    except MapfuseError as error:
        return None, time.perf_counter() - begin, str(error)
    return merge, time.perf_counter() - begin, ""
