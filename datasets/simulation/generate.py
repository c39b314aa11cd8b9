"""Floors by kind, from a seed: irregular, oblique, alike (one pitch), symmetric ones, and ones with wings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError
from .floors import DoorAt, Floor, bearing, floor_from_graph

Array = NDArray[np.float64]
Edge = tuple[int, int]
FloorKind = Literal["irregular", "oblique", "alike", "symmetric", "wings"]

#: Doors keep this distance [m] from nodes and from each other.
DOOR_SPACING = 2.5
#: How many corners, ends and junctions, and how many doors a floor has.
NODES, DOORS = (12, 25), (8, 20)
#: How many loops and culs-de-sac a floor of so few places can be asked to have at least; both at most take seconds.
MOST = (3, 4)


def irregular_floor(
    rng: np.random.Generator,
    name: str = "irregular",
    *,
    oblique: bool = False,
    loops: int = 0,
    culs_de_sac: int = 0,
) -> Floor:
    """Right-angled corridors of irregular spacing with loops and culs-de-sac; doors at irregular places.

    12 to 25 corners, ends and junctions, 8 to 20 doors, 40 to 80 m wide. With ``oblique`` the two families of
    corridors meet at 50 to 70 degrees instead. ``loops``, ``culs_de_sac``: how many there are at least; floors are
    drawn until one has so many. Raises `ConfigError` for more than `MOST` of either.

    >>> floor = irregular_floor(np.random.default_rng(3))
    >>> 12 <= sum(p.type != "door" for p in floor.places) <= 25
    True
    """
    _check("loops", loops, 0, MOST[0])
    _check("culs_de_sac", culs_de_sac, 0, MOST[1])
    while True:
        columns, rows = int(rng.integers(4, 7)), int(rng.integers(3, 5))
        xs, ys = _lines(rng, columns, rng.uniform(40, 80)), _lines(rng, rows, rng.uniform(24, 50))
        nodes = [(float(x), float(y)) for y in ys for x in xs]
        kept = _thinned(rng, _lattice(columns, rows), rng.uniform(0.55, 0.8), mirrored=None)
        if oblique:
            shear = 1 / np.tan(rng.uniform(np.deg2rad(50), np.deg2rad(70)))
            nodes = [(float(x + y * shear), y) for x, y in nodes]
        edges = _straightened(nodes, kept)
        doors = _irregular_doors(rng, nodes, edges, int(rng.integers(DOORS[0], DOORS[1] + 1)))
        if _in_range(edges, len(doors)) and _loops(edges) >= loops and len(_ends(edges)) >= culs_de_sac:
            return floor_from_graph(name, nodes, edges, doors, _north(rng))


def alike_floor(rng: np.random.Generator, name: str = "alike", *, pitch: float = 10.0) -> Floor:
    """Corridors of one ``pitch`` [m] with doors at the same place after each junction: hard to tell apart.

    Which corridors are there and which doors are closed differs from floor to floor.
    """
    while True:
        columns, rows = int(rng.integers(4, 7)), int(rng.integers(3, 5))
        nodes = [(pitch * i, pitch * j) for j in range(rows) for i in range(columns)]
        kept = _thinned(rng, _lattice(columns, rows), rng.uniform(0.6, 0.85), mirrored=None)
        doors_of_step = [DoorAt(a, b, 0.35 * pitch, 1) for a, b in kept if rng.random() < 0.6]
        edges = _straightened(nodes, kept)
        doors = [_on_edge(nodes, edges, door) for door in doors_of_step]
        if _in_range(edges, len(doors)):
            return floor_from_graph(name, nodes, edges, doors, _north(rng))


def symmetric_floor(rng: np.random.Generator, name: str = "symmetric") -> Floor:
    """A floor that looks the same turned by 180 degrees about the origin; otherwise irregular."""
    while True:
        columns, rows = int(rng.integers(4, 7)), int(rng.integers(3, 5))
        xs, ys = (
            _palindrome(_lines(rng, columns, rng.uniform(40, 80))),
            _palindrome(_lines(rng, rows, rng.uniform(24, 50))),
        )
        nodes = [(float(x), float(y)) for y in ys for x in xs]
        last = len(nodes) - 1
        kept = _thinned(rng, _lattice(columns, rows), rng.uniform(0.6, 0.8), mirrored=last)
        edges = _straightened(nodes, kept)
        doors = _symmetric_doors(rng, nodes, edges, int(rng.integers(DOORS[0], DOORS[1] + 1)) // 2)
        if _in_range(edges, len(doors)):
            return floor_from_graph(name, nodes, edges, doors, _north(rng))


def oblique_floor(rng: np.random.Generator, name: str = "oblique") -> Floor:
    """`irregular_floor` with corridors that don't meet at right angles."""
    return irregular_floor(rng, name, oblique=True)


def wings_floor(rng: np.random.Generator, name: str = "wings", *, wings: int | None = None) -> Floor:
    """Two or three blocks of right-angled corridors, each with a loop, in a row; one corridor joins each to the next.

    ``wings``: how many blocks; None: drawn. A robot can go from one block to the next by that corridor alone, so that
    maps of different blocks have little in common. Raises `ConfigError` for another number than 2 or 3.

    >>> floor = wings_floor(np.random.default_rng(0), wings=3)
    >>> 12 <= sum(p.type != "door" for p in floor.places) <= 25
    True
    """
    _check("wings", 2 if wings is None else wings, 2, 3)
    while True:
        count = int(rng.integers(2, 4)) if wings is None else wings
        nodes: list[tuple[float, float]] = []
        kept: list[Edge] = []
        exits: list[tuple[int, int]] = []
        for _ in range(count):
            block, edges = _block(rng, columns=int(rng.integers(2, 4 if count > 2 else 5)))
            first = len(nodes)
            # the way in from the block before stands level with the way out of that
            west, east = (int(rng.choice(side)) for side in _sides(block, edges))
            away = (0.0, 0.0) if not exits else _beside(nodes, exits[-1][1], block, west, rng.uniform(8, 16))
            nodes += [(x + away[0], y + away[1]) for x, y in block]
            kept += [(a + first, b + first) for a, b in edges]
            exits.append((west + first, east + first))
        joints = [(before[1], after[0]) for before, after in pairwise(exits)]
        edges = _straightened(nodes, kept + joints)
        doors = _irregular_doors(rng, nodes, edges, int(rng.integers(DOORS[0], DOORS[1] + 1)))
        if _in_range(edges, len(doors)):
            return floor_from_graph(name, nodes, edges, doors, _north(rng))


GENERATORS: dict[FloorKind, Callable[[np.random.Generator, str], Floor]] = {
    "irregular": irregular_floor,
    "oblique": oblique_floor,
    "alike": alike_floor,
    "symmetric": symmetric_floor,
    "wings": wings_floor,
}


def make_floor(kind: FloorKind, rng: np.random.Generator, name: str | None = None) -> Floor:
    """A floor of that kind; KeyError for a kind that doesn't exist."""
    return GENERATORS[kind](rng, name or kind)


def _north(rng: np.random.Generator) -> float:
    return float(rng.uniform(-np.pi, np.pi))


def _lines(rng: np.random.Generator, count: int, extent: float) -> Array:
    """``count`` coordinates [m] over ``extent`` with irregular gaps, none below 5 m."""
    share = rng.dirichlet(np.full(count - 1, 3.0))
    gaps = 5.0 + share * (extent - 5.0 * (count - 1))
    return np.concatenate([[0.0], np.cumsum(gaps)])


def _palindrome(lines: Array) -> Array:
    """The nearest coordinates that are symmetric about 0."""
    centred = lines - (lines[0] + lines[-1]) / 2
    return np.asarray((centred - centred[::-1]) / 2, dtype=float)


def _lattice(columns: int, rows: int) -> list[Edge]:
    along = [(r * columns + c, r * columns + c + 1) for r in range(rows) for c in range(columns - 1)]
    across = [(r * columns + c, (r + 1) * columns + c) for r in range(rows - 1) for c in range(columns)]
    return along + across


def _connected(edges: Sequence[Edge]) -> bool:
    nodes = {n for e in edges for n in e}
    reached, todo = set[int](), [min(nodes)]
    while todo:
        node = todo.pop()
        if node not in reached:
            reached.add(node)
            todo += [b if a == node else a for a, b in edges if node in (a, b)]
    return reached == nodes


def _check(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise ConfigError(f"{name} of a floor must be from {least} to {most}, not {value}")


def _loops(edges: Sequence[Edge]) -> int:
    """Independent loops of connected edges: how many could go before they fall apart."""
    return len(edges) - len({n for e in edges for n in e}) + 1


def _ends(edges: Sequence[Edge]) -> list[int]:
    """Nodes that only one edge leads to."""
    used = [n for e in edges for n in e]
    return [n for n in sorted(set(used)) if used.count(n) == 1]


def _block(rng: np.random.Generator, columns: int) -> tuple[list[tuple[float, float]], list[Edge]]:
    """Nodes [m] and edges of one wing's block of right-angled corridors, with a loop at least."""
    rows = int(rng.integers(2, 4))
    xs, ys = _lines(rng, columns, 9.0 * (columns - 1)), _lines(rng, rows, rng.uniform(8, 12) * (rows - 1))
    nodes = [(float(x), float(y)) for y in ys for x in xs]
    while True:
        edges = _thinned(rng, _lattice(columns, rows), rng.uniform(0.7, 1.2), mirrored=None)
        if _loops(edges) >= 1:
            return nodes, edges


def _sides(nodes: Sequence[tuple[float, float]], edges: Sequence[Edge]) -> tuple[list[int], list[int]]:
    """The nodes in use that stand furthest West, and those furthest East."""
    used = sorted({n for e in edges for n in e})
    xs = [nodes[n][0] for n in used]
    return [n for n in used if nodes[n][0] == min(xs)], [n for n in used if nodes[n][0] == max(xs)]


def _beside(
    nodes: Sequence[tuple[float, float]], gate: int, block: Sequence[tuple[float, float]], entry: int, gap: float
) -> tuple[float, float]:
    """Where a block goes so that its ``entry`` is ``gap`` [m] East of the node ``gate``."""
    return nodes[gate][0] + gap - block[entry][0], nodes[gate][1] - block[entry][1]


def _thinned(rng: np.random.Generator, edges: list[Edge], share: float, mirrored: int | None) -> list[Edge]:
    """About ``share`` of the edges, connected; with ``mirrored`` (the last node's number) in symmetric pairs."""
    kept, wanted = list(edges), share * len(edges)
    for k in rng.permutation(len(edges)):
        gone = {edges[k]}
        if mirrored is not None:
            a, b = edges[k]
            gone.add((mirrored - b, mirrored - a))
        rest = [e for e in kept if e not in gone]
        if len(kept) > wanted and rest and _connected(rest):
            kept = rest
    return kept


def _straightened(nodes: Sequence[tuple[float, float]], edges: Sequence[Edge]) -> list[Edge]:
    """Corridors: edges joined where two go straight through a node that has no third."""
    joined = [tuple(sorted(e)) for e in edges]
    for node in range(len(nodes)):
        ways = [b if a == node else a for a, b in joined if node in (a, b)]
        if len(ways) == 2:
            turn = bearing(nodes[ways[0]], nodes[node]) - bearing(nodes[node], nodes[ways[1]])
            if np.cos(turn) > 1 - 1e-9:
                joined = [e for e in joined if node not in e] + [tuple(sorted(ways))]
    return sorted((a, b) for a, b in joined)


def _in_range(edges: Sequence[Edge], doors: int) -> bool:
    nodes = len({n for e in edges for n in e})
    return NODES[0] <= nodes <= NODES[1] and DOORS[0] <= doors <= DOORS[1]


def _length(nodes: Sequence[tuple[float, float]], edge: Edge) -> float:
    return float(np.hypot(*np.subtract(nodes[edge[1]], nodes[edge[0]])))


def _irregular_doors(
    rng: np.random.Generator, nodes: Sequence[tuple[float, float]], edges: Sequence[Edge], count: int
) -> list[DoorAt]:
    """Doors anywhere along the corridors, none closer than `DOOR_SPACING` to another place of its corridor."""
    lengths = np.array([_length(nodes, e) for e in edges])
    taken: dict[Edge, list[float]] = {e: [0.0, float(l)] for e, l in zip(edges, lengths, strict=True)}
    doors: list[DoorAt] = []
    for _ in range(50 * count):
        edge = edges[int(rng.choice(len(edges), p=lengths / lengths.sum()))]
        along = float(rng.uniform(0, _length(nodes, edge)))
        if len(doors) < count and min(abs(along - other) for other in taken[edge]) >= DOOR_SPACING:
            taken[edge].append(along)
            doors.append(DoorAt(*edge, along, int(rng.choice([-1, 1]))))
    return doors


def _symmetric_doors(
    rng: np.random.Generator, nodes: Sequence[tuple[float, float]], edges: Sequence[Edge], count: int
) -> list[DoorAt]:
    """Doors in pairs that a half turn swaps: along the mirrored corridor, measured from its other end."""
    last = len(nodes) - 1
    doors: list[DoorAt] = []
    for door in _irregular_doors(rng, nodes, edges, count):
        twin = DoorAt(last - door.start, last - door.end, door.along, door.side)
        length = _length(nodes, (door.start, door.end))
        same = (twin.start, twin.end) == (door.end, door.start)
        middle = same and abs(2 * door.along - length) < DOOR_SPACING
        clear = all(_gap(nodes, known, new) >= DOOR_SPACING for known in doors for new in (door, twin))
        if clear and not middle:
            doors += [door, twin]
    return doors


def _gap(nodes: Sequence[tuple[float, float]], a: DoorAt, b: DoorAt) -> float:
    return float(np.hypot(*(_spot(nodes, a) - _spot(nodes, b))))


def _spot(nodes: Sequence[tuple[float, float]], door: DoorAt) -> Array:
    direction = bearing(nodes[door.start], nodes[door.end])
    return np.array(nodes[door.start]) + door.along * np.array([np.cos(direction), np.sin(direction)])


def _on_edge(nodes: Sequence[tuple[float, float]], edges: Sequence[Edge], door: DoorAt) -> DoorAt:
    """The same door measured along the joined corridor that its lattice step became part of."""
    spot, direction = _spot(nodes, door), bearing(nodes[door.start], nodes[door.end])
    for a, b in edges:
        start, length = np.array(nodes[a]), _length(nodes, (a, b))
        along = float(np.hypot(*(spot - start)))
        on_it = along < length and abs(np.sin(bearing(start, spot) - bearing(start, nodes[b]))) < 1e-9
        if on_it and np.cos(bearing(start, spot) - bearing(start, nodes[b])) > 0:
            same_way = np.cos(direction - bearing(start, nodes[b])) > 0
            return DoorAt(a, b, along, door.side if same_way else -door.side)
    raise AssertionError("a door's step is part of a corridor")
