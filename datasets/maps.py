"""What a robot brings home: `LandmarkMap`, `Landmark`, `Link`, `Noise` as frozen values, with array views.

Names and meanings are those of the paper's records (section 2.1) and of the file format ``mapfuse.map/1``.
Metres, radians, right-handed frames, angles in (-pi, pi] counter-clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .values import frozen_array, rebuilt, same_fields

Array = NDArray[np.float64]
LinkType = Literal["open", "blocked", "door", "unknown"]
LINK_TYPES: tuple[LinkType, ...] = ("open", "blocked", "door", "unknown")

#: Landmark types with a meaning of their own; any other word is the label of a point landmark.
CORNER = "corner"
SPATIAL_TYPES = (CORNER, "junction")
DOOR = "door"


@dataclass(frozen=True, slots=True)
class Link:
    """One arm of a landmark, and the way along it to another landmark if the robot travelled it.

    ``heading`` [rad, map frame] is None where the direction is not known; ``compass`` [rad] is the absolute
    direction of the arm by the robot's compass; ``distance`` [m] is the travelled distance to ``connected_to_id``.
    """

    type: LinkType = "unknown"
    heading: float | None = None
    compass: float | None = None
    connected_to_id: str | None = None
    distance: float | None = None
    travel_counter: int = 0
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)


@dataclass(frozen=True, eq=False, slots=True)
class Landmark:
    """A place that can be found again: corner, junction, door, or any labelled point (``type``).

    ``x``, ``y`` [m] in the map's frame. ``heading`` [rad] only where there are no arms to give it.
    ``covariance``: 2x2, or 3x3 with heading. ``existence``: probability that it is there, or None.
    """

    id: str
    type: str
    x: float
    y: float
    heading: float | None = None
    links: tuple[Link, ...] = ()
    visit_counter: int = 1
    detection_counter: int = 1
    covariance: Array | None = None
    existence: float | None = None
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "links", tuple(self.links))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", frozen_array(self.covariance))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.id, self.type, self.x, self.y))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)


@dataclass(frozen=True, slots=True)
class Noise:
    """What the robot is known to be: standard deviations and detection rates.

    A distance d has sigma ``floor + per_metre * d``, divided by the root of the travels (`distance_sigma`).
    ``compass_offset_sigma`` None: the instrument's offset is unknown. ``false_alarm_rate``: probability that a
    recorded landmark isn't there; ``detection_rate``: that a landmark which was passed is recorded.
    """

    distance_sigma_per_metre: float = 0.02
    distance_sigma_floor: float = 0.1
    heading_sigma: float = 0.03
    position_sigma: float = 0.3
    compass_sigma: float = 0.2
    compass_offset_sigma: float | None = 0.1
    detection_rate: float = 0.81
    false_alarm_rate: float = 0.2
    door_detection_rate: float = 0.92
    door_false_alarm_rate: float = 0.03
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)

    def distance_sigma(self, distance: float, travels: int = 1) -> float:
        """Standard deviation [m] of a distance [m] travelled ``travels`` times."""
        sigma = self.distance_sigma_floor + self.distance_sigma_per_metre * distance
        return sigma / math.sqrt(max(1, travels))

    def detection(self, type_: str) -> float:
        """Probability that a passed landmark of this type is in the map."""
        return self.door_detection_rate if type_ == DOOR else self.detection_rate

    def false_alarm(self, type_: str) -> float:
        """Probability that a recorded landmark of this type isn't there, after one detection."""
        return self.door_false_alarm_rate if type_ == DOOR else self.false_alarm_rate


@dataclass(frozen=True, eq=False, slots=True)
class Keyframes:
    """Poses on the robot's way with their errors, and the walls that were seen from each.

    ``poses`` (m, 3): x, y [m], theta [rad]. ``walls`` (k, 5): straight pieces of wall, each the number of its pose and
    both ends x1, y1, x2, y2 [m] in the frame of that pose. ``matrix`` (3m, 3m): joint covariance of the poses,
    ``with_landmarks`` (3m, n): the one with all rows of the `JointCovariance` that they belong to; map axes.
    """

    poses: Array
    walls: Array
    with_landmarks: Array
    matrix: Array

    def __post_init__(self) -> None:
        for name in ("poses", "walls", "with_landmarks", "matrix"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash(len(self.poses))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)

    def scaled(self, scale: float) -> Keyframes:
        """The same with all standard deviations multiplied by ``scale``."""
        return Keyframes(self.poses, self.walls, self.with_landmarks * scale**2, self.matrix * scale**2)


@dataclass(frozen=True, eq=False, slots=True)
class JointCovariance:
    """Covariance of all ``order``-ed landmarks at once, ``rows`` (2: x, y; 3: and heading) per landmark, map axes.

    ``keyframes``: poses of the robot's way, known together with the landmarks.
    """

    order: tuple[str, ...]
    rows: int
    matrix: Array
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)
    keyframes: Keyframes | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "order", tuple(self.order))
        object.__setattr__(self, "matrix", frozen_array(self.matrix))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.order, self.rows))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """One robot's map, in the frame where the robot started (or that its ``path`` is written in).

    ``walls``: polylines (k, 2) [m]; ``path``: (k, 4) of time [s], x, y [m], theta [rad]; ``same_as``: landmarks
    known to be those of another map, ``{"c1": {"D9": "c4"}}``. ``extra`` keeps the file's unknown keys.

    >>> m = LandmarkMap("D7", (Landmark("c1", "corner", 1.0, 2.0), Landmark("d4", "door", 5.2, 2.0)))
    >>> m.positions.tolist()
    [[1.0, 2.0], [5.2, 2.0]]
    >>> m["d4"].type
    'door'
    """

    name: str
    landmarks: tuple[Landmark, ...] = ()
    robot: str | None = None
    recorded_at: str | None = None
    noise: Noise = field(default_factory=Noise)
    joint_covariance: JointCovariance | None = None
    walls: tuple[Array, ...] = ()
    path: Array | None = None
    same_as: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "landmarks", tuple(self.landmarks))
        object.__setattr__(self, "walls", tuple(frozen_array(wall) for wall in self.walls))
        if self.path is not None:
            object.__setattr__(self, "path", frozen_array(self.path))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.name, len(self.landmarks)))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)

    def __len__(self) -> int:
        return len(self.landmarks)

    def _repr_html_(self) -> str:
        from .notebook import map_html

        return map_html(self)

    def __getitem__(self, identifier: str) -> Landmark:
        """The landmark of that id; KeyError where there is none."""
        return self.landmarks[self.index_from_id[identifier]]

    def replace(self, **changes: Any) -> LandmarkMap:
        """A copy with some fields changed."""
        return replace(self, **changes)

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """Ids of all landmarks, in order."""
        return tuple(landmark.id for landmark in self.landmarks)

    @cached_property
    def index_from_id(self) -> Mapping[str, int]:
        """Place of each landmark in `landmarks`."""
        return {identifier: k for k, identifier in enumerate(self.ids)}

    @cached_property
    def positions(self) -> Array:
        """Positions (n, 2) [m] in the map's frame."""
        return frozen_array(np.array([(l.x, l.y) for l in self.landmarks], dtype=float).reshape(-1, 2))

    @cached_property
    def types(self) -> tuple[str, ...]:
        """Types of all landmarks, in order."""
        return tuple(landmark.type for landmark in self.landmarks)

    @cached_property
    def start(self) -> Array:
        """Where the robot started, (3,) in the map's frame: the path's first pose, else the origin."""
        return frozen_array(self.path[0, 1:] if self.path is not None and len(self.path) else np.zeros(3))
