"""A simulated city of floors: many buildings, each mapped by several robots, with what is true of each map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.simulation import MILKA, VESPUCCI, explore, irregular_floor, record

#: What a robot explores of a floor, at least and at most.
SHARE = (0.5, 0.9)


@dataclass(frozen=True, eq=False, slots=True)
class CityMap:
    """A simulated map, its building, and the true place of each landmark."""

    map: LandmarkMap
    building: int
    place_from_id: Mapping[str, str | None]

    @property
    def places(self) -> frozenset[str]:
        """True places in the map."""
        return frozenset(place for place in self.place_from_id.values() if place is not None)


def city(seed: int, buildings: int, maps_each: int, first: int = 0) -> Iterator[CityMap]:
    """Maps of one floor after the other; each floor has its own random numbers, so that a city can grow."""
    for b in range(first, first + buildings):
        rng = np.random.default_rng([seed, b])
        floor = irregular_floor(rng)
        for k in range(maps_each):
            robot = (VESPUCCI, MILKA)[k % 2].with_compass(False)
            recording = record(floor, explore(floor, rng, float(rng.uniform(*SHARE))), robot, rng, f"b{b:04d}-{k:02d}")
            yield CityMap(recording.map, b, recording.place_from_id)
