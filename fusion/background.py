"""How common landmarks are and how far to believe a recorded one: what matches and misses are measured against."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .coverage import SeenArea
from .prepared import PreparedMap


@dataclass(frozen=True, eq=False)
class Background:
    """How common landmarks are along the corridors (point landmarks: per area), from both maps together.

    A rate counts landmarks that are really there: those recorded, less the false ones, divided by the detection rate.
    """

    m1: PreparedMap
    m2: PreparedMap

    @cached_property
    def points1(self) -> NDArray[np.bool_]:
        """Which landmarks of map 1 are point landmarks."""
        return _point_like(self.m1)

    @cached_property
    def points2(self) -> NDArray[np.bool_]:
        """Which landmarks of map 2 are point landmarks."""
        return _point_like(self.m2)

    @cached_property
    def area1(self) -> SeenArea:
        """Where robot 1 would have seen point landmarks."""
        return SeenArea.of(self.m1, np.flatnonzero(self.points1))

    @cached_property
    def area2(self) -> SeenArea:
        """Where robot 2 would have seen point landmarks."""
        return SeenArea.of(self.m2, np.flatnonzero(self.points2))

    @cached_property
    def rate(self) -> dict[str, float]:
        """True landmarks per metre of corridor, by label (see `label`)."""
        length = self.m1.corridor_length + self.m2.corridor_length
        return self._rates(~self.points1, ~self.points2, max(length, 1.0))

    @cached_property
    def area_rate(self) -> dict[str, float]:
        """True point landmarks per square metre, by label."""
        area = self.area1.area() + self.area2.area()
        return self._rates(self.points1, self.points2, max(area, 1.0))

    def rate_of(self, m: PreparedMap, k: int) -> float:
        """True landmarks like landmark ``k`` of one of the two maps: per metre of corridor, or per m^2 for points."""
        point = self.points1[k] if m is self.m1 else self.points2[k]
        return (self.area_rate if point else self.rate)[label(m, k)]

    def _rates(self, of1: NDArray[np.bool_], of2: NDArray[np.bool_], extent: float) -> dict[str, float]:
        expected: defaultdict[str, float] = defaultdict(float)
        for m, chosen in ((self.m1, of1), (self.m2, of2)):
            for k in np.flatnonzero(chosen).tolist():
                expected[label(m, k)] += (1 - false_alarm(m, k)) / max(m.map.noise.detection(m.map.types[k]), 1e-3)
        return {name: count / extent for name, count in expected.items()}


def _point_like(m: PreparedMap) -> NDArray[np.bool_]:
    """Landmarks that stand in the open rather than on a corridor: without arms and without links."""
    linked = {k for pair in m.corridors.tolist() for k in pair}
    return np.array([not m.has_arms[k] and k not in linked for k in range(len(m))], dtype=bool)


def label(m: PreparedMap, k: int) -> str:
    """What a landmark is compared by."""
    return m.map.types[k]


def false_alarm(m: PreparedMap, k: int) -> float:
    """Probability that a recorded landmark isn't there: the robot's rate to the power of the detections.

    Never quite 0 or 1, whatever the map states: no evidence is infinite.
    """
    landmark = m.map.landmarks[k]
    if landmark.existence is not None:
        rate = 1 - landmark.existence
    else:
        rate = m.map.noise.false_alarm(landmark.type) ** max(1, landmark.detection_counter)
    return min(max(rate, 1e-9), 1 - 1e-9)
