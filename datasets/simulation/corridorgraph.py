"""Corridor lines as somebody drew them to a graph: snapped, split where they meet, straightened, in one piece."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..errors import TooLargeError
from .floors import SAME_ARM, bearing
from .raycast import clear, distances, nearest_points

Array = NDArray[np.float64]
Edge = tuple[int, int]

#: Line ends and vertices nearer than this [m] to each other or to a line meet there.
SNAP = 0.5
#: A line is straight as far as nothing of it is further off than this [m].
STRAIGHT = 0.3
#: Two places are at least this far apart [m]; what is nearer is one place.
SHORTEST = 1.0
#: A side way that ends nearer than this [m] to where it leaves is no corridor.
SPUR = 1.5
#: Straightening a way leaves it this far [m] from walls, or as near as it was.
CLEAR = 0.2
#: More straight pieces than this are refused: they are compared pair by pair.
MAX_PIECES = 3000


@dataclass(eq=False)
class _Graph:
    """Positions by node, and each node's neighbours; ``walls`` (n, 2, 2) that no edge may cross."""

    xy: dict[int, Array]
    walls: Array
    near: dict[int, set[int]] = field(default_factory=dict)

    def join(self, a: int, b: int) -> None:
        if a != b:
            self.near.setdefault(a, set()).add(b)
            self.near.setdefault(b, set()).add(a)

    def part(self, a: int, b: int) -> None:
        self.near[a].discard(b)
        self.near[b].discard(a)

    def remove(self, node: int) -> None:
        for other in self.near.pop(node, set()):
            self.near[other].discard(node)

    def edges(self) -> list[Edge]:
        return sorted((a, b) for a, others in self.near.items() for b in others if a < b)

    def length(self, a: int, b: int) -> float:
        return float(np.hypot(*(self.xy[a] - self.xy[b])))

    def room(self, a: int, b: int) -> float:
        """Distance [m] from the edge between two nodes to the nearest wall that it doesn't cross."""
        if not len(self.walls):
            return np.inf
        edge = np.array([[self.xy[a], self.xy[b]]])
        of_walls = distances(self.walls.reshape(-1, 2), edge).min()
        return float(min(of_walls, distances(edge[0], self.walls).min()))

    def passable(self, a: int, b: int) -> bool:
        return bool(clear(self.xy[a], self.xy[b][None], self.walls)[0]) if len(self.walls) else True


def corridor_graph(lines: Iterable[Array], walls: Array) -> tuple[list[tuple[float, float]], list[Edge]]:
    """Nodes [m] and straight edges of corridor ``lines``, each (k, 2) [m]; ``walls`` (n, 2, 2) [m], possibly none.

    Lines are split where they meet, cross or end within `SNAP` of each other. What leads through a wall is left out,
    then all but the largest connected part (by length); short side ways go, bends become corners, and near-parallel
    ways out of a place are laid on each other. Raises `TooLargeError` above `MAX_PIECES` straight pieces.

    >>> corridor_graph([np.array([[0, 0], [9, 0]]), np.array([[4, 0.2], [4, 6]])], np.zeros((0, 2, 2)))[1]
    [(0, 2), (1, 2), (2, 3)]
    """
    pieces = [np.array(ends) for line in lines for ends in pairwise(simplified(line, STRAIGHT / 3))]
    if not pieces:
        return [], []
    if len(pieces) > MAX_PIECES:
        raise TooLargeError(f"{len(pieces):,} straight pieces of corridor; at most {MAX_PIECES:,} are read")
    graph = _noded(np.array(pieces), walls)
    for a, b in graph.edges():
        if not graph.passable(a, b):
            graph.part(a, b)
    _keep_largest_part(graph)
    # each step takes a node or an edge away, or makes the edges shorter
    for _ in range(20 * len(pieces) + 100):
        if not (_without_spur(graph) or _contracted(graph) or _straightened(graph) or _folded(graph)):
            break
    used = sorted(node for node, others in graph.near.items() if others)
    number = {node: k for k, node in enumerate(used)}
    nodes = [(float(graph.xy[node][0]), float(graph.xy[node][1])) for node in used]
    return nodes, [(number[a], number[b]) for a, b in graph.edges()]


def simplified(line: Array, tolerance: float) -> Array:
    """The fewest vertices of a line (k, 2) that keep it within ``tolerance`` [m] (Douglas and Peucker).

    >>> simplified(np.array([[0, 0], [2, 0.05], [4, 0], [4, 3]]), 0.1).tolist()
    [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]
    """
    line = np.asarray(line, dtype=float)
    kept, todo = {0, len(line) - 1}, [(0, len(line) - 1)]
    while todo:
        first, last = todo.pop()
        if last - first < 2:
            continue
        off = line[first + 1 : last] - nearest_points(line[first + 1 : last], line[None, [first, last]])[:, 0]
        furthest = int(np.argmax(np.hypot(off[:, 0], off[:, 1])))
        if np.hypot(*off[furthest]) > tolerance:
            middle = first + 1 + furthest
            kept.add(middle)
            todo += [(first, middle), (middle, last)]
    return line[sorted(kept)]


def _noded(pieces: Array, walls: Array) -> _Graph:
    """Straight pieces (n, 2, 2) split wherever they meet, their ends snapped together."""
    pieces = _ends_on_lines(pieces)
    start, along = pieces[:, 0], pieces[:, 1] - pieces[:, 0]
    length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-12)
    cuts: list[list[float]] = [[0.0, 1.0] for _ in pieces]
    ends = pieces.reshape(-1, 2)
    for k in range(len(pieces)):
        foot = nearest_points(ends, pieces[k : k + 1])[:, 0]
        touching = np.hypot(*(ends - foot).T) <= SNAP
        cuts[k] += list(((foot[touching] - start[k]) @ along[k]) / length[k] ** 2)
        cross = along[k, 0] * along[:, 1] - along[k, 1] * along[:, 0]
        safe = np.where(np.abs(cross) < 1e-12, np.inf, cross)
        away = start - start[k]
        t = (away[:, 0] * along[:, 1] - away[:, 1] * along[:, 0]) / safe
        u = (away[:, 0] * along[k, 1] - away[:, 1] * along[k, 0]) / safe
        cuts[k] += list(t[np.isfinite(safe) & (t > 0) & (t < 1) & (u > 0) & (u < 1)])
    centres: list[Array] = []
    graph = _Graph({}, walls)
    # ends come first, so that places stand where lines end rather than where others pass them
    node_of_end = [_snapped(end, centres) for end in ends]
    for k, shares in enumerate(cuts):
        inner = [s for s in sorted(shares) if min(s, 1 - s) * length[k] > SNAP / 2]
        way = [node_of_end[2 * k], *(_snapped(start[k] + s * along[k], centres) for s in inner), node_of_end[2 * k + 1]]
        for a, b in pairwise(way):
            graph.join(a, b)
    graph.xy.update(enumerate(centres))
    return graph


def _ends_on_lines(pieces: Array) -> Array:
    """The pieces with ends moved to the line within `SNAP` that they stop at, away from that line's own ends."""
    ends = pieces.reshape(-1, 2).copy()
    for k, end in enumerate(pieces.reshape(-1, 2)):
        foot = nearest_points(end[None], pieces)[0]
        off = np.hypot(*(foot - end).T)
        from_ends = np.hypot(*np.moveaxis(foot[:, None] - pieces, -1, 0)).min(axis=1)
        off[(from_ends <= SNAP) | (off > SNAP)] = np.inf
        if np.isfinite(off).any():
            ends[k] = foot[np.argmin(off)]
    return np.asarray(ends.reshape(-1, 2, 2), dtype=float)


def _snapped(point: Array, centres: list[Array]) -> int:
    """Number of the first centre within `SNAP`; the point becomes a new one where there is none."""
    if centres:
        off = np.asarray(centres) - point
        near = np.flatnonzero(np.hypot(off[:, 0], off[:, 1]) <= SNAP)
        if len(near):
            return int(near[np.argmin(np.hypot(*off[near].T))])
    centres.append(np.asarray(point, dtype=float))
    return len(centres) - 1


def _keep_largest_part(graph: _Graph) -> None:
    """Drop what isn't connected with the part that has most corridor."""
    parts: list[set[int]] = []
    seen = set[int]()
    for node in sorted(graph.near):
        if node not in seen:
            part, todo = set[int](), [node]
            while todo:
                here = todo.pop()
                if here not in part:
                    part.add(here)
                    todo += graph.near[here]
            seen |= part
            parts.append(part)
    best = max(parts, key=lambda part: sum(graph.length(a, b) for a in part for b in graph.near[a]))
    for node in sorted(seen - best):
        graph.remove(node)


def _without_spur(graph: _Graph) -> bool:
    for node in sorted(graph.near):
        if len(graph.near[node]) == 1:
            (other,) = graph.near[node]
            if len(graph.near[other]) >= 3 and graph.length(node, other) < SPUR:
                graph.remove(node)
                return True
    return False


def _contracted(graph: _Graph) -> bool:
    """Make one node of the two that are nearest to each other.

    It stands where the busier one stood; of a bend that was cut off, where the ways to it meet.
    """
    short = [(graph.length(a, b), a, b) for a, b in graph.edges()]
    if not short or min(short)[0] >= SHORTEST or len(short) == 1:
        return False
    _, a, b = min(short)
    kept, gone = (a, b) if len(graph.near[a]) >= len(graph.near[b]) else (b, a)
    others = graph.near[gone] - {kept}
    if len(graph.near[a]) == len(graph.near[b]) == 2 and len(graph.near[a] & graph.near[b]) == 0:
        (before,), (behind,) = graph.near[a] - {b}, graph.near[b] - {a}
        graph.xy[kept] = _meeting(graph.xy[before], graph.xy[a], graph.xy[b], graph.xy[behind])
    graph.remove(gone)
    for other in others:
        graph.join(kept, other)
    return True


def _meeting(before: Array, a: Array, b: Array, behind: Array) -> Array:
    """Where the ways from ``before`` by ``a`` and from ``behind`` by ``b`` meet; the middle where that is far off."""
    ahead, back = a - before, b - behind
    cross = ahead[0] * back[1] - ahead[1] * back[0]
    middle = (a + b) / 2
    if abs(cross) < np.sin(SAME_ARM) * np.hypot(*ahead) * np.hypot(*back):
        return np.asarray(middle)
    away = behind - before
    meeting = before + (away[0] * back[1] - away[1] * back[0]) / cross * ahead
    return np.asarray(meeting if np.hypot(*(meeting - middle)) <= SHORTEST else middle)


def _straightened(graph: _Graph) -> bool:
    """Leave out a bend that is hardly one."""
    for node in sorted(graph.near):
        if len(graph.near[node]) == 2:
            a, b = sorted(graph.near[node])
            line = np.array([[graph.xy[a], graph.xy[b]]])
            off = float(np.hypot(*(graph.xy[node] - nearest_points(graph.xy[node][None], line)[0, 0])))
            turn = abs(float(se2.wrap(bearing(graph.xy[a], graph.xy[node]) - bearing(graph.xy[node], graph.xy[b]))))
            slight = off <= STRAIGHT or (turn < SAME_ARM and off <= 3 * STRAIGHT)
            if not slight or turn >= np.pi / 2 or b in graph.near[a]:
                continue
            enough = min(CLEAR, graph.room(a, node), graph.room(node, b))
            if graph.passable(a, b) and graph.room(a, b) >= enough - 1e-9:
                graph.remove(node)
                graph.join(a, b)
                return True
    return False


def _folded(graph: _Graph) -> bool:
    """Where two ways leave a node in one direction, let the longer one begin at the end of the shorter one."""
    for node in sorted(graph.near):
        ways = sorted(graph.near[node], key=lambda other: (bearing(graph.xy[node], graph.xy[other]), other))
        for a, b in zip(ways, [*ways[1:], *ways[:1]], strict=True):
            gap = bearing(graph.xy[node], graph.xy[a]) - bearing(graph.xy[node], graph.xy[b])
            if a != b and abs(float(se2.wrap(gap))) < SAME_ARM:
                short, long = sorted((a, b), key=lambda other: (graph.length(node, other), other))
                graph.part(node, long)
                graph.join(short, long)
                return True
    return False


def chains(edges: Sequence[Edge]) -> list[list[int]]:
    """The edges as runs of nodes between those where more or fewer than two meet, and loops without such a node.

    >>> chains([(0, 1), (1, 2), (2, 3), (2, 4)])
    [[0, 1, 2], [2, 3], [2, 4]]
    """
    near: dict[int, set[int]] = {}
    for a, b in edges:
        near.setdefault(a, set()).add(b)
        near.setdefault(b, set()).add(a)
    left = {(min(e), max(e)) for e in edges}
    found = []
    stops = [node for node in sorted(near) if len(near[node]) != 2]
    for start in [*stops, *sorted(near)]:
        for first in sorted(near[start]):
            if (min(start, first), max(start, first)) not in left:
                continue
            run = [start]
            there: int | None = first
            while there is not None:
                left.discard((min(run[-1], there), max(run[-1], there)))
                run.append(there)
                ahead = [n for n in near[there] if (min(n, there), max(n, there)) in left]
                there = ahead[0] if len(near[there]) == 2 and ahead else None
            found.append(run)
    return found
