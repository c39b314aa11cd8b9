"""`simulate_log`: a robot's drive through a building as the log that it writes, with its truth.

What the numbers mean stands in ``docs/log-model.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..errors import ConfigError
from ..logs import Compass, Detection, Event, Gyro, Log, LogHeader, LogTruth, Odometry, Scan
from .building import Building
from .detecting import Sighting, detections, first_times
from .drive import Drive, drive
from .explore import start_places
from .policy import Policy, walk
from .robots import Robot
from .sensing import DECIMALS, compass, draw_systematic, gyro, odometry
from .sensing import scans as range_scans

Array = NDArray[np.float64]

#: Events of one time stand in this order.
_ORDER = {Odometry: 0, Gyro: 1, Compass: 2, Detection: 3, Scan: 4}


@dataclass(frozen=True, slots=True)
class Stop:
    """When a drive ends before its share of the corridors is known, whichever comes first.

    After ``distance`` [m], after ``time`` [s], at the ``places``-th place of the walk, the first included; or before
    it would have detected more than so many ``landmarks``, false alarms included. None: never.
    """

    distance: float | None = None
    time: float | None = None
    places: int | None = None
    landmarks: int | None = None

    def __post_init__(self) -> None:
        for name in ("distance", "time"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ConfigError(f"stop {name} must be at least 0, not {value}")
        for name in ("places", "landmarks"):
            value = getattr(self, name)
            if value is not None and not value >= 1:
                raise ConfigError(f"stop {name} must be at least 1, not {value}")


class SimulatedLog(NamedTuple):
    """A log and its truth."""

    header: LogHeader
    events: list[Event]
    truth: LogTruth

    @property
    def log(self) -> Log:
        """Header and events."""
        return Log(self.header, self.events)


def simulate_log(
    building: Building,
    robot: Robot,
    rng: np.random.Generator,
    *,
    name: str,
    start: str | None = None,
    policy: Policy = "unexplored",
    share: float = 1.0,
    beyond: float = 12.0,
    stop: Stop | None = None,
    scans: bool = True,
) -> SimulatedLog:
    """Explores the building from the place ``start`` (None: a random one), and returns header, events and truth.

    ``policy``, ``share`` and ``beyond`` [m]: see `walk`. What is drawn for one sensor doesn't depend on whether there
    are others, so that without ``scans`` all else is the same.

    Raises `ConfigError` for a start or a policy that there isn't, or a share outside 0 to 1.

    >>> from mapfuse.datasets.simulation import VESPUCCI, build, salvatori_like
    >>> building = build(salvatori_like())
    >>> header, events, truth = simulate_log(building, VESPUCCI, np.random.default_rng(1), name="D1", scans=False)
    >>> header.robot, type(events[0]).__name__, truth.path.shape[1]
    ('vespucci', 'Odometry', 4)
    """
    stop = stop or Stop()
    robot = _with_its_compass(robot)
    ways, errors, wheels, turning, north, eyes, ranging = (_child(rng) for _ in range(7))
    first = start if start is not None else _start(building, ways)
    places = walk(building.floor, ways, first, policy, share=share, beyond=beyond)[: stop.places]
    driven = drive(building.floor, places, robot.driving, ways)
    driven = driven.until(
        np.inf if stop.time is None else stop.time, np.inf if stop.distance is None else stop.distance
    )
    seen = detections(building, driven, robot, eyes)
    if stop.landmarks is not None:
        driven, seen = _before_more(driven, seen, stop.landmarks)
    systematic = draw_systematic(robot.sensors, errors)
    events: list[Event] = [
        *odometry(driven, robot.sensors, systematic, wheels),
        *gyro(driven, robot.sensors, systematic, turning),
        *compass(building, driven, robot.sensors, systematic, robot.driving.compass_every, north),
        *(sighting.event for sighting in seen),
    ]
    if scans:
        events += range_scans(building, driven, robot.sensors, robot.driving, ranging)
    events.sort(key=lambda event: (event.t, _ORDER[type(event)]))
    header = LogHeader(name, robot.name, None, robot.sensors, {"simulated": True, "building": building.name})
    return SimulatedLog(header, events, _truth(building, driven, seen, name))


def simulate_logs(
    building: Building,
    robots: Sequence[Robot],
    seed: int,
    *,
    names: Sequence[str] | None = None,
    starts: Sequence[str | None] = (None,),
    policies: Sequence[Policy] = ("unexplored",),
    share: float = 1.0,
    beyond: float = 12.0,
    stop: Stop | None = None,
    scans: bool = True,
) -> list[SimulatedLog]:
    """One log of each of ``robots`` in one building; ``starts`` and ``policies`` are taken in turn.

    ``names``: default ``ROBOT-1``, ``ROBOT-2``. The k-th log depends on ``seed`` and k, not on how many there are.

    >>> from mapfuse.datasets.simulation import MILKA, VESPUCCI, build, hospital_like
    >>> west, east = simulate_logs(build(hospital_like()), (VESPUCCI, MILKA), 3, starts=("p9", "p13"), scans=False)
    >>> west.header.name, east.header.name
    ('vespucci-1', 'milka-2')
    """
    names = [f"{robot.name}-{k + 1}" for k, robot in enumerate(robots)] if names is None else names
    return [
        simulate_log(
            building,
            robot,
            np.random.default_rng([seed, k]),
            name=name,
            start=starts[k % len(starts)],
            policy=policies[k % len(policies)],
            share=share,
            beyond=beyond,
            stop=stop,
            scans=scans,
        )
        for k, (robot, name) in enumerate(zip(robots, names, strict=True))
    ]


def _child(rng: np.random.Generator) -> np.random.Generator:
    return np.random.default_rng(rng.integers(2**63))


def _with_its_compass(robot: Robot) -> Robot:
    """The robot, with no compass among its sensors where it carries none."""
    return robot if robot.compass else replace(robot, sensors=replace(robot.sensors, compass_sigma=None))


def _start(building: Building, rng: np.random.Generator) -> str:
    places = start_places(building.floor) or [place.id for place in building.floor.places]
    return str(rng.choice(places))


def _before_more(driven: Drive, seen: list[Sighting], landmarks: int) -> tuple[Drive, list[Sighting]]:
    """The drive until just before it detects more than so many landmarks."""
    times = first_times(seen)
    if len(times) <= landmarks:
        return driven, seen
    end = times[landmarks]
    return driven.until(float(np.nextafter(end, -np.inf)) - 1e-9), [s for s in seen if s.event.t < end]


def _truth(building: Building, driven: Drive, seen: Sequence[Sighting], name: str) -> LogTruth:
    path = driven.path.copy()
    path[:, 3] = se2.wrap(path[:, 3])
    places = building.floor.places
    return LogTruth(
        name,
        path.round(DECIMALS),
        tuple(sighting.place for sighting in seen),
        {place.id: place.xy for place in places},
        {place.id: place.type for place in places},
        {"simulated": True},
    )
