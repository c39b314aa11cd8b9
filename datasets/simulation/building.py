"""`Building`: a floor with walls and steel, and what a robot at a pose can sense of it.

Walls follow from the corridors. A door's landmark stands on the corridor's line, where a robot passes it, and the door
itself in the wall beside it, where the landmark's arm of type door points; the map-level simulator (`record`) has the
same places. Doors are closed: they are part of the walls.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se2
from ..values import frozen_array
from .floors import Floor, Place
from .generate import FloorKind, make_floor
from .raycast import cast, clear, distances, nearest_points
from .steel import Correlation, Steel, draw_steel
from .walls import floor_walls

Array = NDArray[np.float64]

#: Width [m] of a door in its wall, where no plan says it.
DOOR_WIDTH = 0.9


@dataclass(frozen=True, eq=False)
class Building:
    """``floor``: what there is to be mapped; ``walls`` (n, 2, 2): segments [m, world], closed doors among them.

    ``steel`` bends compasses by place; None: there is none.

    >>> from mapfuse.datasets.simulation import floor_from_graph
    >>> building = build(floor_from_graph("L", [(0, 0), (8, 0), (8, 6)], [(0, 1), (1, 2)]), steel_sigma=0)
    >>> building.ranges([4.0, 0.0, 0.0], [0.0, np.pi / 2], reach=10.0).round(6).tolist()
    [5.0, 1.0]
    >>> building.sees([4.0, 0.0, 0.0], reach=20.0, field_of_view=np.pi).tolist()
    [1]
    """

    floor: Floor
    walls: Array
    steel: Steel | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "walls", frozen_array(np.asarray(self.walls, dtype=float).reshape(-1, 2, 2)))

    @property
    def name(self) -> str:
        """The floor's name."""
        return self.floor.name

    @cached_property
    def steps(self) -> Array:
        """The corridors' lines from place to place (m, 2, 2) [m, world]."""
        places = self.floor.place_from_id
        lines = [(places[a].xy, places[b].xy) for c in self.floor.corridors for a, b in pairwise(c.places)]
        return frozen_array(np.array(lines, dtype=float).reshape(-1, 2, 2))

    @cached_property
    def doors(self) -> Array:
        """The doors as segments (m, 2, 2) [m, world] in their walls, in the order of the places that have them."""
        found = [
            self._door(place, arm.direction) for place in self.floor.places for arm in place.arms if arm.type == "door"
        ]
        return frozen_array(np.array(found, dtype=float).reshape(-1, 2, 2))

    def _door(self, place: Place, direction: float) -> Array:
        to_wall = float(cast(place.xy, [direction], self.walls)[0])
        middle = place.xy + (to_wall if np.isfinite(to_wall) else self.floor.width / 2) * _unit(direction)
        half = DOOR_WIDTH / 2 * _unit(direction + np.pi / 2)
        return np.array([middle - half, middle + half])

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Least x, least y, greatest x, greatest y [m, world] of walls and places."""
        points = np.vstack([self.walls.reshape(-1, 2), self.floor.positions])
        (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
        return float(x0), float(y0), float(x1), float(y1)

    def bend(self, points: ArrayLike) -> Array:
        """By how much [rad] steel turns compass readings at ``points`` (..., 2) [m, world]; 0 without steel."""
        if self.steel is None:
            return np.zeros(np.asarray(points).shape[:-1])
        return self.steel.bend(points)

    def ranges(self, pose: ArrayLike, bearings: ArrayLike, reach: float) -> Array:
        """Distance [m] to the nearest wall at ``bearings`` (k,) [rad] from the forward axis of ``pose`` (3,).

        Infinite where nothing stands within ``reach`` [m].
        """
        x, y, theta = np.asarray(pose, dtype=float)
        return cast([x, y], theta + np.asarray(bearings, dtype=float), self.walls, reach)

    def sees(self, pose: ArrayLike, reach: float, field_of_view: float = 2 * np.pi) -> NDArray[np.intp]:
        """Indices of the floor's places that a robot at ``pose`` (3,) can see, in order.

        Within ``reach`` [m], within half of ``field_of_view`` [rad] to either side, and with no wall in between.
        """
        x, y, theta = np.asarray(pose, dtype=float)
        away = self.floor.positions - (x, y)
        off = np.abs(se2.wrap(np.arctan2(away[:, 1], away[:, 0]) - theta))
        distance = np.hypot(away[:, 0], away[:, 1])
        # whoever stands on a place sees it, wherever he looks
        near = np.flatnonzero((distance <= reach) & ((off <= field_of_view / 2) | (distance < 1e-9)))
        return near[clear([x, y], self.floor.positions[near], self.walls)]

    def free(self, points: ArrayLike, radius: float = 0.0) -> NDArray[np.bool_]:
        """Whether discs of ``radius`` [m] at ``points`` (..., 2) [m, world] stand in a corridor, as (...).

        In a corridor is what is no further than half its width from its line, with no wall in between.
        """
        points = np.asarray(points, dtype=float)
        flat = points.reshape(-1, 2)
        near = nearest_points(flat, self.steps)
        away = np.hypot(*np.moveaxis(flat[:, None] - near, -1, 0))
        best = np.argmin(away, axis=1)
        inside = away[np.arange(len(flat)), best] <= self.floor.width / 2 - radius
        for k in np.flatnonzero(inside):
            inside[k] = bool(clear(near[k, best[k]], flat[k : k + 1], self.walls)[0])
        return np.asarray(inside & (self.clearance(flat) >= radius), dtype=bool).reshape(points.shape[:-1])

    def clearance(self, points: ArrayLike) -> Array:
        """Distance [m] from ``points`` (..., 2) [m, world] to the nearest wall, as (...)."""
        points = np.asarray(points, dtype=float)
        if not len(self.walls):
            return np.full(points.shape[:-1], np.inf)
        nearest = distances(points.reshape(-1, 2), self.walls).min(axis=1)
        return np.asarray(nearest.reshape(points.shape[:-1]), dtype=float)


def build(
    floor: Floor,
    *,
    steel_sigma: float = 0.15,
    steel_length: float = 4.0,
    correlation: Correlation = "gaussian",
    seed: int | np.random.Generator = 0,
) -> Building:
    """Walls around a floor's corridors, and steel drawn from ``seed``: see `draw_steel`; sigma 0 for no steel."""
    rng = np.random.default_rng(seed)
    steel = draw_steel(rng, steel_sigma, steel_length, correlation) if steel_sigma else None
    return Building(floor, floor_walls(floor), steel)


def make_building(kind: FloorKind, seed: int | np.random.Generator, name: str | None = None) -> Building:
    """A building of that kind, floor and steel drawn from one seed; KeyError for a kind that doesn't exist.

    The floor is `make_floor`'s of the same seed.

    >>> make_building("irregular", 3).floor == make_floor("irregular", np.random.default_rng(3))
    True
    """
    rng = np.random.default_rng(seed)
    return build(make_floor(kind, rng, name), seed=rng)


def _unit(direction: float) -> Array:
    return np.array([np.cos(direction), np.sin(direction)])
