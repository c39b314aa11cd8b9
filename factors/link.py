"""Links: where a landmark lies seen from another one that the robot travelled to (measurement model, rows 3 to 5).

A link is recorded at either end or at both; each end is a reading of its own, in the frame of the landmark there,
except for what the two ends share: a distance or a direction that stands equal at both is one reading, of which each
end carries half of the information. A link from a landmark to itself measures nothing and is left out, as is one with
a direction but no distance: without a distance nothing is known of how far the other end is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import atan2, cos, hypot, pi, sin, sqrt
from typing import Any, ClassVar

import gtsam
import numpy as np

from mapfuse.datasets.errors import MapError, MapfuseError, Problem
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link

from .axes import wrapped
from .heading import headings_of
from .keys import ByIdentity, KeyBook, LandmarkKey, Unknown, map_keys
from .measurement import Array, Between, Poses, squared_error
from .noise import LOOSE_ROTATION, TIGHT, PoseNoise

#: An arm and the recorded displacement that disagree by more belong to a bent link [rad].
BENT = float(np.deg2rad(20.0))
#: Headings at the two ends of a link that are opposite to within this are one reading [rad].
OPPOSITE = 1e-3
#: Smallest standard deviation of an arm's direction relative to its landmark's heading [rad].
LEAST_DIRECTION_SIGMA = 0.005
ROOT_2 = sqrt(2.0)

#: A landmark at one end of a link, and its unknown.
End = tuple[Landmark, LandmarkKey]


@dataclass(frozen=True, slots=True)
class LinkMeasurement(Between):
    """Landmark ``b`` seen from landmark ``a`` by the link recorded at ``a``; its rotation says nothing.

    ``bent``: a corner between them was not detected, so the recorded displacement stands in for distance and arm.
    ``readings``: how many independent numbers it stands for; of what both ends share, half of one.
    """

    bent: bool = False
    readings: float = 2.0


@dataclass(frozen=True, slots=True)
class RangeMeasurement:
    """The distance [m] between two landmarks, of a link whose direction was not recorded at either end.

    ``readings``: how many independent numbers it stands for; half of one where the other end says the same.
    """

    a: LandmarkKey
    b: LandmarkKey
    distance: float
    sigma: float
    readings: float = 1.0

    rows: ClassVar[int] = 1

    def __post_init__(self) -> None:
        if not (np.isfinite(self.distance) and self.distance >= 0 and np.isfinite(self.sigma) and self.sigma > 0):
            raise MapfuseError(f"the range {self.a}-{self.b} has a distance or sigma out of bounds: {self}")

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """``a`` and ``b``."""
        return self.a, self.b

    @property
    def log_normaliser(self) -> float:
        """Log of its density's factor [nats]."""
        return float(-np.log(self.sigma) - np.log(2 * np.pi) / 2)

    def residual(self, poses: Poses) -> Array:
        """The whitened residual (1,)."""
        length = np.linalg.norm(poses[self.b][:2] - poses[self.a][:2])
        return np.array([(length - self.distance) / self.sigma])

    def error(self, poses: Poses) -> float:
        """``|residual|^2 / 2`` [nats]."""
        return squared_error(self.residual(poses), None)

    def factor(self, keys: KeyBook) -> Any:
        """A ``RangeFactorPose2``."""
        model = gtsam.noiseModel.Isotropic.Sigma(1, self.sigma)
        return gtsam.RangeFactorPose2(keys.key(self.a), keys.key(self.b), self.distance, model)


class Ways:
    """The links of a map that have a distance, sorted once per landmark and looked up from both ends."""

    __slots__ = ("_between", "_from", "recorded")

    def __init__(self, recorded: LandmarkMap) -> None:
        self.recorded = recorded
        self._from: dict[str, tuple[tuple[Link, Landmark], ...]] = {}
        self._between: dict[str, dict[str, list[Link]]] = {}

    def leaving(self, landmark: Landmark) -> tuple[tuple[Link, Landmark], ...]:
        """As `travelled_links`."""
        found = self._from.get(landmark.id)
        if found is None:
            self._from[landmark.id] = found = tuple(_travelled(self.recorded, landmark))
        return found

    def between(self, landmark: Landmark, far: str) -> list[Link]:
        """The links that a landmark recorded to the landmark ``far``, in that order."""
        of_far = self._between.get(landmark.id)
        if of_far is None:
            self._between[landmark.id] = of_far = {}
            for link, target in self.leaving(landmark):
                of_far.setdefault(target.id, []).append(link)
        return of_far.get(far, [])


@lru_cache(maxsize=64)
def _ways(cached: ByIdentity) -> Ways:
    return Ways(cached.recorded)


def travelled_links(recorded: LandmarkMap, landmark: Landmark) -> tuple[tuple[Link, Landmark], ...]:
    """Links of a landmark with a distance to another landmark, and that landmark, in an order that the file's has
    no part in.

    Raises `MapError` where a link names a landmark that the map doesn't have.
    """
    return _ways(ByIdentity(recorded)).leaving(landmark)


def _travelled(recorded: LandmarkMap, landmark: Landmark) -> Iterator[tuple[Link, Landmark]]:
    order = [link for link in landmark.links if link.connected_to_id is not None and link.distance is not None]
    if len(order) > 1:
        order.sort(key=lambda l: (l.connected_to_id or "", l.distance or 0.0, l.heading is None, l.heading or 0.0))
    for link in order:
        place = recorded.index_from_id.get(link.connected_to_id or "")
        if place is None:
            reason = f"a link leads to {link.connected_to_id!r}, which is not in the map"
            raise MapError(recorded.name, (Problem(f"landmark {landmark.id}", reason),))
        if recorded.landmarks[place].id != landmark.id:
            yield link, recorded.landmarks[place]


def twin(recorded: LandmarkMap, landmark: Landmark, link: Link) -> Link | None:
    """The same link as the landmark at its other end recorded it, or None.

    Where two links join the same two landmarks, the twin is that of the nearest distance, then of the direction
    nearest to the opposite one.
    """
    return _twin(_ways(ByIdentity(recorded)), landmark, link, recorded[link.connected_to_id or ""])


def _twin(ways: Ways, landmark: Landmark, link: Link, far: Landmark) -> Link | None:
    """`twin`, ``far`` being the landmark at the other end."""
    back = ways.between(far, landmark.id)
    if len(back) < 2:
        return back[0] if back else None

    def unlike(other: Link) -> tuple[float, float]:
        gap = abs((other.distance or 0.0) - (link.distance or 0.0))
        if link.heading is None or other.heading is None:
            return gap, pi
        return gap, abs(wrapped(other.heading - link.heading - pi))

    return min(back, key=unlike)


def is_bent(recorded: LandmarkMap, landmark: Landmark, link: Link) -> bool:
    """Whether the robot turned a corner between the two landmarks of a link that it did not detect (row 5).

    So it is where the arm's heading at either end and the recorded displacement disagree by more than `BENT`: such
    a link is a diagonal that nobody travelled. A link without distance or heading is never called bent.

    >>> a = Landmark("a", "door", 0.0, 0.0, links=(Link("open", 0.0, None, "b", 7.0, 1),))
    >>> m = LandmarkMap("m", (a, Landmark("b", "door", 4.0, 3.0)))
    >>> is_bent(m, a, a.links[0])
    True
    """
    if link.heading is None or link.distance is None or link.connected_to_id in (None, landmark.id):
        return False
    return _is_bent(landmark, recorded[link.connected_to_id or ""], link, twin(recorded, landmark, link))


def _is_bent(landmark: Landmark, far: Landmark, link: Link, other: Link | None) -> bool:
    return _leaves_chord(landmark, far, link) or (other is not None and _leaves_chord(far, landmark, other))


def _leaves_chord(landmark: Landmark, far: Landmark, link: Link) -> bool:
    """Whether an arm points elsewhere than to where the far landmark was recorded."""
    if link.heading is None or (far.x == landmark.x and far.y == landmark.y):
        return False
    return abs(wrapped(_chord(landmark, far) - link.heading)) > BENT


def _chord(landmark: Landmark, far: Landmark) -> float:
    return atan2(far.y - landmark.y, far.x - landmark.x)


def link_measurements(recorded: LandmarkMap, r: int) -> Iterator[LinkMeasurement | RangeMeasurement]:
    """All that the links of map ``r`` measure, by landmark id.

    A link without heading at either end is a range, but only where the recorded positions bear out that it is
    straight (distance and recorded displacement within three standard deviations of each other).
    """
    keys, headings = map_keys(recorded, r).landmarks, headings_of(recorded)
    ways = _ways(ByIdentity(recorded))
    for identifier, key in keys.items():
        landmark = recorded[identifier]
        for link, far in ways.leaving(landmark):
            other, far_key = _twin(ways, landmark, link, far), keys[far.id]
            if link.heading is not None:
                ends = headings[identifier] or 0.0, headings[far.id] or 0.0
                yield _displacement(recorded, (landmark, key), (far, far_key), ends, link, other)
            elif other is None or other.heading is None or not _same_distance(link, other):
                found = _range(recorded, (landmark, key), (far, far_key), link, other)
                if found is not None:
                    yield found


def _same_distance(link: Link, other: Link) -> bool:
    return abs((link.distance or 0.0) - (other.distance or 0.0)) <= 1e-9 * max(1.0, link.distance or 0.0)


def _displacement(
    recorded: LandmarkMap, near: End, to: End, ends: tuple[float, float], link: Link, other: Link | None
) -> LinkMeasurement:
    """``ends``: headings [rad] of the two landmarks."""
    (landmark, key), (far, far_key), (h_i, h_j) = near, to, ends
    assert link.heading is not None
    assert link.distance is not None
    noise, d = recorded.noise, link.distance
    shares = other is not None and other.heading is not None
    bent = _is_bent(landmark, far, link, other)
    if bent:
        length, direction = hypot(far.x - landmark.x, far.y - landmark.y), _chord(landmark, far)
        along, across = noise.distance_sigma(d), d * noise.heading_sigma
        same_length = same_direction = shares
    else:
        length, direction = d, link.heading
        along = noise.distance_sigma(d, link.travel_counter)
        across = d * max(noise.heading_sigma / ROOT_2, LEAST_DIRECTION_SIGMA)
        same_length = same_direction = False
        if other is not None and other.heading is not None:
            same_length = _same_distance(link, other)
            same_direction = abs(wrapped(other.heading - link.heading - pi)) <= OPPOSITE
    along *= ROOT_2 if same_length else 1.0
    across *= ROOT_2 if same_direction else 1.0
    relative = direction - h_i
    turn = wrapped(h_j - h_i)
    measured = (length * cos(relative), length * sin(relative), turn)
    noise_ab = PoseNoise.from_axes(relative - turn, along, across, LOOSE_ROTATION)
    readings = 2.0 - 0.5 * same_length - 0.5 * same_direction
    return LinkMeasurement(key, far_key, measured, noise_ab, bent=bent, readings=readings)


def _range(recorded: LandmarkMap, near: End, to: End, link: Link, other: Link | None) -> RangeMeasurement | None:
    (landmark, key), (far, far_key) = near, to
    assert link.distance is not None
    noise = recorded.noise
    sigma = max(TIGHT, noise.distance_sigma(link.distance, link.travel_counter))
    chord = hypot(far.x - landmark.x, far.y - landmark.y)
    if abs(link.distance - chord) > 3 * np.sqrt(sigma**2 + 2 * noise.position_sigma**2):
        return None
    shared = other is not None and other.heading is None and _same_distance(link, other)
    sigma *= ROOT_2 if shared else 1.0
    return RangeMeasurement(key, far_key, link.distance, sigma, 0.5 if shared else 1.0)
