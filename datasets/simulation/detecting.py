"""Which places a robot detects on a drive, as what, and what it takes for a place: rows 6 to 10 of
``docs/log-model.md``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arms import wrap
from ..logs import Detection, SensedArm, Sensors
from ..maps import DOOR
from .building import Building
from .drive import Drive
from .floors import Place, bearing, corridor_arms
from .raycast import clear, nearest_points
from .robots import Robot
from .sensing import DECIMALS
from .stations import FALSE_SPACING

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Nothing is sighted from nearer than this [m].
NEAREST = 0.5
#: Stretches on which a place is visible are one pass where the robot goes less than this [m] between them.
PASS_GAP = 1.0
#: How often a spot for a false alarm is drawn before it is taken for one that fewer passes detect.
_TRIES = 200


@dataclass(frozen=True, slots=True)
class Sighting:
    """A detection with the true place that it is of; None for a false alarm, ``landmark`` tells these apart."""

    event: Detection
    place: str | None
    landmark: str


def visible(building: Building, poses: Array, point: Array, sensors: Sensors) -> NDArray[np.bool_]:
    """From which of ``poses`` (n, 3) the ``point`` (2,) is in reach, in the field of view and in sight.

    As `Building.sees` has it of its places.
    """
    away = point - poses[:, :2]
    distance = np.hypot(away[:, 0], away[:, 1])
    off = np.abs(se2.wrap(np.arctan2(away[:, 1], away[:, 0]) - poses[:, 2]))
    seen = (distance <= sensors.detection_range) & ((off <= sensors.field_of_view / 2) | (distance < 1e-9))
    near = np.flatnonzero(seen)
    # sight is free from here to there where it is from there to here
    seen[near] = clear(point, poses[near, :2], building.walls)
    return np.asarray(seen, dtype=bool)


def passes(building: Building, driven: Drive, point: Array, sensors: Sensors) -> list[Indices]:
    """Of each pass of the ``point`` (2,) the indices of the drive's poses that may sight it (row 6)."""
    seen = np.flatnonzero(visible(building, driven.poses, point, sensors))
    apart = 1 + np.flatnonzero((np.diff(seen) > 1) & (np.diff(driven.way[seen]) >= PASS_GAP))
    far = np.hypot(*(driven.poses[:, :2] - point).T) >= NEAREST
    found = [stretch[far[stretch]] for stretch in np.split(seen, apart)]
    return [stretch for stretch in found if len(stretch)]


def detections(building: Building, driven: Drive, robot: Robot, rng: np.random.Generator) -> list[Sighting]:
    """All detections of a drive in order of time, false alarms among them."""
    sightings: list[Sighting] = []
    recorded: Counter[tuple[str, int]] = Counter()
    for place in building.floor.places:
        found = passes(building, driven, place.xy, robot.sensors)
        found = [p for p in found if rng.random() < robot.sensors.detection(place.type)]
        if found:
            recorded[place.type, len(found)] += 1
            sightings += _sightings(driven, place, place.id, found, robot, rng)
    sightings += _false_alarms(building, driven, recorded, robot, rng)
    return sorted(sightings, key=lambda sighting: sighting.event.t)


def _sightings(
    driven: Drive, place: Place, true: str | None, found: Sequence[Indices], robot: Robot, rng: np.random.Generator
) -> list[Sighting]:
    """What the detecting passes ``found`` say of a place (rows 7 and 8)."""
    least, most = robot.driving.sightings
    sightings = []
    for stretch in found:
        count = min(len(stretch), int(rng.integers(least, most + 1)))
        for k in np.sort(rng.choice(stretch, count, replace=False)):
            event = _sighted(driven.path[k], place, robot, rng)
            sightings.append(Sighting(event, true, place.id))
    return sightings


def _sighted(stamped: Array, place: Place, robot: Robot, rng: np.random.Generator) -> Detection:
    """The place as seen at time and pose ``stamped`` (4,)."""
    sensors = robot.sensors
    t, x, y, theta = stamped.tolist()
    distance = float(np.hypot(place.x - x, place.y - y))
    range_ = distance + rng.normal() * sensors.detection_sigma(distance)
    towards = bearing((x, y), place.xy) - theta + rng.normal() * sensors.bearing_sigma
    arms = tuple(
        SensedArm(arm.type, _angle(arm.direction - theta + rng.normal() * sensors.arm_sigma))
        for arm in place.arms
        if rng.random() < robot.arm_sensed
    )
    return Detection(round(t, DECIMALS), place.type, round(max(0.0, range_), DECIMALS), _angle(towards), arms)


def _angle(angle: float) -> float:
    return round(wrap(angle), DECIMALS)


def _false_alarms(
    building: Building,
    driven: Drive,
    recorded: Counter[tuple[str, int]],
    robot: Robot,
    rng: np.random.Generator,
) -> list[Sighting]:
    """Of each kind and number of detecting passes as many as row 9 says, given those that true places had."""
    sightings: list[Sighting] = []
    spots: list[Place] = []
    for (kind, times), count in sorted(recorded.items()):
        rate = robot.sensors.false_alarm(kind) ** times
        for _ in range(int(rng.negative_binomial(count, 1 - rate))):
            drawn = _spot(building, driven, kind, times, spots, robot.sensors, rng)
            if drawn is not None:
                spot, met = drawn
                spots.append(spot)
                which = np.sort(rng.choice(len(met), min(times, len(met)), replace=False))
                sightings += _sightings(driven, spot, None, [met[k] for k in which], robot, rng)
    return sightings


def _spot(
    building: Building,
    driven: Drive,
    kind: str,
    times: int,
    taken: Sequence[Place],
    sensors: Sensors,
    rng: np.random.Generator,
) -> tuple[Place, list[Indices]] | None:
    """A spot on the way that is passed ``times`` often, and its passes; else the one passed most often of those drawn.

    None where there is no room along the way.
    """
    others = np.vstack([building.floor.positions, *(spot.xy for spot in taken)])
    best: tuple[Place, list[Indices]] | None = None
    for _ in range(_TRIES):
        k = int(np.searchsorted(driven.way, rng.uniform(0, driven.way[-1])))
        near = nearest_points(driven.poses[k : k + 1, :2], building.steps)[0]
        line = int(np.argmin(np.hypot(*(near - driven.poses[k, :2]).T)))
        xy = near[line]
        if np.hypot(*(others - xy).T).min() < FALSE_SPACING:
            continue
        met = passes(building, driven, xy, sensors)
        if met and (best is None or len(met) > len(best[1])):
            direction, side = bearing(*building.steps[line]), int(rng.choice([-1, 1]))
            arms = corridor_arms(direction, side, "door" if kind == DOOR else "open")
            best = Place(f"false-{len(taken)}", kind, float(xy[0]), float(xy[1]), arms), met
            if len(met) >= times:
                break
    return best


def first_times(sightings: Sequence[Sighting]) -> list[float]:
    """When [s] each landmark, true or false, was detected first, in order."""
    first: dict[str, float] = {}
    for sighting in sightings:
        first.setdefault(sighting.landmark, sighting.event.t)
    return sorted(first.values())
