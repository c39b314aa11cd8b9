"""Middle lines to corridors: without branches into corners, with places once, straight between them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..simulation.corridorgraph import simplified
from .config import ExtractConfig
from .skeleton import Way, WayGraph

Array = NDArray[np.float64]

#: A branch into the corner of a room is sqrt(2) times as long as the room's clearance.
_INTO_CORNER = 0.5
#: Where the nearest wall is this much further [m] than what is free ends at something unseen, and a side way needs
#: this share of its points between walls.
_UNSEEN, _KNOWN = 0.3, 0.6
#: Lines are fitted over this length [m] beyond the space of the place where they begin; they are as straight as [m].
_LINE_LENGTH, _LINE_SIGMA = 3.0, 0.1


def corridors(graph: WayGraph, config: ExtractConfig) -> WayGraph:
    """The graph's corridors, straight ways between places; the graph that is given is used up."""
    _shorten_to_known(graph, config)
    _prune(graph, config)
    while _one_contracted(graph, config):
        pass
    _prune(graph, config)
    _without_loops(graph)
    _split_at_doors(graph, config)
    _split_at_bends(graph, config)
    _on_their_lines(graph, config)
    return graph


def middle_lines(graph: WayGraph, config: ExtractConfig) -> list[Array]:
    """Points (k, 2) [m] along all ways but those into corners; the graph that is given is used up."""
    _prune(graph, config)
    return [way.points for way in graph.ways]


def _prune(graph: WayGraph, config: ExtractConfig) -> None:
    _joined_through(graph)
    while _spurs_removed(graph, config):
        _joined_through(graph)


def _shorten_to_known(graph: WayGraph, config: ExtractConfig) -> None:
    """Side ways end where walls end: further on is what a ray through a window or a gap saw."""
    degree = graph.degrees()
    kept = []
    for way in graph.ways:
        if degree[way.start] > 1 and degree[way.end] > 1:
            kept.append(way)
            continue
        seen = way if degree[way.end] == 1 else way.turned()
        known = np.flatnonzero(seen.to_wall <= seen.clearance + _UNSEEN)
        share = len(known) / len(seen.points)
        if share < _KNOWN and degree[seen.start] > 1:
            continue
        kept.append(seen)
    graph.ways = kept
    _remove(graph, ())


def _spurs_removed(graph: WayGraph, config: ExtractConfig) -> bool:
    """Remove side ways that lead hardly out of the space that they leave; whether there were any."""
    degree = graph.degrees()
    at: dict[int, list[tuple[float, int]]] = {}
    for k, way in enumerate(graph.ways):
        for leaf, node in ((way.start, way.end), (way.end, way.start)):
            if degree[leaf] == 1 and degree[node] > 2:
                wide = graph.clearance[node]
                gain = way.length + graph.clearance[leaf] - wide
                if gain < max(config.spur_m, _INTO_CORNER * wide):
                    at.setdefault(node, []).append((gain, k))
    gone: set[int] = set()
    for node, spurs in at.items():
        spurs.sort()
        gone.update(k for _, k in spurs[: degree[node] - 1])
    _remove(graph, gone)
    return bool(gone)


def _remove(graph: WayGraph, gone: Iterable[int]) -> None:
    """Remove ways by number, and nodes that no way leads to any more."""
    lost = set(gone)
    graph.ways = [way for k, way in enumerate(graph.ways) if k not in lost]
    left = {node for way in graph.ways for node in (way.start, way.end)}
    graph.xy = {node: xy for node, xy in graph.xy.items() if node in left}
    graph.clearance = {node: c for node, c in graph.clearance.items() if node in left}


def _joined_through(graph: WayGraph) -> None:
    """Make one way of two that meet where no third one does."""
    at: dict[int, list[Way]] = {}
    for way in graph.ways:
        at.setdefault(way.start, []).append(way)
        at.setdefault(way.end, []).append(way)
    for node, ways in at.items():
        if len(ways) == 2 and ways[0] is not ways[1]:
            a, b = ways[0].from_node(node).turned(), ways[1].from_node(node)
            one = a.and_then(b)
            graph.ways = [way for way in graph.ways if way is not ways[0] and way is not ways[1]] + [one]
            for end in (one.start, one.end):
                at[end] = [w for w in at[end] if w is not ways[0] and w is not ways[1]] + [one]
            if one.start == one.end:
                at[one.start].append(one)
            at[node] = []
    _remove(graph, ())


def _one_contracted(graph: WayGraph, config: ExtractConfig) -> bool:
    """Make one place of the two junctions that lie nearest to each other within each other's space."""
    degree = graph.degrees()
    found = []
    for k, way in enumerate(graph.ways):
        wide = max(graph.clearance[way.start], graph.clearance[way.end])
        length = way.length
        if (
            way.start != way.end
            and min(degree[way.start], degree[way.end]) > 2
            and length < max(config.shortest_m, wide)
        ):
            found.append((length, k))
    if not found:
        return False
    way = graph.ways[min(found)[1]]
    a, b = way.start, way.end
    graph.xy[a] = (graph.xy[a] + graph.xy[b]) / 2
    graph.clearance[a] = max(graph.clearance[a], graph.clearance[b])
    graph.ways.remove(way)
    for other in graph.ways:
        if b in (other.start, other.end):
            other.start, other.end = (a if n == b else n for n in (other.start, other.end))
    for other in graph.ways:
        if a in (other.start, other.end):
            other.points = other.points.copy()
            other.points[[k for k, n in ((0, other.start), (-1, other.end)) if n == a]] = graph.xy[a]
            other.measure()
    _remove(graph, [k for k, w in enumerate(graph.ways) if w.start == w.end and w.length < 2 * graph.clearance[a]])
    return True


def _without_loops(graph: WayGraph) -> None:
    """Leave out ways around that lead back to where they began without a place on them, and doubles of short ways."""
    _remove(graph, [k for k, way in enumerate(graph.ways) if way.start == way.end and way.length < 4.0])


def _cut(graph: WayGraph, way: Way, places: Sequence[int]) -> list[Way]:
    """The pieces of a way between places along its points, each of which becomes a node."""
    nodes = [way.start]
    for place in places:
        nodes.append(max(graph.xy) + 1)
        graph.xy[nodes[-1]], graph.clearance[nodes[-1]] = way.points[place], float(way.clearance[place])
    nodes.append(way.end)
    at = [0, *places, len(way.points) - 1]
    return [way.part(a, b, m, n) for a, b, m, n in zip(at, at[1:], nodes, nodes[1:], strict=False)]


def _split_at_doors(graph: WayGraph, config: ExtractConfig) -> None:
    """Make nodes of the doorways."""
    ways = []
    for way in graph.ways:
        pieces = _cut(graph, way, _doorways(way, config))
        graph.doors.update(piece.start for piece in pieces[1:])
        ways += pieces
    graph.ways = ways


def _doorways(way: Way, config: ExtractConfig) -> list[int]:
    """Places along a way where it is as narrow as a door and wider on both sides."""
    steps = np.hypot(*np.diff(way.points, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    width = 2 * way.clearance
    found: list[int] = []
    narrow = (width >= config.door_narrowest_m) & (width <= config.door_widest_m)
    for k in np.flatnonzero(narrow).tolist():
        near = np.abs(along - along[k]) <= config.door_reach_m
        before, behind = width[near & (along < along[k])], width[near & (along > along[k])]
        if not len(before) or not len(behind) or width[k] > min(before.min(), behind.min()):
            continue
        opens = min(before.max(), behind.max()) * config.door_narrowing
        if width[k] <= opens and (not found or along[k] - along[found[-1]] > config.door_reach_m):
            same = np.flatnonzero(near & (width <= width[k] + 1e-9))
            found.append(int(same[len(same) // 2]))
    return found


def _split_at_bends(graph: WayGraph, config: ExtractConfig) -> None:
    """Split ways at their bends, so that each is straight."""
    graph.ways = [piece for way in graph.ways for piece in _cut(graph, way, _bends(way.points, config)[1:-1])]


def _bends(points: Array, config: ExtractConfig) -> list[int]:
    """Places along points (k, 2) where a line bends by more than it may, with the first and the last."""
    line = simplified(points, config.straight_m)
    if np.array_equal(points[0], points[-1]):
        return [0, len(points) // 3, 2 * len(points) // 3, len(points) - 1]
    cuts = [0]
    for vertex in line[1:-1]:
        off = np.hypot(*(points[cuts[-1] + 1 : -1] - vertex).T)
        cuts.append(cuts[-1] + 1 + int(np.argmin(off)))
    cuts.append(len(points) - 1)
    while len(cuts) > 2:
        at = points[cuts]
        steps = np.diff(at, axis=0)
        bearing = np.arctan2(steps[:, 1], steps[:, 0])
        turn = np.abs(np.angle(np.exp(1j * np.diff(bearing))))
        short = np.minimum(np.hypot(*steps[:-1].T), np.hypot(*steps[1:].T)) < config.shortest_m
        weight = np.where(short, 0.0, turn)
        k = int(np.argmin(weight))
        if weight[k] >= np.deg2rad(config.bend_deg):
            break
        del cuts[k + 1]
    return cuts


def _on_their_lines(graph: WayGraph, config: ExtractConfig) -> None:
    """Move each node to where the lines of its ways meet; near a place middle lines bend away from their corridor."""
    lines = {node: [line_of(way, graph.clearance[node]) for way in graph.at(node)] for node in graph.xy}
    for node, found in lines.items():
        wide = graph.clearance[node]
        slack = config.straight_m + wide / 2
        information, pull = np.eye(2) / slack**2, graph.xy[node] / slack**2
        for line in found:
            if line is not None and node not in graph.doors:
                point, normal = line
                weight = np.outer(normal, normal) / _LINE_SIGMA**2
                information = information + weight
                pull = pull + weight @ point
        moved = np.linalg.solve(information, pull)
        if np.hypot(*(moved - graph.xy[node])) <= max(config.shortest_m, wide):
            graph.xy[node] = np.asarray(moved, dtype=float)


def line_of(way: Way, wide: float) -> tuple[Array, Array] | None:
    """A point (2,) and the normal (2,) of a way's line beyond the space of its first node; None: it is too short."""
    from_start = np.hypot(*(way.points - way.points[0]).T)
    ours = way.points[(from_start >= wide) & (from_start <= wide + _LINE_LENGTH)]
    if len(ours) < 3 or np.hypot(*(ours[-1] - ours[0])) < _LINE_LENGTH / 3:
        return None
    middle = ours.mean(axis=0)
    return middle, np.linalg.svd(ours - middle)[2][1]
