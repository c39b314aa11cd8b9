"""What the mapper remembers of the drive: keyframes, sightings, compass stations, path and wall pieces.

From these the map can be computed anew at any time, with everything that is known by then. All of it grows with
detections and metres, never with odometry events.
"""

from __future__ import annotations

import msgspec

from ..maps import LinkType
from .odometry import Motion

Pose = tuple[float, float, float]


class Arm(msgspec.Struct):
    """An arm of a landmark: direction ``off`` [rad] from the landmark's own, readings of it, votes for its type."""

    off: float
    count: int
    votes: dict[LinkType, int]

    @property
    def type(self) -> LinkType:
        """The type that was sensed most often; what was sensed as unknown has no say."""
        known = [name for name in sorted(self.votes) if name != "unknown"]
        return max(known, key=lambda name: self.votes[name], default="unknown")

    @property
    def passable(self) -> bool | None:
        """Whether a way goes on along it; None where that was never sensed."""
        kind = self.type
        return None if kind == "unknown" else kind != "blocked"


class Known(msgspec.Struct):
    """A landmark of the map so far.

    ``at``: where x, y stand in the filter's state; ``turn``: where its direction does (None: no arms). ``sightings``:
    which of the memory's are of it. ``name``: the id that detections carried. ``first``, ``last`` [m]: where on the
    way it was seen first and last. ``way``, ``heading``: where the robot was, and how it stood, at the last sighting
    that counted.
    """

    key: int
    type: str
    at: int
    turn: int | None
    first: float
    last: float
    name: str | None = None
    arms: list[Arm] = []
    sightings: list[int] = []
    rejected: int = 0
    way: float = -1e9
    heading: float = 0.0


class Keyframe(msgspec.Struct, frozen=True):
    """A pose of the robot that is estimated: time [s], way until then [m], and the motion since the one before."""

    t: float
    way: float
    motion: Motion


class Sighting(msgspec.Struct):
    """A detection that was taken for a landmark.

    ``u``, ``v`` [m]: ahead and left of the keyframe's pose, covariance ``uu``, ``uv``, ``vv``; ``arms``: index of the
    landmark's arm and bearing [rad]; ``event``: its number among the log's detections.
    """

    keyframe: int
    landmark: int
    u: float
    v: float
    uu: float
    uv: float
    vv: float
    arms: list[tuple[int, float]]
    event: int


class Station(msgspec.Struct, frozen=True):
    """A compass reading: at a keyframe, of a ``node`` of the bend, ``heading`` [rad] with ``variance`` [rad^2]."""

    keyframe: int
    node: int
    heading: float
    variance: float


class Waypoint(msgspec.Struct, frozen=True):
    """A place on the way: time, way until there [m], keyframe, and the pose seen from it."""

    t: float
    way: float
    keyframe: int
    x: float
    y: float
    theta: float


class Piece(msgspec.Struct, frozen=True):
    """A straight piece of wall, from a scan: its ends seen from a keyframe [m], and how many readings lie on it.

    ``here``: whether the robot stood where the keyframe is.
    """

    keyframe: int
    x1: float
    y1: float
    x2: float
    y2: float
    readings: int
    here: bool = False


class Hit(msgspec.Struct, frozen=True):
    """One reading of a scan of few beams: numbers of scan and beam, and its end seen from a keyframe [m]."""

    keyframe: int
    scan: int
    beam: int
    x: float
    y: float


class Memory(msgspec.Struct):
    """All of it. ``poses``: the keyframes in the map's frame as they are taken to be by now."""

    keyframes: list[Keyframe] = []
    poses: list[Pose] = []
    sightings: list[Sighting] = []
    stations: list[Station] = []
    nodes: list[tuple[float, float]] = []
    path: list[Waypoint] = []
    pieces: list[Piece] = []
    hits: list[Hit] = []
    scans: int = 0
