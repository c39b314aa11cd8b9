"""What a robot says of its map while it drives: small values, each with a number of its own.

A message says what *is*, never what to add to something, so that one that comes twice or late changes nothing: of
each landmark, link and pose the message with the highest ``sequence`` holds, and a `Correction` holds against all
that were sent before it. In whichever order messages come, and however often, the map is the same at the end.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.errors import MapError, MapfuseError, Problem
from mapfuse.datasets.mapfile import validate
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.rules import covariance_fault
from mapfuse.datasets.values import frozen_array

from ..groups import strays

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Said:
    """``robot``: who says it. ``sequence``: its number, growing with each message of this robot. ``t`` [s]: when, on
    the clock that all robots share. ``frame``: which frame of that robot it is in: 0, and one more each time when it
    begins anew without knowing where it is."""

    robot: str
    sequence: int
    t: float
    frame: int = 0

    def __post_init__(self) -> None:
        if not isfinite(self.t):
            raise MapfuseError(f"message {self.sequence} of {self.robot!r}: its time is not finite")
        if self.sequence < 0 or self.frame < 0:
            raise MapfuseError(f"message {self.sequence} of {self.robot!r}: sequence and frame count from 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkSeen(_Said):
    """A landmark as the robot knows it by now, new or known, with its arms. A link may lead to one not yet sent."""

    landmark: Landmark


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkLink(_Said):
    """A way from the landmark ``id``, which may come later than this."""

    id: str
    link: Link


@dataclass(frozen=True, slots=True, kw_only=True)
class Removed(_Said):
    """The landmark ``id`` is none, or another one seen again."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Correction(_Said):
    """The whole map as the robot knows it by now, all earlier messages of this frame included."""

    map: LandmarkMap


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed(_Said):
    """Where the robot is: ``pose`` (3,) x, y [m], theta [rad] in its map's frame, ``covariance`` in its axes.

    ``order``: landmarks that it knows its place by, at ``positions`` (n, 2) [m] as it has them at that moment;
    ``covariance`` (3 + 2n, 3 + 2n) is that of the pose and of these together, in that order. None need be given.
    """

    pose: Array
    covariance: Array
    order: tuple[str, ...] = ()
    positions: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        super(Placed, self).__post_init__()
        for name in ("pose", "covariance", "positions"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))
        n = len(self.order)
        if (self.pose.shape, self.covariance.shape) != ((3,), (3 + 2 * n, 3 + 2 * n)) or len(self.positions) != n:
            reason = "a pose needs (3,), n landmarks (n, 2), and a covariance (3 + 2n, 3 + 2n)"
            raise MapfuseError(f"message {self.sequence} of {self.robot!r}: {reason}")
        if not all(np.isfinite(values).all() for values in (self.pose, self.covariance, self.positions)):
            raise MapfuseError(f"message {self.sequence} of {self.robot!r}: its pose is not finite")
        if (fault := covariance_fault(self.covariance)) is not None:
            raise MapfuseError(f"message {self.sequence} of {self.robot!r}: the covariance of its pose {fault}")


Message: TypeAlias = LandmarkSeen | LandmarkLink | Removed | Correction | Placed


def check_message(message: Message) -> None:
    """Raise `MapError` where what a message says breaks a rule of ``mapfuse.map/1``.

    A link may lead to a landmark that isn't there yet.
    """
    if isinstance(message, Correction):
        problems = validate(message.map) or strays(message.map)
    elif isinstance(message, LandmarkSeen):
        problems = _alone(message.landmark)
    elif isinstance(message, LandmarkLink):
        problems = _alone(Landmark(message.id, "door", 0.0, 0.0, links=(message.link,)))
    else:
        return
    if problems:
        raise MapError(message.robot, problems)


def _alone(landmark: Landmark) -> tuple[Problem, ...]:
    """What is wrong with a landmark, where its links lead left aside."""
    targets = {link.connected_to_id for link in landmark.links} - {None, landmark.id}
    there = (Landmark(str(target), "door", 0.0, 0.0) for target in sorted(map(str, targets)))
    return validate(LandmarkMap("map", (landmark, *there)))
