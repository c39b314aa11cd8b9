"""Graphs of places and ways, as robots' topological maps have them, to a map and back.

A node becomes a point landmark. A way says that a robot may go from one to another, not that its length or direction
was measured: the file's coordinates alone say that. So its `Link` has neither distance nor heading, and nothing counts
twice. A landmark has four links at most: the nearest ones; further ways are kept in its ``extra`` under `WAYS`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..mapfields import MAX_LINKS
from ..maps import Landmark, LandmarkMap, Link
from .reading import remark

#: Key of a landmark's ``extra``: ways beyond its links, each with ``to`` and what the file says of it.
WAYS = "ways"
#: Key of a link's ``extra``: true of ways that lead round a corner between their ends.
BENT = "bent"
#: What a node is where nobody says it.
WAYPOINT = "waypoint"
#: Nodes nearer than this are at the same place [m].
COINCIDENT_M = 1e-3


@dataclass(frozen=True, slots=True)
class Node:
    """A place: its name in the file, position [m], heading [rad] or None, and what else the file says of it."""

    name: str
    x: float
    y: float
    heading: float | None = None
    type: str = WAYPOINT
    extra: Mapping[str, Any] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True)
class Way:
    """A way from one node to another, by the nodes' names, with its own name where the file gives it one."""

    start: str
    end: str
    name: str | None = None
    extra: Mapping[str, Any] = field(default_factory=dict, hash=False)


def graph_map(name: str, nodes: Sequence[Node], ways: Sequence[Way]) -> tuple[LandmarkMap, tuple[str, ...]]:
    """A graph as a map, and remarks on what is odd in it.

    Of nodes of one name the first one keeps it and all ways to it. Ways to nodes that aren't there, from a node to
    itself, and ways that stand twice are left out.
    """
    ids, renamed = unique_names([node.name for node in nodes])
    place = {node.name: k for k, node in reversed(list(enumerate(nodes)))}
    known = [way for way in ways if way.start in place and way.end in place and way.start != way.end]
    once = {(way.start, way.end): way for way in reversed(known)}
    names = Counter(way.name for way in ways if way.name is not None)
    leaving: dict[int, list[tuple[str, Way]]] = {}
    for way in known:
        if once[way.start, way.end] is way:
            leaving.setdefault(place[way.start], []).append((ids[place[way.end]], way))
    xy = np.array([(node.x, node.y) for node in nodes], dtype=float).reshape(-1, 2)
    index = {identifier: k for k, identifier in enumerate(ids)}
    landmarks = tuple(
        _landmark(ids[k], node, _nearest_first(leaving.get(k, []), xy, k, index)) for k, node in enumerate(nodes)
    )
    missing = [f"{w.start} to {w.end}" for w in ways if w.start not in place or w.end not in place]
    further = [ids[k] for k, found in leaving.items() if len(found) > MAX_LINKS]
    remarks = (
        *remark(renamed, "nodes with the name of another one", "renamed, ways lead to the first one"),
        *remark(missing, "ways from or to nodes that aren't there", "left out"),
        *remark([w.start for w in ways if w.start == w.end], "ways from a node to itself", "left out"),
        *remark(_doubled(known), "ways that stand more than once", "taken once"),
        *remark([n for n, k in names.items() if k > 1], "ids that several ways have", "the ways are kept"),
        *remark(_coincident(xy, ids), "nodes at the same place", "both kept"),
        *remark(further, f"nodes with more than {MAX_LINKS} ways", f"the nearest are links, others in extra.{WAYS}"),
    )
    return LandmarkMap(name, landmarks), remarks


def ways_of(map_: LandmarkMap) -> Iterator[tuple[Landmark, str, Mapping[str, Any]]]:
    """All ways of a map, links and others: from which landmark, to which id, and what is known beside."""
    ids = map_.index_from_id
    for landmark in map_.landmarks:
        told: set[str] = set()
        for link in landmark.links:
            if link.connected_to_id is not None and link.connected_to_id not in told:
                told.add(link.connected_to_id)
                yield landmark, link.connected_to_id, link.extra
        further = landmark.extra.get(WAYS, ())
        for way in further if isinstance(further, (list, tuple)) else ():
            end = way.get("to") if isinstance(way, Mapping) else None
            if isinstance(end, str) and end in ids and end not in told:
                told.add(end)
                yield landmark, end, {key: value for key, value in way.items() if key != "to"}


def unique_names(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Names, each once, and those that had to be made: of equal names the second one gets ``#2``.

    >>> unique_names(["a", "b", "a"])
    (['a', 'b', 'a#2'], ['a#2'])
    """
    taken, given, renamed = set(names), [], []
    times: dict[str, int] = {}
    for name in names:
        new = name
        if name in times:
            while new in taken:
                times[name] += 1
                new = f"{name}#{times[name]}"
            renamed.append(new)
            taken.add(new)
        else:
            times[name] = 1
        given.append(new)
    return given, renamed


def _nearest_first(
    leaving: list[tuple[str, Way]], xy: np.ndarray[Any, Any], k: int, index: Mapping[str, int]
) -> list[tuple[str, Way]]:
    if len(leaving) <= MAX_LINKS:
        return leaving
    return sorted(leaving, key=lambda item: float(np.hypot(*(xy[index[item[0]]] - xy[k]))))


def _landmark(identifier: str, node: Node, leaving: Sequence[tuple[str, Way]]) -> Landmark:
    links = tuple(Link(connected_to_id=end, extra=way.extra) for end, way in leaving[:MAX_LINKS])
    further = [{"to": end, **way.extra} for end, way in leaving[MAX_LINKS:]]
    extra = {**node.extra, WAYS: further} if further else node.extra
    return Landmark(identifier, node.type, node.x, node.y, heading=node.heading, links=links, extra=extra)


def _doubled(ways: Sequence[Way]) -> list[str]:
    counts = Counter((way.start, way.end) for way in ways)
    return [f"{start} to {end}" for (start, end), k in counts.items() if k > 1]


def _coincident(xy: np.ndarray[Any, Any], ids: Sequence[str]) -> list[str]:
    if not len(xy):
        return []
    # the nearest neighbour alone: a thousand nodes at one place are a thousand pairs, not a million
    distances, found = (np.asarray(part)[:, 1] for part in cKDTree(xy).query(xy, k=2))
    pairs = {(min(k, int(j)), max(k, int(j))) for k, j in enumerate(found) if distances[k] < COINCIDENT_M}
    return [f"{ids[k]} and {ids[j]}" for k, j in sorted(pairs) if k != j]
