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

from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.values import frozen_array

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
    """Where the robot is: ``pose`` (3,) x, y [m], theta [rad] in its map's frame, ``covariance`` (3, 3) in its axes.

    ``order``, ``cross`` (3, 2n): covariance of the pose with x, y of these landmarks, where it is known.
    """

    pose: Array
    covariance: Array
    order: tuple[str, ...] = ()
    cross: Array = field(default_factory=lambda: np.zeros((3, 0)))

    def __post_init__(self) -> None:
        super(Placed, self).__post_init__()
        for name in ("pose", "covariance", "cross"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))
        shapes = (self.pose.shape, self.covariance.shape, self.cross.shape)
        if shapes != ((3,), (3, 3), (3, 2 * len(self.order))):
            raise MapfuseError(f"message {self.sequence} of {self.robot!r}: a pose needs (3,), (3, 3) and (3, 2n)")
        if not (np.isfinite(self.pose).all() and np.isfinite(self.covariance).all() and np.isfinite(self.cross).all()):
            raise MapfuseError(f"message {self.sequence} of {self.robot!r}: its pose is not finite")


Message: TypeAlias = LandmarkSeen | LandmarkLink | Removed | Correction | Placed
