"""The hospital pair (section 4.2 of the paper): the merged walls over the plan, and how true lengths along them are.

The paper lays the merged map over the floor plan as a whole and finds every wall within 1 m over more than 50 m, "about
2 %". The same here: the best rigid motion of all merged landmarks onto their true places, then distances of walls from
the plan's, in percent of how far the map reaches. A length over more than 50 m that the map tells is a stricter figure,
since an error in scale shows up in it whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

from mapfuse.datasets import se2
from mapfuse.datasets.maps import LandmarkMap
from mapfuse.datasets.paper import HOSPITAL_CORRIDOR
from mapfuse.datasets.simulation.building import Building
from mapfuse.datasets.simulation.raycast import distances
from mapfuse.datasets.truth import Truth

from ..walls import wall_points
from .method import Merge

Array = NDArray[np.float64]

#: Distance of the points [m] at which walls are compared.
SPACING_M = 0.25


@dataclass(frozen=True, eq=False, slots=True)
class OnPlan:
    """A merged map laid over the plan, all in the world.

    ``landmarks`` (n, 2) [m] and the true ``places`` (n, 2) that they are; ``walls``: polylines (k, 2) [m];
    ``wall_at`` (m, 2) [m] and ``wall_off`` (m,) [m]: points along the walls, and how far each is from the plan's walls.
    """

    landmarks: Array
    places: Array
    walls: tuple[Array, ...]
    wall_at: Array
    wall_off: Array

    @property
    def reach(self) -> float:
        """Largest distance [m] between two places of the map."""
        return float(_apart(self.places).max(initial=0.0))

    @property
    def landmark_off(self) -> Array:
        """How far each landmark is from its place (n,) [m]."""
        return np.asarray(np.hypot(*(self.landmarks - self.places).T))

    @property
    def rms(self) -> float:
        """Of all landmarks [m]."""
        return float(np.sqrt(np.mean(self.landmark_off**2)))

    @property
    def wall_percent(self) -> float:
        """The worst wall's error in percent of the map's reach: the paper's figure, which is about 2."""
        return 100 * float(self.wall_off.max(initial=0.0)) / self.reach

    @property
    def length_percents(self) -> Array:
        """Errors of all lengths between places more than `HOSPITAL_CORRIDOR` apart, in percent of these (k,)."""
        found, true = (_apart(points)[np.triu_indices(len(points), 1)] for points in (self.landmarks, self.places))
        long = true > HOSPITAL_CORRIDOR
        return np.asarray(100 * np.abs(found - true)[long] / true[long])


def _apart(points: Array) -> Array:
    return np.asarray(np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)))


def on_plan(maps: Sequence[LandmarkMap], merge: Merge, truth: Truth, building: Building, *, bent: bool) -> OnPlan:
    """A merge of two maps over the plan of their building.

    ``bent``: walls follow the merged landmarks of their map, as an optimised map's do; otherwise they move with their
    map as a rigid body.
    """
    names = tuple(m.name for m in maps)
    at, true = [], []
    merged: Mapping[str, dict[str, tuple[float, float]]] = {name: {} for name in names}
    for landmark in merge.landmarks:
        of = [(name, i) for name, ids in zip(names, (landmark.ids1, landmark.ids2), strict=True) for i in ids]
        places = {truth.landmarks[name][i] for name, i in of}
        for name, i in of:
            merged[name][i] = (landmark.x, landmark.y)
        if len(places) == 1 and (place := places.pop()) is not None:
            at.append((landmark.x, landmark.y))
            true.append(truth.places[place])
    landmarks, expected = np.array(at), np.array(true)
    into_world = se2.align(expected, landmarks).T12
    assert merge.T12 is not None
    rigid = dict(zip(names, (np.zeros(3), merge.T12.array), strict=True))
    walls = [
        np.asarray(se2.transform(into_world, wall))
        for m in maps
        for wall in (bent_walls(m, merged[m.name]) if bent else [se2.transform(rigid[m.name], w) for w in m.walls])
    ]
    points = wall_points(walls, SPACING_M).points if walls else np.zeros((0, 2))
    off = np.asarray(distances(points, building.walls)).min(axis=1) if len(points) else np.zeros(0)
    return OnPlan(np.asarray(se2.transform(into_world, landmarks)), expected, tuple(walls), np.asarray(points), off)


def bent_walls(map_: LandmarkMap, merged: Mapping[str, tuple[float, float]]) -> list[Array]:
    """A map's walls moved as its landmarks were, by their merged places: rigidly, then each point as those around it.

    What is left of the rigid motion at the landmarks is interpolated with linear radial basis functions.
    """
    ids = [i for i in map_.ids if i in merged]
    before = map_.positions[[map_.index_from_id[i] for i in ids]]
    after = np.array([merged[i] for i in ids])
    T = se2.align(after, before).T12
    left = RBFInterpolator(before, after - se2.transform(T, before), kernel="linear", degree=0)
    found = []
    for wall in map_.walls:
        points = _densely(np.asarray(wall, dtype=float))
        found.append(np.asarray(se2.transform(T, points) + left(points)))
    return found


def _densely(wall: Array) -> Array:
    """A polyline with a point every `SPACING_M` at least."""
    parts = [wall[:1]]
    for a, b in pairwise(wall):
        n = max(1, int(np.ceil(np.hypot(*(b - a)) / SPACING_M)))
        parts.append(a + (np.arange(1, n + 1) / n)[:, None] * (b - a))
    return np.concatenate(parts)
