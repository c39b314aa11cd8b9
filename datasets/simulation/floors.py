"""`Floor`: true places, their arms, and the corridors between them, in world coordinates.

The generators that make floors by kind are in `generate`; what a robot records of one is in `record`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se2
from ..maps import LinkType

Array = NDArray[np.float64]

#: Directions [rad] closer than this are the same arm of a place.
SAME_ARM = np.deg2rad(20.0)


@dataclass(frozen=True, slots=True)
class Arm:
    """One direction [rad, world] in which a place is open, blocked or has a door."""

    direction: float
    type: LinkType


@dataclass(frozen=True, slots=True)
class Place:
    """A true landmark: ``type`` corner (also the end of a corridor), junction or door; x, y [m, world]."""

    id: str
    type: str
    x: float
    y: float
    arms: tuple[Arm, ...]

    @property
    def xy(self) -> Array:
        """Position (2,) [m, world]."""
        return np.array([self.x, self.y])

    def arm_towards(self, direction: float) -> int | None:
        """Index of the arm that points along ``direction`` [rad, world]; None where there is none."""
        off = [abs(float(se2.wrap(arm.direction - direction))) for arm in self.arms]
        return int(np.argmin(off)) if off and min(off) < SAME_ARM else None


@dataclass(frozen=True, slots=True)
class Corridor:
    """A straight corridor: ids of all places on it in order; the first and the last are its ends."""

    places: tuple[str, ...]


@dataclass(frozen=True)
class Floor:
    """What is really there. ``north`` [rad]: direction of magnetic north in the world; ``width`` [m] of corridors.

    >>> floor = floor_from_graph("L", [(0, 0), (8, 0), (8, 6)], [(0, 1), (1, 2)])
    >>> [place.type for place in floor.places]
    ['corner', 'corner', 'corner']
    >>> sorted(floor.neighbours["p1"])
    ['p0', 'p2']
    """

    name: str
    places: tuple[Place, ...]
    corridors: tuple[Corridor, ...]
    north: float = 0.0
    width: float = 2.0

    @cached_property
    def place_from_id(self) -> Mapping[str, Place]:
        """Places by id."""
        return {place.id: place for place in self.places}

    @cached_property
    def positions(self) -> Array:
        """Positions (n, 2) [m, world] of all places, in order."""
        return np.array([(p.x, p.y) for p in self.places], dtype=float).reshape(-1, 2)

    @cached_property
    def neighbours(self) -> Mapping[str, tuple[str, ...]]:
        """Places next to each place along the corridors."""
        found: dict[str, list[str]] = {place.id: [] for place in self.places}
        for corridor in self.corridors:
            for a, b in pairwise(corridor.places):
                found[a].append(b)
                found[b].append(a)
        return {identifier: tuple(near) for identifier, near in found.items()}

    def distance(self, a: str, b: str) -> float:
        """Straight distance [m] between two places."""
        return float(np.hypot(*(self.place_from_id[a].xy - self.place_from_id[b].xy)))

    @cached_property
    def length(self) -> float:
        """Total length [m] of all corridors."""
        return sum(self.distance(c.places[0], c.places[-1]) for c in self.corridors)

    def isolation(self, identifier: str) -> float:
        """Distance [m] from a place to the nearest other one."""
        others = [self.distance(identifier, place.id) for place in self.places if place.id != identifier]
        return min(others, default=np.inf)

    def moved(self, pose: ArrayLike, prefix: str = "") -> Floor:
        """The same floor elsewhere: its world coordinates moved by ``pose`` (3,), ids prefixed."""
        turn = float(np.asarray(pose, dtype=float)[2])
        xy = se2.transform(pose, self.positions)
        places = tuple(
            Place(prefix + p.id, p.type, float(x), float(y), _turned(p.arms, turn))
            for p, (x, y) in zip(self.places, xy, strict=True)
        )
        corridors = tuple(Corridor(tuple(prefix + i for i in c.places)) for c in self.corridors)
        return replace(self, places=places, corridors=corridors, north=float(se2.wrap(self.north + turn)))


def _turned(arms: Iterable[Arm], turn: float) -> tuple[Arm, ...]:
    return tuple(Arm(float(se2.wrap(arm.direction + turn)), arm.type) for arm in arms)


def bearing(start: ArrayLike, end: ArrayLike) -> float:
    """Direction [rad] from one point to another."""
    x, y = np.asarray(end, dtype=float) - np.asarray(start, dtype=float)
    return float(np.arctan2(y, x))


def node_arms(open_directions: Sequence[float]) -> tuple[Arm, ...]:
    """Up to four arms of a corner, end or junction: the corridors are open, where none goes on it is blocked.

    Blocked are the directions opposite to corridors, and square to them, that no other arm takes.
    """
    arms = [Arm(float(se2.wrap(d)), "open") for d in open_directions]
    for turn in (np.pi, np.pi / 2, -np.pi / 2):
        for direction in open_directions:
            wall = float(se2.wrap(direction + turn))
            free = all(abs(se2.wrap(wall - arm.direction)) > np.pi / 4 - 1e-9 for arm in arms)
            if free and len(arms) < 4:
                arms.append(Arm(wall, "blocked"))
    return tuple(arms)


def corridor_arms(direction: float, side: int, side_type: LinkType) -> tuple[Arm, ...]:
    """Arms of a landmark on a straight corridor: open both ways, ``side`` (+1 left, -1 right) of ``side_type``."""
    lateral = direction + side * np.pi / 2
    turns: tuple[tuple[float, LinkType], ...] = (
        (direction, "open"),
        (direction + np.pi, "open"),
        (lateral, side_type),
        (lateral + np.pi, "blocked"),
    )
    return tuple(Arm(float(se2.wrap(d)), kind) for d, kind in turns)


@dataclass(frozen=True, slots=True)
class DoorAt:
    """A door on the corridor line from node ``start`` towards node ``end``: ``along`` [m] from the start, ``side``."""

    start: int
    end: int
    along: float
    side: int


def floor_from_graph(
    name: str,
    nodes: Sequence[tuple[float, float]],
    edges: Iterable[tuple[int, int]],
    doors: Iterable[DoorAt] = (),
    north: float = 0.0,
) -> Floor:
    """A floor of ``nodes`` [m, world], straight corridors between them and doors on those.

    A node's type follows from its corridors: one or two make a corner, three or more a junction.
    """
    edges = [(min(e), max(e)) for e in edges]
    used = sorted({node for edge in edges for node in edge})
    id_from_node = {node: f"p{k}" for k, node in enumerate(used)}
    places = []
    for node in used:
        ways = [b if a == node else a for a, b in edges if node in (a, b)]
        directions = sorted(bearing(nodes[node], nodes[other]) for other in ways)
        x, y = nodes[node]
        kind = "corner" if len(ways) <= 2 else "junction"
        places.append(Place(id_from_node[node], kind, float(x), float(y), node_arms(directions)))
    on_edge: dict[tuple[int, int], list[tuple[float, str]]] = {edge: [] for edge in edges}
    for k, door in enumerate(doors):
        start, end = np.array(nodes[door.start]), np.array(nodes[door.end])
        direction, length = bearing(start, end), float(np.hypot(*(end - start)))
        spot = start + door.along * np.array([np.cos(direction), np.sin(direction)])
        arms = corridor_arms(direction, door.side, "door")
        places.append(Place(f"d{k}", "door", float(spot[0]), float(spot[1]), arms))
        along = door.along if door.start < door.end else length - door.along
        on_edge[min(door.start, door.end), max(door.start, door.end)].append((along, f"d{k}"))
    corridors = tuple(
        Corridor((id_from_node[a], *(identifier for _, identifier in sorted(on_edge[a, b])), id_from_node[b]))
        for a, b in edges
    )
    return Floor(name, tuple(places), corridors, north)
