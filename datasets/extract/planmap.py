"""A vector plan to landmarks: corners, junctions and doors along its corridors, and its walls."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..maps import Landmark, LandmarkMap, Link, Noise
from ..simulation.floors import Arm, Floor, Place, bearing

Array = NDArray[np.float64]

#: A plan is drawn, not sensed: what is in it is there, and what is there is in it, up to what was built otherwise.
#: Set, not measured: rooms are built to some centimetres, and one door in fifty has moved since the plan was drawn.
PLAN_NOISE = Noise(
    distance_sigma_per_metre=0.002,
    distance_sigma_floor=0.05,
    heading_sigma=0.02,
    position_sigma=0.05,
    detection_rate=0.98,
    false_alarm_rate=0.02,
    door_detection_rate=0.98,
    door_false_alarm_rate=0.02,
)


def map_of_floor(floor: Floor, walls: Iterable[Array] = (), name: str | None = None) -> LandmarkMap:
    """A floor's places as landmarks, each linked with the next ones along its corridors; ``walls``: polylines [m].

    >>> from mapfuse.datasets.simulation import floor_from_graph
    >>> map_ = map_of_floor(floor_from_graph("L", [(0, 0), (8, 0), (8, 6)], [(0, 1), (1, 2)]))
    >>> [(link.connected_to_id, link.distance) for link in map_["p1"].links if link.connected_to_id]
    [('p2', 6.0), ('p0', 8.0)]
    """
    landmarks = tuple(_landmark(floor, place) for place in floor.places)
    return LandmarkMap(name or floor.name, landmarks, noise=PLAN_NOISE, walls=tuple(walls))


def _landmark(floor: Floor, place: Place) -> Landmark:
    ways = {place.arm_towards(bearing(place.xy, floor.place_from_id[b].xy)): b for b in floor.neighbours[place.id]}
    links = tuple(_link(floor, place, arm, ways.get(k)) for k, arm in enumerate(place.arms))
    return Landmark(place.id, place.type, place.x, place.y, links=links)


def _link(floor: Floor, place: Place, arm: Arm, to: str | None) -> Link:
    if to is None:
        return Link(arm.type, arm.direction)
    heading = bearing(place.xy, floor.place_from_id[to].xy)
    return Link("open", heading, None, to, floor.distance(place.id, to), 1)


def plan_landmarks(path: str | Path, corridors: str | Path | None = None) -> LandmarkMap:
    """The landmarks of a vector plan (GeoJSON); `building_from_plan` says what is read, and which errors there are."""
    from ..simulation.plan import building_from_plan

    building = building_from_plan(path, corridors, steel_sigma=0.0)
    return map_of_floor(building.floor, polylines(building.walls))


def polylines(segments: Array) -> tuple[Array, ...]:
    """Segments (n, 2, 2) as polylines (k, 2): those that follow each other, end to start, in one.

    >>> [line.tolist() for line in polylines(np.array([[[0, 0], [1, 0]], [[1, 0], [1, 2]], [[5, 5], [6, 5]]]))]
    [[[0, 0], [1, 0], [1, 2]], [[5, 5], [6, 5]]]
    """
    if not len(segments):
        return ()
    breaks = [k for k, (a, b) in enumerate(pairwise(segments), start=1) if not np.array_equal(a[1], b[0])]
    return tuple(np.vstack([run[:1, 0], run[:, 1]]) for run in np.split(np.asarray(segments), breaks))
