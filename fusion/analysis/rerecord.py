"""`Drives`: two robots' drives through one simulated floor, recorded as often as one likes, always with new errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.simulation import (
    MILKA,
    VESPUCCI,
    Floor,
    FloorKind,
    Robot,
    Route,
    SimulationError,
    explore,
    make_floor,
    record,
)
from mapfuse.datasets.simulation.pairs import truth_of
from mapfuse.datasets.truth import Truth

_TRIES = 500


@dataclass(frozen=True, eq=False)
class Drives:
    """Where two robots drove on a simulated floor, and what they are.

    Floor and routes stay; each recording has errors, misses and false alarms of its own.

    >>> drives = Drives.drawn(3, min_common=8)
    >>> (map1, map2, truth), (again, _, _) = (drives.pair(np.random.default_rng(seed)) for seed in (0, 1))
    >>> map1.name, map2.name, set(again.ids) == set(map1.ids)
    ('A', 'B', False)
    """

    floor: Floor
    routes: tuple[Route, Route]
    robots: tuple[Robot, Robot] = (VESPUCCI, MILKA)

    @classmethod
    def drawn(
        cls,
        seed: int,
        kind: FloorKind = "irregular",
        *,
        share: tuple[float, float] = (0.4, 0.9),
        min_common: int = 8,
        robots: tuple[Robot, Robot] = (VESPUCCI, MILKA),
    ) -> Drives:
        """Floor and routes from a seed; each robot explores a ``share`` of the corridors drawn between these bounds.

        ``min_common``: places that are on both routes. Raises `SimulationError` where no such routes came about.
        """
        rng = np.random.default_rng(seed)
        for _ in range(_TRIES):
            floor = make_floor(kind, rng)
            one, other = (explore(floor, rng, float(rng.uniform(*share))) for _ in range(2))
            drives = cls(floor, (one, other), robots)
            if drives.common >= min_common:
                return drives
        raise SimulationError(f"no routes with {min_common} common places came about in {_TRIES} draws")

    @property
    def common(self) -> int:
        """How many places both robots pass."""
        return len(set(self.routes[0].places) & set(self.routes[1].places))

    def with_robots(self, *robots: Robot) -> Drives:
        """The same drives by other robots."""
        one, other = robots
        return replace(self, robots=(one, other))

    def pair(self, rng: np.random.Generator) -> tuple[LandmarkMap, LandmarkMap, Truth]:
        """The two maps ``A`` and ``B`` recorded once, and their truth."""
        recordings = [
            record(self.floor, route, robot, rng, name)
            for route, robot, name in zip(self.routes, self.robots, ("A", "B"), strict=True)
        ]
        one, other = recordings
        return one.map, other.map, truth_of(recordings, (self.floor, self.floor))
