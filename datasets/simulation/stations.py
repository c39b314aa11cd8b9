"""`Stations`: what a robot passes on a route, and which of it gets into the map (rows 10 and 11), false alarms too."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..maps import DOOR
from .explore import START_CLEARANCE, Route, Step, step
from .floors import Arm, Floor, Place, bearing, corridor_arms
from .robots import Robot

Array = NDArray[np.float64]

#: Row 10 is the difference of two robots' ideas of one place; each robot has this share of it [m], [rad].
SAME_PLACE_SIGMA = 0.05 / np.sqrt(2)
SAME_TURN_SIGMA = 0.01 / np.sqrt(2)
#: False alarms keep this distance [m] from places and from each other.
FALSE_SPACING = 1.0


@dataclass(frozen=True, eq=False, slots=True)
class Station:
    """A spot of the walk: a true place (``real``) or a false alarm's spot on a corridor.

    ``meant`` (2,) [m, world] and ``turn`` [rad]: where this robot takes the place to be and how far its idea of the
    directions is turned (row 10). ``visits``: passes; ``detections``: 0 where it is not in the map.
    """

    place: Place
    real: bool
    meant: Array
    turn: float
    visits: int
    detections: int


@dataclass(frozen=True, slots=True)
class Stations:
    """All stations and the walk through them, as indices."""

    all: tuple[Station, ...]
    walk: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Spot:
    """A false alarm on the stretch from place ``step[0]``, ``along`` metres from there."""

    step: Step
    along: float
    type: str
    detections: int


def draw_stations(floor: Floor, route: Route, robot: Robot, rng: np.random.Generator) -> Stations:
    """Which places of the route are recorded, and the false alarms between them."""
    visits = Counter(route.places)
    real = [_station(floor.place_from_id[i], n, i == route.places[0], robot, rng) for i, n in visits.items()]
    spots = _false_alarms(floor, route, real, robot, rng)
    index = {identifier: k for k, identifier in enumerate(visits)}
    travels = Counter(step(a, b) for a, b in pairwise(route.places))
    false = [_false_station(floor, s, k, travels[s.step], rng) for k, s in enumerate(spots)]
    walk = [index[route.places[0]]]
    for a, b in pairwise(route.places):
        between = [(s.along, len(real) + k) for k, s in enumerate(spots) if s.step == step(a, b)]
        walk += [k for _, k in sorted(between, reverse=a > b)]
        walk.append(index[b])
    return Stations((*real, *false), tuple(walk))


def _station(place: Place, visits: int, start: bool, robot: Robot, rng: np.random.Generator) -> Station:
    rate = robot.noise.detection(place.type)
    recorded = start or bool(rng.random() < rate)
    again = int(rng.binomial(visits - 1, rate))
    meant = place.xy + rng.normal(0.0, SAME_PLACE_SIGMA, 2)
    turn = float(rng.normal(0.0, SAME_TURN_SIGMA))
    return Station(place, True, meant, turn, visits, 1 + again if recorded else 0)


def _false_alarms(
    floor: Floor, route: Route, real: list[Station], robot: Robot, rng: np.random.Generator
) -> list[_Spot]:
    """Of each kind so many that a recorded landmark of it with n detections is false with probability fa^n.

    Each record is false or true independently; given the true ones, the false ones among them are negative binomial.
    """
    travels = Counter(step(a, b) for a, b in pairwise(route.places))
    recorded = Counter((s.place.type, s.detections) for s in real if s.detections)
    spots: list[_Spot] = []
    for (kind, detections), count in sorted(recorded.items()):
        rate = robot.noise.false_alarm(kind) ** detections
        for _ in range(int(rng.negative_binomial(count, 1 - rate))):
            spot = _spot(floor, route.places[0], travels, kind, detections, spots, rng)
            if spot is not None:
                spots.append(spot)
    return spots


def _spot(
    floor: Floor,
    start: str,
    travels: Counter[Step],
    kind: str,
    detections: int,
    taken: list[_Spot],
    rng: np.random.Generator,
) -> _Spot | None:
    """A spot anywhere on the corridors that were travelled often enough; None where there is no room left."""
    often = [s for s, n in travels.items() if n >= detections] or list(travels)
    room = np.array([max(0.0, floor.distance(*s) - 2 * FALSE_SPACING) for s in often])
    if not room.any():
        return None
    for _ in range(100):
        k = int(rng.choice(len(often), p=room / room.sum()))
        along = FALSE_SPACING + float(rng.uniform(0, room[k]))
        apart = all(abs(along - s.along) >= FALSE_SPACING for s in taken if s.step == often[k])
        xy = _point(floor, often[k], along)
        if apart and np.hypot(*(xy - floor.place_from_id[start].xy)) >= START_CLEARANCE:
            return _Spot(often[k], along, kind, detections)
    return None


def _point(floor: Floor, stretch: Step, along: float) -> Array:
    a, b = (floor.place_from_id[i].xy for i in stretch)
    return np.asarray(a + (b - a) * along / np.hypot(*(b - a)), dtype=float)


def _false_station(floor: Floor, spot: _Spot, number: int, travels: int, rng: np.random.Generator) -> Station:
    a, b = (floor.place_from_id[i].xy for i in spot.step)
    xy, side = _point(floor, spot.step, spot.along), int(rng.choice([-1, 1]))
    arms: tuple[Arm, ...] = corridor_arms(bearing(a, b), side, "door" if spot.type == DOOR else "open")
    place = Place(f"false-{number}", spot.type, float(xy[0]), float(xy[1]), arms)
    return Station(place, False, xy, 0.0, max(travels, spot.detections), spot.detections)
