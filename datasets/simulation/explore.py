"""`Route`: a robot's walk along the corridors, preferring those it doesn't know, stopped at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import MapfuseError
from ..values import frozen_array
from .floors import Floor

Array = NDArray[np.float64]
Step = tuple[str, str]

#: The robot starts within these distances [m] of a place that has no other one within `START_CLEARANCE` [m], so
#: that the landmark nearest to the start is the same one in truth and in the recorded map.
START_DISTANCE = (0.3, 0.8)
START_CLEARANCE = 4.0


class SimulationError(MapfuseError):
    """What was asked for can't be simulated; the text says why."""


@dataclass(frozen=True, eq=False, slots=True)
class Route:
    """Ids of the places passed, in order, each next to the one before; ``start`` (3,): first pose [m, rad, world]."""

    places: tuple[str, ...]
    start: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", frozen_array(self.start))


def start_places(floor: Floor) -> list[str]:
    """Places that a route may start at: those with no other place within `START_CLEARANCE`."""
    return [place.id for place in floor.places if floor.isolation(place.id) >= START_CLEARANCE]


def explore(floor: Floor, rng: np.random.Generator, share: float = 1.0, start: str | None = None) -> Route:
    """A walk from ``start`` (default: a random one of `start_places`) until ``share`` of the corridors is known.

    At each place an unexplored way is taken at random; where there is none, the shortest way to the nearest place
    that has one. ``share`` is of the corridors' total length; the first pose's heading is random.

    Raises `SimulationError` where the floor has no place to start at.

    >>> from mapfuse.datasets.simulation import irregular_floor
    >>> rng = np.random.default_rng(0)
    >>> floor = irregular_floor(rng)
    >>> set(explore(floor, rng).places) == set(floor.place_from_id)
    True
    """
    starts = start_places(floor) if start is None else [start]
    if not starts:
        raise SimulationError(f"{floor.name!r} has no place without another one within {START_CLEARANCE} m to start at")
    at = str(rng.choice(starts))
    place = floor.place_from_id[at]
    off, distance = rng.uniform(-np.pi, np.pi), rng.uniform(*START_DISTANCE)
    pose = np.array(
        [
            place.x + distance * np.cos(off),
            place.y + distance * np.sin(off),
            rng.uniform(-np.pi, np.pi),
        ]
    )
    walk, known, length = [at], set[Step](), 0.0
    while length < share * floor.length - 1e-9:
        leads = [there for there in floor.neighbours[walk[-1]] if step(walk[-1], there) not in known]
        way = [str(rng.choice(leads))] if leads else way_to_unknown(floor, walk[-1], known)
        for there in way:
            if step(walk[-1], there) not in known:
                known.add(step(walk[-1], there))
                length += floor.distance(walk[-1], there)
            walk.append(there)
    return Route(tuple(walk), pose)


def step(a: str, b: str) -> Step:
    """The stretch of corridor between two neighbouring places, whichever way it is walked."""
    return (a, b) if a < b else (b, a)


def way_to_unknown(floor: Floor, start: str, known: set[Step]) -> list[str]:
    """Shortest way (Dijkstra) to a place with an unexplored way, without its start."""
    distance, before = {start: 0.0}, dict[str, str]()
    todo = {start}
    while todo:
        here = min(todo, key=lambda place: (distance[place], place))
        todo.remove(here)
        if any(step(here, there) not in known for there in floor.neighbours[here]):
            way = [here]
            while way[-1] in before:
                way.append(before[way[-1]])
            return way[::-1][1:]
        for there in floor.neighbours[here]:
            further = distance[here] + floor.distance(here, there)
            if further < distance.get(there, np.inf):
                distance[there], before[there] = further, here
                todo.add(there)
    raise AssertionError("a floor's corridors are connected")
