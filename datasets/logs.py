"""What a robot writes down while it drives: events with times, and a header that says what robot it is.

Metres, radians, seconds, right-handed frames, angles counter-clockwise. Bearings are from the robot's forward axis,
ranges from its centre. The events are `msgspec.Struct` values, frozen like the dataclasses elsewhere: a million of
them are decoded from a file in about a second, which dataclasses can't do.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from .maps import DOOR, LinkType
from .values import frozen_array, rebuilt, same_fields

Array = NDArray[np.float64]

# msgspec holds these where events are decoded, not where they are made; a file's writer decodes what it wrote
#: Times [s] and all else [m, rad, rad/s]; what is larger than `LARGEST` is a broken instrument, and its square would
#: overflow.
LARGEST = 1e9
Time: TypeAlias = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]
Number: TypeAlias = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
Range: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=LARGEST)]
Word: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=1000)]


class Odometry(msgspec.Struct, frozen=True, tag_field="event", tag="odometry"):
    """Pose x, y [m], theta [rad] by dead reckoning in a frame of the robot's choice; only differences count.

    ``theta`` may go on counting beyond one turn or be wrapped. Being a pose and not a step, a lost line loses nothing.
    """

    t: Time
    x: Number
    y: Number
    theta: Number


class Gyro(msgspec.Struct, frozen=True, tag_field="event", tag="gyro"):
    """Turning rate [rad/s], which holds until the next reading."""

    t: Time
    rate: Number


class Compass(msgspec.Struct, frozen=True, tag_field="event", tag="compass"):
    """Direction of the robot's forward axis [rad] from what its compass takes for north."""

    t: Time
    heading: Number


class SensedArm(msgspec.Struct, frozen=True):
    """One arm of a detected landmark: what was sensed there, and its direction as a ``bearing`` [rad]."""

    type: LinkType
    bearing: Number


class Detection(msgspec.Struct, frozen=True, tag_field="event", tag="detection", omit_defaults=True):
    """A landmark seen: its type, where it is from the robot, and its arms; ``id`` where it carries a name."""

    t: Time
    type: Word
    range: Range
    bearing: Number
    arms: tuple[SensedArm, ...] = ()
    id: Word | None = None


class Scan(msgspec.Struct, frozen=True, tag_field="event", tag="scan"):
    """Ranges [m] at the bearings ``start + k step`` [rad]; None where nothing is within reach."""

    t: Time
    start: Number
    step: Number
    ranges: tuple[Range | None, ...]


Event: TypeAlias = Odometry | Gyro | Compass | Detection | Scan


@dataclass(frozen=True, slots=True)
class Sensors:
    """What a robot's sensors are known to be: standard deviations, rates and reach.

    Systematic errors are constant over a run, drawn once: ``odometry_scale_sigma`` (share of a distance),
    ``odometry_turn_scale_sigma`` (share of a turn), ``odometry_curve_sigma`` [rad/m] (unequal wheels),
    ``gyro_bias_sigma`` [rad/s], ``compass_offset_sigma`` [rad] (None: unknown). The others are drawn anew:
    ``odometry_distance_sigma`` [m per root metre], ``odometry_turn_sigma`` [rad per root metre],
    ``odometry_turn_sigma_per_turn`` [rad per root radian turned], ``gyro_sigma`` [rad per root second],
    ``compass_sigma`` [rad per reading]. Steel bends compass readings by ``compass_bend_sigma`` [rad], alike at
    places nearer to each other than ``compass_bend_length`` [m].

    Landmarks are detected up to ``detection_range`` [m] within ``field_of_view`` [rad, whole angle]: range
    ``range_sigma`` [m] plus ``range_sigma_per_metre``, bearing ``bearing_sigma``, arms ``arm_sigma`` [rad] each.
    A pass detects with ``detection_rate`` (doors ``door_detection_rate``); of the landmarks that end up in a map,
    ``false_alarm_rate`` (doors ``door_false_alarm_rate``) aren't there. Range scans reach ``scan_range`` [m] with
    ``scan_sigma`` [m]. ``gyro_sigma``, ``compass_sigma`` None: there is no such instrument.

    >>> Sensors().detection("door")
    0.92
    """

    odometry_scale_sigma: float = 0.01
    odometry_turn_scale_sigma: float = 0.01
    odometry_curve_sigma: float = 0.002
    odometry_distance_sigma: float = 0.02
    odometry_turn_sigma: float = 0.01
    odometry_turn_sigma_per_turn: float = 0.02
    gyro_bias_sigma: float = 0.0005
    gyro_sigma: float | None = None
    compass_sigma: float | None = None
    compass_offset_sigma: float | None = 0.1
    compass_bend_sigma: float = 0.15
    compass_bend_length: float = 4.0
    detection_range: float = 3.0
    field_of_view: float = 2 * np.pi
    range_sigma: float = 0.05
    range_sigma_per_metre: float = 0.02
    bearing_sigma: float = 0.03
    arm_sigma: float = 0.05
    detection_rate: float = 0.81
    false_alarm_rate: float = 0.2
    door_detection_rate: float = 0.92
    door_false_alarm_rate: float = 0.03
    scan_range: float = 5.0
    scan_sigma: float = 0.02
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)

    def detection(self, type_: str) -> float:
        """Probability that a pass detects a landmark of this type."""
        return self.door_detection_rate if type_ == DOOR else self.detection_rate

    def false_alarm(self, type_: str) -> float:
        """Share of a map's landmarks of this type that aren't there."""
        return self.door_false_alarm_rate if type_ == DOOR else self.false_alarm_rate

    def detection_sigma(self, range_: float) -> float:
        """Standard deviation [m] of a range [m]."""
        return self.range_sigma + self.range_sigma_per_metre * range_


@dataclass(frozen=True, slots=True)
class LogHeader:
    """Whose log it is; ``recorded_at`` as ISO 8601 is the time 0 of the events' clock, where known."""

    name: str
    robot: str | None = None
    recorded_at: str | None = None
    sensors: Sensors = field(default_factory=Sensors)
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)


@dataclass(frozen=True, slots=True)
class Log:
    """A header and its events, in the order of the recording; ``events`` may be a stream that runs once.

    ``path``: the file that it was read from, for what is said of it.
    """

    header: LogHeader
    events: Iterable[Event]
    path: Path | None = field(default=None, compare=False)

    def without_ids(self) -> Log:
        """The same log, its detections without the names that they carry."""
        return replace(self, events=_WithoutIds(self.events))


class _WithoutIds(Iterable[Event]):
    """Events without the names of what was detected, as often as they are asked for."""

    def __init__(self, events: Iterable[Event]) -> None:
        self.events = events

    def __iter__(self) -> Iterator[Event]:
        for event in self.events:
            yield msgspec.structs.replace(event, id=None) if isinstance(event, Detection) else event


@dataclass(frozen=True, eq=False, slots=True)
class LogTruth:
    """What was really so while a log was recorded.

    ``path`` (k, 4): time [s], x, y [m], theta [rad] in the world; its first pose is the origin of the robot's map.
    ``detections``: of each `Detection` in order of the log the id of the true place, None for a false alarm.
    ``places``: where those are (2,) [m, world]; ``types``: what they are. ``extra`` keeps the file's unknown keys.
    """

    name: str
    path: Array
    detections: tuple[str | None, ...]
    places: Mapping[str, Array]
    types: Mapping[str, str]
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", frozen_array(self.path))
        object.__setattr__(self, "detections", tuple(self.detections))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.name, len(self.detections)))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)
