"""Places of a corridor graph with their arms, in the map's frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arms import wrap
from ..maps import DOOR
from .cleaning import Space, cleaned
from .config import ExtractConfig
from .corridors import corridors, line_of
from .grid import Grid
from .skeleton import Way, WayGraph, skeleton_graph

Array = NDArray[np.float64]

MAX_ARMS = 4
#: Directions [rad] nearer to each other are one arm; walls stand at least this far [rad] from an arm.
SAME_ARM, APART = np.deg2rad(25.0), np.pi / 4
#: A wall closes a direction where it stands within this [m] of the end of free space.
_WALL_NEAR = 0.3


@dataclass(frozen=True, slots=True)
class Arm:
    """``direction`` [rad, map frame]; whether one can go on there; ``to``: number of the place that is met, or None."""

    direction: float
    passable: bool
    to: int | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Place:
    """A corner (an end, too), junction or door at ``xy`` (2,) [m, map frame]; ``clearance`` [m] around it."""

    type: str
    xy: Array
    clearance: float
    arms: tuple[Arm, ...]


def places_of(grid: Grid, config: ExtractConfig) -> tuple[Place, ...]:
    """What one look at a grid finds."""
    space = cleaned(grid, config)
    graph = corridors(skeleton_graph(space, grid.resolution), config)
    degree = graph.degrees()
    arms = {node: _arms(graph, node, space, grid.resolution, config) for node in sorted(graph.xy)}
    kept = [node for node in arms if _is_place(graph, node, degree[node], arms[node], config)]
    number = {node: k for k, node in enumerate(kept)}
    turn = float(grid.origin[2])
    found = []
    for node in kept:
        type_ = DOOR if node in graph.doors else "junction" if degree[node] > 2 else "corner"
        ours = tuple(
            Arm(wrap(d + turn), p, None if to is None or to == node else number.get(to)) for d, p, to in arms[node]
        )
        # the space has a rim of one cell
        xy = grid.points(graph.xy[node][::-1] / grid.resolution - 1)
        found.append(Place(type_, xy, graph.clearance[node], ours))
    return tuple(found)


def _is_place(graph: WayGraph, node: int, degree: int, arms: list[_Arm], config: ExtractConfig) -> bool:
    """Whether a node is a landmark: not in the open, and an end only where walls close it."""
    if 2 * graph.clearance[node] > config.widest_m:
        return False
    return degree > 1 or sum(not passable for _, passable, _ in arms) >= 2


_Arm = tuple[float, bool, int | None]


def _arms(graph: WayGraph, node: int, space: Space, resolution: float, config: ExtractConfig) -> list[_Arm]:
    """Direction [rad, grid axes], whether passable, and the node that is met, of the arms of a node."""
    arms: list[_Arm] = []
    for way in sorted(graph.at(node), key=lambda way: (-way.length, way.end)):
        direction = _direction(graph, way, config)
        if len(arms) < MAX_ARMS and all(_apart(direction, d) > SAME_ARM for d, _, _ in arms):
            arms.append((direction, True, way.end))
    ways = [direction for direction, _, _ in arms]
    for turn in (np.pi, np.pi / 2, -np.pi / 2):
        for direction in ways:
            wall = wrap(direction + turn)
            free = len(arms) < MAX_ARMS and all(_apart(wall, d) > APART - 1e-9 for d, _, _ in arms)
            if free and _blocked(graph.xy[node], wall, graph.clearance[node], space, resolution):
                arms.append((wall, False, None))
    return arms


def _apart(a: float, b: float) -> float:
    return abs(wrap(a - b))


def _direction(graph: WayGraph, way: Way, config: ExtractConfig) -> float:
    """Direction [rad] in which a way leaves: to the next node, or along its own line where that stands in the open."""
    step = graph.xy[way.end] - graph.xy[way.start]
    if 2 * graph.clearance[way.end] > config.widest_m or way.end == way.start:
        line = line_of(way, graph.clearance[way.start])
        beyond = way.points[np.hypot(*(way.points - way.points[0]).T) >= graph.clearance[way.start]]
        if line is not None:
            along = np.array([-line[1][1], line[1][0]])
            step = along * np.sign(along @ (line[0] - graph.xy[way.start]) or 1.0)
        elif len(beyond):
            step = beyond[0] - graph.xy[way.start]
    return float(np.arctan2(step[1], step[0]))


def _blocked(at: Array, direction: float, clearance: float, space: Space, resolution: float) -> bool:
    """Whether a wall, rather than what nobody saw, is the first thing in that direction."""
    reach = np.arange(clearance / 2, 2 * clearance + 1.0, resolution / 2)
    points = at + reach[:, None] * (np.cos(direction), np.sin(direction))
    cells = np.round(points[:, ::-1] / resolution).astype(int)
    cells = cells[((cells >= 0) & (cells < space.free.shape)).all(axis=1)]
    ends = np.flatnonzero(~space.free[tuple(cells.T)])
    return bool(len(ends) and space.to_wall[tuple(cells[ends[0]])] <= _WALL_NEAR)
