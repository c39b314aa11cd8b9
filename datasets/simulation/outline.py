"""What a picture of a recorded map needs besides landmarks: walls and the robot's path, bent as the map is bent."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se2
from ..maps import LandmarkMap
from .explore import Route, step
from .floors import Corridor, Floor, Place, bearing
from .record import Recording

Array = NDArray[np.float64]

#: Speed [m/s] by which the path's times are told.
SPEED = 0.4


def with_outline(recording: Recording, floor: Floor, route: Route) -> LandmarkMap:
    """The recorded map with the walls of the corridors that were travelled, and the path.

    Both are drawn where the map would have them: the true points displaced like the recorded landmarks near them
    (weights 1/d^2). They are there to be looked at and carry no evidence.
    """
    places = floor.place_from_id
    travelled = {step(a, b) for a, b in pairwise(route.places)}
    seen = [c for c in floor.corridors if any(step(a, b) in travelled for a, b in pairwise(c.places))]
    walls = tuple(_as_recorded(recording, wall) for wall in corridor_walls(floor, seen))
    points = _as_recorded(recording, [places[i].xy for i in route.places])
    return recording.map.replace(walls=walls, path=_path(points))


def corridor_walls(floor: Floor, corridors: Iterable[Corridor]) -> list[Array]:
    """Both sides of each corridor, and what closes its dead ends, as polylines (k, 2) [m, world]; doors are closed.

    >>> from mapfuse.datasets.simulation import floor_from_graph
    >>> floor = floor_from_graph("I", [(0, 0), (8, 0)], [(0, 1)])
    >>> [wall.round(9).tolist() for wall in corridor_walls(floor, floor.corridors)]
    [[[-1.0, -1.0], [9.0, -1.0]], [[9.0, 1.0], [-1.0, 1.0]], [[-1.0, 1.0], [-1.0, -1.0]], [[9.0, -1.0], [9.0, 1.0]]]
    """
    walls: list[Array] = []
    for corridor in corridors:
        a, b = (floor.place_from_id[i] for i in (corridor.places[0], corridor.places[-1]))
        sides = [_wall_ends(end, bearing(end.xy, other.xy), floor.width) for end, other in ((a, b), (b, a))]
        (a_right, a_left), (b_right, b_left) = sides
        walls += [np.array([a_right, b_left]), np.array([b_right, a_left])]
        dead = [side for end, side in ((a, sides[0]), (b, sides[1])) if len(_ways(end)) == 1]
        walls += [np.array([left, right]) for right, left in dead]
    return walls


def _ways(place: Place) -> list[float]:
    return [arm.direction for arm in place.arms if arm.type == "open"]


def _wall_ends(place: Place, direction: float, width: float) -> tuple[Array, Array]:
    """Where the right and the left wall of the corridor leaving ``place`` along ``direction`` end there."""
    gaps = [float(np.mod(other - direction, 2 * np.pi)) for other in _ways(place)]
    turns = [gap for gap in gaps if 1e-6 < gap < 2 * np.pi - 1e-6]
    if not turns:
        back = place.xy - width / 2 * _unit(direction)
        side = width / 2 * _unit(direction + np.pi / 2)
        return back - side, back + side
    left, right = min(turns), 2 * np.pi - max(turns)
    return (
        place.xy + width / 2 / np.sin(right / 2) * _unit(direction - right / 2),
        place.xy + width / 2 / np.sin(left / 2) * _unit(direction + left / 2),
    )


def _unit(direction: float) -> Array:
    return np.array([np.cos(direction), np.sin(direction)])


def _as_recorded(recording: Recording, points: ArrayLike) -> Array:
    """Points (n, 2) [m, world] in the map's coordinates, displaced like the landmarks near them."""
    T_map_world = se2.inverse(recording.frame)
    true = se2.transform(T_map_world, points)
    ids = recording.map.ids
    landmarks = se2.transform(T_map_world, np.array([recording.meant[i][:2] for i in ids]))
    weight = 1 / (np.sum((true[:, None] - landmarks[None]) ** 2, axis=2) + 1e-6)
    shift = weight @ (recording.map.positions - landmarks) / weight.sum(axis=1, keepdims=True)
    return np.asarray(true + shift, dtype=float)


def _path(points: Array) -> Array:
    """Rows of time, x, y, theta: from the map's origin along the points, facing the next one."""
    xy = np.vstack([np.zeros((1, 2)), points])
    legs = np.diff(xy, axis=0)
    time = np.concatenate([[0.0], np.cumsum(np.hypot(*legs.T)) / SPEED])
    facing = np.arctan2(legs[:, 1], legs[:, 0])
    theta = np.concatenate([[0.0], facing[1:], facing[-1:]])
    return np.column_stack([time, xy, theta])
