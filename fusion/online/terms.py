"""What one landmark of a growing map measures: the same measurements as of the whole map, from its neighbourhood."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.factors import CompassReading, HeadingPrior, LandmarkKey, LinkMeasurement, RangeMeasurement, RotationPin
from mapfuse.factors.compass import compass_readings
from mapfuse.factors.heading import heading_measurements
from mapfuse.factors.link import link_measurements
from mapfuse.factors.measurement import Measurement

from .segment import Segment, without_strangers


class Terms(NamedTuple):
    """Of one landmark: its direction, its compass readings, and its links by the landmark at the other end."""

    heading: tuple[HeadingPrior | RotationPin, ...]
    compass: tuple[CompassReading, ...]
    links: dict[str, tuple[LinkMeasurement | RangeMeasurement, ...]]

    def ties(self, other: str) -> bool:
        """Whether its links determine where it lies to another landmark: by distance and direction."""
        return any(isinstance(m, LinkMeasurement) for m in self.links[other])


def neighbourhood(segment: Segment, name: str, others: Iterable[str]) -> LandmarkMap:
    """A landmark and those linked to it as a map in local coordinates, without links to any others."""
    landmark = segment.local(name)
    assert landmark is not None
    near = {other: l for other in sorted(others) if (l := segment.local(other)) is not None}
    own = without_strangers(landmark, {*near, name})
    back = tuple(without_strangers(l, {name}) for l in near.values())
    return LandmarkMap(segment.name, (own, *back), noise=segment.noise, path=segment.local_path)


def terms_of(
    near: LandmarkMap, name: str, r: int, joined: frozenset[str] = frozenset(), turned: frozenset[str] = frozenset()
) -> Terms:
    """What the landmark ``name`` measures in its `neighbourhood`, as map ``r``.

    Of ``joined`` landmarks a joint covariance says where they lie to each other, of ``turned`` ones how they are
    turned, too, and together what their compass readings say (`mapfuse.factors.compass.compass_readings`).
    """
    key = LandmarkKey(r, name)
    heading = tuple(m for m in heading_measurements(near, r, turned) if m.b == key)
    compass = () if name in turned else tuple(m for m in compass_readings(near, r) if m.b == key)
    links: dict[str, list[LinkMeasurement | RangeMeasurement]] = {}
    for m in link_measurements(near, r):
        a, b = m.unknowns
        if key not in (a, b):
            continue
        other = b if a == key else a
        assert isinstance(other, LandmarkKey)
        if not (name in joined and other.id in joined):
            links.setdefault(other.id, []).append(m)
    return Terms(heading, compass, {other: tuple(found) for other, found in links.items()})


def stripped(landmark: Landmark) -> Landmark:
    """A landmark with arms only."""
    return without_strangers(landmark, set())


def all_of(terms: Iterable[tuple[Measurement, ...]]) -> list[Measurement]:
    """Measurements in a row."""
    return [m for part in terms for m in part]
