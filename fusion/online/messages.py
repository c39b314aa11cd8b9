"""What a robot says of its map while it drives: small values, each with a number of its own.

A message says what *is*, never what to add to something, so that one that comes twice or late changes nothing: of
each landmark, link and pose the message with the highest ``sequence`` holds, and a `Correction` holds against all
that were sent before it. In whichever order messages come, and however often, the map is the same at the end.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import isfinite
from numbers import Integral, Real
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.errors import MapError, MapfuseError, Problem
from mapfuse.datasets.jsondata import said
from mapfuse.datasets.logs import LARGEST
from mapfuse.datasets.mapfields import NOISE
from mapfuse.datasets.mapfile import validate
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.rules import MAX_COUNT, covariance_fault
from mapfuse.datasets.values import frozen_array

from ..groups import strays

Array = NDArray[np.float64]

#: Larger numbers are not the variance of a place [m^2, rad^2].
LARGEST_VARIANCE = 1e12
#: What a message holds besides numbers.
_KINDS: dict[str, type] = {"landmark": Landmark, "link": Link, "map": LandmarkMap, "id": str}


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
        robot: Any = self.robot
        t: Any = self.t
        if not isinstance(robot, str) or not robot:
            raise self.wrong(f"its robot must be a name, not {said(robot)}")
        if not isinstance(t, Real):
            raise self.wrong(f"its time must be a number, not {said(t)}")
        if not isfinite(t):
            raise self.wrong("its time is not finite")
        for name in ("sequence", "frame"):
            number = getattr(self, name)
            if type(number) is bool or not isinstance(number, Integral):
                raise self.wrong(f"its {name} must be a whole number, not {said(number)}")
            object.__setattr__(self, name, int(number))
        if not (0 <= self.sequence <= MAX_COUNT and 0 <= self.frame <= MAX_COUNT):
            raise self.wrong("sequence and frame count from 0")
        for name, kind in _KINDS.items():
            if hasattr(self, name) and not isinstance(value := getattr(self, name), kind):
                raise self.wrong(f"its {name} must be a {kind.__name__}, not {said(value)}")

    def wrong(self, reason: str) -> MapfuseError:
        """The error that says so of this message."""
        return MapfuseError(f"message {self.sequence} of {self.robot!r}: {reason}")


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
            try:
                object.__setattr__(self, name, frozen_array(getattr(self, name)))
            except (TypeError, ValueError) as error:
                raise self.wrong(f"its {name} must be an array of numbers") from error
        if not all(isinstance(name, str) for name in self.order):
            raise self.wrong("its order must be ids of landmarks")
        n = len(self.order)
        shapes = self.pose.shape, self.positions.shape, self.covariance.shape
        if shapes != ((3,), (n, 2), (3 + 2 * n, 3 + 2 * n)):
            raise self.wrong("a pose needs (3,), n landmarks (n, 2), and a covariance (3 + 2n, 3 + 2n)")
        if not all(np.isfinite(values).all() for values in (self.pose, self.covariance, self.positions)):
            raise self.wrong("its pose is not finite")
        if max(np.abs(self.pose).max(), np.abs(self.positions).max(initial=0.0)) > LARGEST:
            raise self.wrong(f"its pose or a landmark of it is beyond {LARGEST:g}, where no map is")
        if np.abs(self.covariance).max() > LARGEST_VARIANCE:
            raise self.wrong(f"the covariance of its pose holds numbers beyond {LARGEST_VARIANCE:g}")
        if (fault := covariance_fault(self.covariance)) is not None:
            raise self.wrong(f"the covariance of its pose {fault}")


Message: TypeAlias = LandmarkSeen | LandmarkLink | Removed | Correction | Placed


def check_message(message: Message) -> None:
    """Raise `MapError` where what a message says breaks a rule of ``mapfuse.map/1``.

    A link may lead to a landmark that isn't there yet.
    """
    if isinstance(message, Correction):
        m = message.map
        problems = _other_kinds(m.landmarks) or validate(m) or beyond(m.landmarks, m.noise) or strays(m)
    elif isinstance(message, LandmarkSeen):
        alone = (message.landmark,)
        problems = _other_kinds(alone) or _alone(message.landmark) or beyond(alone)
    elif isinstance(message, LandmarkLink):
        problems = _alone(Landmark(message.id, "door", 0.0, 0.0, links=(message.link,)))
    else:
        return
    if problems:
        raise MapError(message.robot, problems)


def beyond(landmarks: Iterable[Landmark], noise: Noise | None = None) -> tuple[Problem, ...]:
    """Landmarks and standard deviations beyond `LARGEST`, which the format allows, and nothing can be computed with."""
    problems = [
        Problem(f"landmarks[{k}]", f"{said(l.id)} lies beyond {LARGEST:g} m")
        for k, l in enumerate(landmarks)
        if abs(l.x) > LARGEST or abs(l.y) > LARGEST
    ]
    problems += [
        Problem(f"landmarks[{k}].covariance", f"holds numbers beyond {LARGEST_VARIANCE:g}")
        for k, l in enumerate(landmarks)
        if l.covariance is not None and np.abs(l.covariance).max(initial=0.0) > LARGEST_VARIANCE
    ]
    sigmas: dict[str, Any] = {} if noise is None else {name: getattr(noise, name) for name in NOISE}
    problems += [
        Problem(f"noise.{name}", f"is beyond {LARGEST:g}")
        for name, sigma in sigmas.items()
        if sigma is not None and sigma > LARGEST
    ]
    return tuple(problems)


def _other_kinds(landmarks: Iterable[Any]) -> tuple[Problem, ...]:
    """What should be a landmark or a link of one, and isn't."""
    for k, landmark in enumerate(landmarks):
        if not isinstance(landmark, Landmark):
            return (Problem(f"landmarks[{k}]", f"must be a Landmark, not {said(landmark)}"),)
        links: tuple[Any, ...] = landmark.links
        for m, link in enumerate(links):
            if not isinstance(link, Link):
                return (Problem(f"landmarks[{k}].links[{m}]", f"must be a Link, not {said(link)}"),)
    return ()


def _alone(landmark: Landmark) -> tuple[Problem, ...]:
    """What is wrong with a landmark, where its links lead left aside."""
    targets = {link.connected_to_id for link in landmark.links} - {None, landmark.id}
    there = (Landmark(str(target), "door", 0.0, 0.0) for target in sorted(map(str, targets)))
    return validate(LandmarkMap("map", (landmark, *there)))
