"""How common landmarks are and how far to believe a recorded one: what matches and misses are measured against."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapfuse.datasets.arms import Kind, signature
from mapfuse.datasets.maps import CORNER, SPATIAL_TYPES

from .coverage import SeenArea, Segments, bare_crossings, passing_kernels
from .prepared import PreparedMap
from .regularity import Gaps, Regularity, corridor_kernels

Array = NDArray[np.float64]

#: Ways a landmark of a kind can lie on a corridor; a match by chance hits one of them.
ORIENTATIONS = {Kind.CORNER: 4, Kind.T_JUNCTION: 4, Kind.END: 2, Kind.DOOR: 2, Kind.CORRIDOR: 1, Kind.CROSSING: 1}
#: Landmarks that are added to those seen of each kind, so that one seen once is not that rare.
KIND_DOUBT = 2.0
#: Share of the places where corridors cross that no landmark marks (a bridge, a hall), taken from so many such places.
BRIDGES, BRIDGES_FROM = 0.02, 10


@dataclass(frozen=True, eq=False)
class Background:
    """How common landmarks are along the corridors (point landmarks: per area), from both maps together.

    A rate counts landmarks that are really there: those recorded, less the false ones, divided by the detection rate.
    ``repeated``: what was found of the building lying on itself (`mapfuse.fusion.repetition.repeats`).
    """

    m1: PreparedMap
    m2: PreparedMap
    repeated: dict[Hashable, Array] = field(default_factory=dict, repr=False)
    _regularity: dict[float, Regularity] = field(default_factory=dict, repr=False)

    @cached_property
    def of_each(self) -> tuple[Background, Background]:
        """Of map 1 with itself and of map 2 with itself."""
        return Background(self.m1, self.m1), Background(self.m2, self.m2)

    @cached_property
    def points1(self) -> NDArray[np.bool_]:
        """Which landmarks of map 1 are point landmarks (n1,)."""
        return _point_like(self.m1)

    @cached_property
    def points2(self) -> NDArray[np.bool_]:
        """Which landmarks of map 2 are point landmarks (n2,)."""
        return _point_like(self.m2)

    @cached_property
    def corners1(self) -> NDArray[np.bool_]:
        """Which landmarks of map 1 are corners or ends of corridors by their type (n1,)."""
        return np.array([name == CORNER for name in self.m1.map.types], dtype=bool)

    @cached_property
    def corners2(self) -> NDArray[np.bool_]:
        """Which landmarks of map 2 are corners or ends of corridors by their type (n2,)."""
        return np.array([name == CORNER for name in self.m2.map.types], dtype=bool)

    @cached_property
    def spatial1(self) -> NDArray[np.bool_]:
        """Which landmarks of map 1 are corners or junctions (n1,)."""
        return np.array([name in SPATIAL_TYPES for name in self.m1.map.types], dtype=bool)

    @cached_property
    def spatial2(self) -> NDArray[np.bool_]:
        """Which landmarks of map 2 are corners or junctions (n2,)."""
        return np.array([name in SPATIAL_TYPES for name in self.m2.map.types], dtype=bool)

    @cached_property
    def has_points(self) -> bool:
        """Whether either map has point landmarks."""
        return bool(self.points1.any() or self.points2.any())

    @cached_property
    def ways(self) -> tuple[Any, Any]:
        """Both robots' ways as the compiled loops take them (`_passing_kernels.Ways`)."""
        sides = ((self.m1, self.corners1, self.spatial1), (self.m2, self.corners2, self.spatial2))
        one, two = (
            passing_kernels().Ways(m.positions, m.corridors, m.arm_headings, m.arm_passable, corners, spatial)
            for m, corners, spatial in sides
        )
        return one, two

    @cached_property
    def corridors(self) -> tuple[Any, Any]:
        """Both maps' corridors as the compiled loops take them (`_corridor_kernels.Corridors`)."""
        of = corridor_kernels().Corridors
        one, two = (of(m.positions, m.corridors, m.arm_headings, m.arm_passable) for m in (self.m1, self.m2))
        return one, two

    @cached_property
    def area1(self) -> SeenArea:
        """Where robot 1 would have seen point landmarks."""
        return SeenArea.of(self.m1, np.flatnonzero(self.points1))

    @cached_property
    def area2(self) -> SeenArea:
        """Where robot 2 would have seen point landmarks."""
        return SeenArea.of(self.m2, np.flatnonzero(self.points2))

    @cached_property
    def bridges(self) -> float:
        """Share of the places where corridors cross that no landmark marks (a bridge, a hall).

        Learnt where a robot crossed its own way without recording anything.
        """
        ways = [(Segments.of(m, m.positions), m.positions) for m in (self.m1, self.m2)]
        bare = sum(len(bare_crossings(way, way, landmarks)) for way, landmarks in ways)
        return (BRIDGES * BRIDGES_FROM + bare) / (BRIDGES_FROM + bare)

    @cached_property
    def rate(self) -> dict[str, float]:
        """True landmarks per metre of corridor, by label (see `label`)."""
        length = self.m1.corridor_length + self.m2.corridor_length
        return self._rates(~self.points1, ~self.points2, max(length, 1.0))

    @cached_property
    def area_rate(self) -> dict[str, float]:
        """True point landmarks per square metre, by label."""
        area = self.area1.own_area + self.area2.own_area
        return self._rates(self.points1, self.points2, max(area, 1.0))

    @cached_property
    def rates1(self) -> Array:
        """True landmarks like each one of map 1 (n1,): [1/m] of corridor, or [1/m^2] for points."""
        return self._rates_of(self.m1, self.points1)

    @cached_property
    def rates2(self) -> Array:
        """True landmarks like each one of map 2 (n2,): [1/m] of corridor, or [1/m^2] for points."""
        return self._rates_of(self.m2, self.points2)

    @cached_property
    def common(self) -> float:
        """Landmarks per metre of corridor that both robots record where both pass [1/m]."""
        return self._recorded_by_both(self.rate)

    @cached_property
    def area_common(self) -> float:
        """Point landmarks per square metre that both robots record where both look [1/m^2]."""
        return self._recorded_by_both(self.area_rate)

    @cached_property
    def there1(self) -> Array:
        """Log probability that each landmark of map 1 is there (n1,)."""
        return np.log1p(-self.m1.false)

    @cached_property
    def there2(self) -> Array:
        """Log probability that each landmark of map 2 is there (n2,)."""
        return np.log1p(-self.m2.false)

    @cached_property
    def recorded1(self) -> Array:
        """Probability (n1,) that robot 2, passing, records a landmark that stands in map 1."""
        return recorded_rates(self.m1, self.m2)

    @cached_property
    def recorded2(self) -> Array:
        """Probability (n2,) that robot 1, passing, records a landmark that stands in map 2."""
        return recorded_rates(self.m2, self.m1)

    @cached_property
    def unseen1(self) -> Array:
        """Probability (n1,) of what robot 2 shows at each landmark of map 1 that it passed and didn't record: it isn't
        there, or robot 2 went straight on and missed it."""
        return unseen_rates(self.m1, self.m2)

    @cached_property
    def unseen2(self) -> Array:
        """The same of the landmarks of map 2 where robot 1 goes straight on (n2,)."""
        return unseen_rates(self.m2, self.m1)

    @cached_property
    def both1(self) -> Array:
        """Probability (n1,) that both robots, passing, record a landmark like each one of map 1."""
        noise1, noise2 = self.m1.map.noise, self.m2.map.noise
        return np.array([noise1.detection(name) * noise2.detection(name) for name in self.m1.map.types], dtype=float)

    @cached_property
    def ways1(self) -> Array:
        """Log number of ways in which each landmark of map 1 could lie on its corridor (n1,)."""
        return np.log([float(ORIENTATIONS.get(kind, 1)) for kind in self.kinds[0]])

    @cached_property
    def kinds(self) -> tuple[tuple[Kind, ...], tuple[Kind, ...]]:
        """What the arms of every landmark of either map say it is."""
        one, two = (tuple(signature(landmark).kind for landmark in m.map.landmarks) for m in (self.m1, self.m2))
        return one, two

    @cached_property
    def worth(self) -> Any:
        """What matches along corridors are worth, as the compiled loops take it (`_corridor_kernels.Worth`)."""
        order = tuple(Kind)
        kind1, kind2 = (np.array([order.index(kind) for kind in kinds], dtype=np.intp) for kinds in self.kinds)
        return corridor_kernels().Worth(
            *(self.points1, self.points2, self.there1, self.there2, kind1, kind2),
            *(self.rates1, self.ways1, self.rarity1, self.both1),
        )

    @cached_property
    def rarity1(self) -> Array:
        """-log of the share (n1,) that the kind of each landmark of map 1 has of those of its label, in both maps."""
        of_kind: defaultdict[tuple[str, Kind], float] = defaultdict(float)
        of_label: defaultdict[str, float] = defaultdict(float)
        for m, kinds in zip((self.m1, self.m2), self.kinds, strict=True):
            for name, kind, false in zip(m.map.types, kinds, m.false.tolist(), strict=True):
                of_kind[name, kind] += 1 - false
                of_label[name] += 1 - false
        of_its = zip(self.m1.map.types, self.kinds[0], strict=True)
        shares = [(of_kind[name, kind] + KIND_DOUBT) / (of_label[name] + KIND_DOUBT) for name, kind in of_its]
        return np.asarray(-np.log(np.array(shares, dtype=float)))

    @cached_property
    def labels(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The label of every landmark of either map as a number."""
        numbers = {name: k for k, name in enumerate(sorted({*self.m1.map.types, *self.m2.map.types}))}
        one, two = ([numbers[name] for name in m.map.types] for m in (self.m1, self.m2))
        return np.array(one, dtype=np.intp), np.array(two, dtype=np.intp)

    def regularity(self, angle: float) -> Regularity:
        """How regularly the building is laid out; corridors go straight on within ``angle`` [rad]."""
        found = self._regularity.get(angle)
        if found is None:
            gaps = [Gaps.of(m, label, angle) for m, label in zip((self.m1, self.m2), self.labels, strict=True)]
            found = self._regularity[angle] = Regularity(gaps[0], gaps[1])
        return found

    def _rates(self, of1: NDArray[np.bool_], of2: NDArray[np.bool_], extent: float) -> dict[str, float]:
        expected: defaultdict[str, float] = defaultdict(float)
        for m, chosen in ((self.m1, of1), (self.m2, of2)):
            there = 1 - m.false
            for k in np.flatnonzero(chosen).tolist():
                expected[label(m, k)] += float(there[k]) / max(m.map.noise.detection(m.map.types[k]), 1e-3)
        return {name: count / extent for name, count in expected.items()}

    def _rates_of(self, m: PreparedMap, points: NDArray[np.bool_]) -> Array:
        area = self.area_rate if points.any() else {}
        return np.array([(area if point else self.rate)[label(m, k)] for k, point in enumerate(points)], dtype=float)

    def _recorded_by_both(self, rates: dict[str, float]) -> float:
        noise1, noise2 = self.m1.map.noise, self.m2.map.noise
        return sum(rate * noise1.detection(name) * noise2.detection(name) for name, rate in rates.items())


def _point_like(m: PreparedMap) -> NDArray[np.bool_]:
    """Landmarks that stand in the open rather than on a corridor: without arms and without links."""
    linked = np.zeros(len(m), dtype=bool)
    linked[m.corridors.ravel()] = True
    return ~m.has_arms & ~linked


def label(m: PreparedMap, k: int) -> str:
    """What a landmark is compared by."""
    return m.map.types[k]


def recorded_rates(m: PreparedMap, other: PreparedMap) -> Array:
    """Probability (n,) that the other robot, passing, records each landmark that stands in this map."""
    detection = np.array([other.map.noise.detection(name) for name in m.map.types], dtype=float)
    return np.asarray(np.clip((1 - m.false) * detection, 1e-6, 1 - 1e-6))


def unseen_rates(m: PreparedMap, other: PreparedMap) -> Array:
    """Probability (n,) that each landmark of a map isn't there, or is, and the other robot goes straight on without
    recording it."""
    unseen = [(1 - other.map.noise.detection(name)) * other.goes_straight(name) for name in m.map.types]
    return np.asarray(np.clip(m.false + (1 - m.false) * np.array(unseen, dtype=float), 1e-6, 1 - 1e-6))
