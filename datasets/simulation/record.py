"""`record`: the map that a robot brings home from a route, drawn from the measurement model, with its truth.

The rows that are named here are those of ``docs/measurement-model.md``. No log is simulated and no mapper runs: each
recorded number is drawn with exactly the distribution that the model gives it, so that an estimator which follows the
model must be consistent on these maps. Three choices keep that exact where the model leaves a case open:

- The landmark at the start is always recorded, and no other place or false alarm is within 4 m of it: so it is the
  one recorded nearest to the start, whatever the noise.
- Recorded positions are loop-closed (least squares over the links), as a mapper's are, or on request as first reckoned,
  each from where the robot came; by row 6 they are starting values, except the one at the start, and the displacements
  over bent links, which keep their own draws.
- A bent link stands at one of its two ends, where its arm is clear of the displacement by more than 20 degrees, and
  its error is relative to the landmark heading there: one reading, whose error no other number in the map shares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..maps import Landmark, LandmarkMap, Link
from ..values import frozen_array
from .explore import Route, SimulationError
from .floors import Floor, bearing
from .positions import Displacement, first_to_each, solve_positions
from .robots import Robot
from .stations import Station, Stations, draw_stations
from .trail import BENT, StationArm, Trail, Way, trail

Array = NDArray[np.float64]

#: How often a recording that the model can't describe is drawn again before giving up.
TRIES = 200
_LETTERS = tuple("abcdefghijkmnpqrstuvwxyz23456789")


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """A recorded map with its truth.

    ``frame`` (3,): pose of the map's coordinate system in the world. ``place_from_id``: the true place that each
    landmark is, None for a false alarm. ``meant`` (3,) of each landmark: x, y [m, world] of what this robot means by
    it (the true place to within row 10), and how far its directions are turned from the true ones [rad].
    ``rejected``: how many draws the model could not describe before this one.
    """

    map: LandmarkMap
    frame: Array
    place_from_id: Mapping[str, str | None]
    meant: Mapping[str, Array] = field(repr=False)
    rejected: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame", frozen_array(self.frame))

    @property
    def true_places(self) -> frozenset[str]:
        """Ids of the true places that are in the map."""
        return frozenset(place for place in self.place_from_id.values() if place is not None)


def record(
    floor: Floor, route: Route, robot: Robot, rng: np.random.Generator, name: str, *, loops_closed: bool = True
) -> Recording:
    """The map that ``robot`` brings home from ``route``; landmarks and links shuffled, ids random.

    ``loops_closed``: whether the recorded positions are the best that all links together say; else each is what the
    robot reckoned when it first came there, as of robots that map while they drive and never look back.

    Raises `SimulationError` where no draw in `TRIES` gives a map that the model describes.

    >>> from mapfuse.datasets.simulation import VESPUCCI, explore, irregular_floor
    >>> rng = np.random.default_rng(1)
    >>> floor = irregular_floor(rng)
    >>> recording = record(floor, explore(floor, rng, share=0.5), VESPUCCI, rng, "D1")
    >>> recording.map.name, len(recording.map) == len(recording.place_from_id)
    ('D1', True)
    """
    for rejected in range(TRIES):
        stations = draw_stations(floor, route, robot, rng)
        links = trail(stations)
        if links is None:
            continue
        readings = _Readings.draw(floor, route, robot, rng, stations, links, loops_closed)
        if not readings.fit_the_model(links):
            continue
        recorded = [k for k, s in enumerate(stations.all) if s.detections]
        order = [recorded[k] for k in rng.permutation(len(recorded))]
        id_from_station = dict(zip(order, _random_ids(rng, len(order)), strict=True))
        landmarks = tuple(_landmark(stations.all[k], k, readings, links, id_from_station, rng) for k in order)
        return Recording(
            LandmarkMap(name, landmarks, robot.name, noise=robot.stated_noise, extra={"simulated": True}),
            route.start,
            {id_from_station[k]: s.place.id if (s := stations.all[k]).real else None for k in order},
            {id_from_station[k]: frozen_array([*(s := stations.all[k]).meant, s.turn]) for k in order},
            rejected,
        )
    raise SimulationError(f"no recording of {floor.name!r} could be drawn for this route in {TRIES} tries")


def _random_ids(rng: np.random.Generator, count: int) -> list[str]:
    ids: list[str] = []
    while len(ids) < count:
        new = "".join(rng.choice(_LETTERS, 6))
        if new not in ids:
            ids.append(new)
    return ids


@dataclass(frozen=True, eq=False, slots=True)
class _Readings:
    """The recorded numbers: ``heading`` [rad, map frame] and ``compass`` of each listed arm, ``distance`` [m] of each
    way, ``position`` (2,) [m, map frame] of each recorded station."""

    heading: Mapping[StationArm, float]
    compass: Mapping[StationArm, float]
    distance: Mapping[Way, float]
    position: Mapping[int, Array]

    @classmethod
    def draw(
        cls,
        floor: Floor,
        route: Route,
        robot: Robot,
        rng: np.random.Generator,
        stations: Stations,
        links: Trail,
        loops_closed: bool,
    ) -> _Readings:
        """Rows 1 to 6 and 9."""
        truth = _listed_arms(stations, links, robot, rng)
        error = _heading_errors(truth, robot, rng)
        heading = {arm: float(se2.wrap(d - route.start[2] + error[arm])) for arm, d in truth.items()}
        compass = _compass_readings(truth, floor.north, robot, rng) if robot.compass else {}
        distance: dict[Way, float] = {}
        displacements: list[Displacement] = []
        recorded = [k for k, s in enumerate(stations.all) if s.detections]
        row = {k: n for n, k in enumerate(recorded)}
        for way in links.ways:
            a, b = stations.all[way.a], stations.all[way.b]
            sigma: float | None = None
            if way.straight:
                distance[way], xy, sigma = _straight(way, a, b, heading, robot, rng)
            else:
                turned = _landmark_error(way.a, a, heading, route.start[2]) - float(route.start[2])
                distance[way], xy = _bent(way, a, b, turned, robot, rng)
            displacements.append(Displacement(row[way.a], row[way.b], xy, sigma))
        start = stations.walk[0]
        at = se2.transform(se2.inverse(route.start), stations.all[start].meant)
        at = at + rng.normal(0.0, robot.noise.position_sigma, 2)
        if not loops_closed:
            displacements = first_to_each(len(recorded), displacements)
        xy_of_row = solve_positions(len(recorded), row[start], at, displacements)
        return cls(heading, compass, distance, {k: xy_of_row[row[k]] for k in recorded})

    def fit_the_model(self, links: Trail) -> bool:
        """Whether straight links look straight, bent ones bent (row 5), and the anchor is the nearest (row 6)."""
        nearest = min(self.position, key=lambda k: float(np.hypot(*self.position[k])))
        return nearest == 0 and all(self._looks_as_it_is(way) for way in links.ways)

    def _looks_as_it_is(self, way: Way) -> bool:
        chord = bearing(self.position[way.a], self.position[way.b])
        off_a = abs(float(se2.wrap(chord - self.heading[way.a, way.arm_a])))
        off_b = abs(float(se2.wrap(chord + np.pi - self.heading[way.b, way.arm_b])))
        straight = self.distance[way] > 0 and max(off_a, off_b) < BENT
        return straight if way.straight else off_a > BENT


def _listed_arms(stations: Stations, links: Trail, robot: Robot, rng: np.random.Generator) -> dict[StationArm, float]:
    """True direction [rad, world] of each arm that is in the record.

    Of a straight link it is the bearing between what this robot means by its ends, so that row 3 holds; of any other
    arm the corridor's or wall's direction, turned by the robot's own idea of the place (row 10).
    """
    directions: dict[StationArm, float] = {}
    for k, station in enumerate(stations.all):
        for m, arm in enumerate(station.place.arms):
            sensed = bool(rng.random() < robot.arm_sensed) or (k, m) in links.travelled
            if station.detections and sensed:
                directions[k, m] = arm.direction + station.turn
    for way in links.ways:
        if way.straight:
            direction = bearing(stations.all[way.a].meant, stations.all[way.b].meant)
            directions[way.a, way.arm_a] = direction
            directions[way.b, way.arm_b] = direction + np.pi
    return directions


def _heading_errors(
    arms: Mapping[StationArm, float], robot: Robot, rng: np.random.Generator
) -> dict[StationArm, float]:
    """Row 1: half of the variance is shared by all arms of a landmark, half is each arm's own."""
    sigma = robot.noise.heading_sigma / np.sqrt(2)
    shared = {k: rng.normal(0.0, sigma) for k in sorted({k for k, _ in arms})}
    return {(k, m): float(shared[k] + rng.normal(0.0, sigma)) for k, m in arms}


def _compass_readings(
    arms: Mapping[StationArm, float], north: float, robot: Robot, rng: np.random.Generator
) -> dict[StationArm, float]:
    """Row 9: one offset per robot; now and then steel bends a reading to anywhere."""
    known = robot.noise.compass_offset_sigma
    offset = rng.uniform(-np.pi, np.pi) if known is None else rng.normal(0.0, known)
    readings: dict[StationArm, float] = {}
    for arm, direction in arms.items():
        honest = direction - north - offset + rng.normal(0.0, robot.noise.compass_sigma)
        bent = bool(rng.random() < robot.bent_compass)
        readings[arm] = float(se2.wrap(rng.uniform(-np.pi, np.pi) if bent else honest))
    return readings


def _straight(
    way: Way,
    a: Station,
    b: Station,
    heading: Mapping[StationArm, float],
    robot: Robot,
    rng: np.random.Generator,
) -> tuple[float, Array, float]:
    """Rows 3 and 4: the distance, and the displacement and sigma that it gives to the recorded positions."""
    length = float(np.hypot(*(b.meant - a.meant)))
    along = robot.noise.distance_sigma(length, way.travels)
    d = length + float(rng.normal(0.0, along))
    there, back = heading[way.a, way.arm_a], heading[way.b, way.arm_b] + np.pi
    direction = there + float(se2.wrap(back - there)) / 2
    sigma = float(np.hypot(along, length * robot.noise.heading_sigma))
    return d, d * np.array([np.cos(direction), np.sin(direction)]), sigma


def _bent(
    way: Way, a: Station, b: Station, turned: float, robot: Robot, rng: np.random.Generator
) -> tuple[float, Array]:
    """Row 5: the travelled distance, and the displacement (map frame), off by sigmas of the travelled distance.

    ``turned`` [rad]: from the world to the map frame as the landmark heading at ``a`` has it.
    """
    along = float(rng.normal(0.0, robot.noise.distance_sigma(way.length)))
    across = float(rng.normal(0.0, way.length * robot.noise.heading_sigma))
    chord = b.meant - a.meant
    unit = chord / np.hypot(*chord)
    displacement = chord + along * unit + across * np.array([-unit[1], unit[0]])
    return max(way.length + along, 0.0), se2.rotation(turned) @ displacement


def _landmark_error(k: int, station: Station, heading: Mapping[StationArm, float], start: float) -> float:
    """Error [rad] of the landmark heading: the mean of its arms' errors (row 2)."""
    off = [
        float(se2.wrap(heading[k, m] + start - arm.direction - station.turn))
        for m, arm in enumerate(station.place.arms)
        if (k, m) in heading
    ]
    return float(np.mean(off))


def _landmark(
    station: Station,
    k: int,
    readings: _Readings,
    links: Trail,
    id_from_station: Mapping[int, str],
    rng: np.random.Generator,
) -> Landmark:
    way_from_arm = {(w.a, w.arm_a): (w, w.b) for w in links.ways}
    way_from_arm |= {(w.b, w.arm_b): (w, w.a) for w in links.ways if w.straight}
    arms: list[Link] = []
    for m, arm in enumerate(station.place.arms):
        if (k, m) not in readings.heading:
            continue
        way, far = way_from_arm.get((k, m), (None, None))
        heading, compass = readings.heading[k, m], readings.compass.get((k, m))
        if way is None or far is None:
            arms.append(Link(arm.type, heading, compass))
        else:
            d = readings.distance[way]
            arms.append(Link(arm.type, heading, compass, id_from_station[far], d, way.travels))
    x, y = (float(value) for value in readings.position[k])
    return Landmark(
        id_from_station[k],
        station.place.type,
        x,
        y,
        links=tuple(arms[n] for n in rng.permutation(len(arms))),
        visit_counter=station.visits,
        detection_counter=station.detections,
    )
