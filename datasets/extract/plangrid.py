"""A vector plan's corridors as a grid: which space is corridor, and lines along its middle.

Rooms are spaces of their own behind closed doors, and corridors are the long ones that most doors open to. Doors
between two corridors stand open. What is no corridor is left unknown, as a robot that keeps to the corridors leaves it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import TooLargeError
from .cleaning import cleaned
from .config import ExtractConfig
from .corridors import middle_lines
from .grid import FREE, OCCUPIED, UNKNOWN, Grid
from .skeleton import skeleton_graph

Array = NDArray[np.float64]

#: Width of the cells [m], and how many there may be: 500 m by 500 m.
CELL_M, MAX_CELLS = 0.05, 10**8
#: A corridor is at least this long [m], and has at least this share of the doors that the busiest one has.
_LONG, _BUSY = 5.0, 0.5
#: Space before a door begins within this [m] of it; smaller spaces [m^2] are inside of walls.
_BEFORE, _SMALLEST = 0.8, 0.5
_RIM = 2


def plan_grid(name: str, walls: Array, doors: Array, leaves: Array, door_of_leaf: NDArray[np.intp]) -> Grid:
    """Corridors between ``walls`` (n, 2, 2) [m]: free cells of corridors, occupied ones of walls and closed doors.

    ``doors`` (m, 2, 2): lines across the openings; ``leaves`` (l, 2, 2) their outlines, ``door_of_leaf`` (l,) the door
    of each. No cell is free where no space is enclosed. Raises `TooLargeError` above `MAX_CELLS` cells.
    """
    from scipy.ndimage import label

    points = np.concatenate([walls, leaves, doors]).reshape(-1, 2)
    if not len(points):
        return Grid(name, np.full((1, 1), UNKNOWN, dtype=np.int8), CELL_M, np.zeros(3))
    low = points.min(axis=0) - _RIM * CELL_M
    columns, rows = (np.ceil((points.max(axis=0) - low) / CELL_M).astype(int) + _RIM + 1).tolist()
    if rows * columns > MAX_CELLS:
        raise TooLargeError(f"{rows * columns:,} cells of plan; at most {MAX_CELLS:,} are read without ways")
    origin = np.array([*low, 0.0])
    plan = Grid(name, np.zeros((rows, columns), dtype=np.int8), CELL_M, origin)
    drawn = _drawn(plan, walls) | _drawn(plan, np.concatenate([leaves, doors]))
    parts, count = label(~drawn)
    outside = int(parts[0, 0])
    sides = _sides(plan, parts, doors, outside)
    corridor = _corridors(parts, count, sides)
    between = np.array([a != b and corridor[a] and corridor[b] for a, b in sides], dtype=bool)
    closed = ~between[door_of_leaf] if len(leaves) else np.zeros(0, dtype=bool)
    solid = _drawn(plan, walls) | _drawn(plan, leaves[closed]) | _drawn(plan, doors[~between])
    free = (corridor[parts] & ~solid) | (_doorways(plan, doors[between]) & ~_drawn(plan, walls))
    cells = np.where(free, FREE, np.where(solid, OCCUPIED, UNKNOWN))
    return Grid(name, cells.astype(np.int8), CELL_M, origin)


def plan_lines(walls: Array, doors: Array, leaves: Array, door_of_leaf: NDArray[np.intp]) -> list[Array]:
    """Lines (k, 2) [m] along the middle of a plan's corridors; none where there are none. See `plan_grid`."""
    grid = plan_grid("plan", walls, doors, leaves, door_of_leaf)
    config = ExtractConfig(smooth_m=0.0)
    if not (grid.cells == FREE).any():
        return []
    space = cleaned(grid, config)
    lines = middle_lines(skeleton_graph(space, grid.resolution), config)
    # the space has a rim of one cell
    return [grid.points(line[:, ::-1] / grid.resolution - 1) for line in lines]


def _drawn(plan: Grid, segments: Array) -> NDArray[np.bool_]:
    """Cells that segments (n, 2, 2) [m] run through."""
    from skimage.draw import line

    drawn = np.zeros(plan.cells.shape, dtype=bool)
    for (r0, c0), (r1, c1) in plan.cells_of(segments).tolist():
        drawn[line(r0, c0, r1, c1)] = True
    return drawn


def _doorways(plan: Grid, doors: Array) -> NDArray[np.bool_]:
    """Cells of doors that stand open: as wide as their lines, and through the wall to either side."""
    from skimage.draw import polygon

    opened = np.zeros(plan.cells.shape, dtype=bool)
    for door in doors:
        through = _normal(door) * _BEFORE
        corners = plan.cells_of(np.array([door[0] - through, door[1] - through, door[1] + through, door[0] + through]))
        opened[polygon(corners[:, 0], corners[:, 1], opened.shape)] = True
    return opened


def _normal(door: Array) -> Array:
    along = door[1] - door[0]
    return np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)


def _sides(plan: Grid, parts: NDArray[np.signedinteger], doors: Array, outside: int) -> list[tuple[int, int]]:
    """The spaces (numbers in ``parts``) before and behind each door; 0 where there is none."""
    sizes = np.bincount(parts.ravel()) * plan.resolution**2
    sizes[[0, outside]] = 0.0
    steps = np.arange(plan.resolution, _BEFORE, plan.resolution)[:, None]
    found = []
    for door in doors:
        middle, normal = door.mean(axis=0), _normal(door)
        pair = []
        for side in (-1, 1):
            cells = np.clip(plan.cells_of(middle + side * steps * normal), 0, np.array(parts.shape) - 1)
            near = [int(p) for p in parts[tuple(cells.T)] if sizes[p] >= _SMALLEST]
            pair.append(near[0] if near else 0)
        found.append((pair[0], pair[1]))
    return found


def _corridors(parts: NDArray[np.signedinteger], count: int, sides: Sequence[tuple[int, int]]) -> NDArray[np.bool_]:
    """Which spaces are corridors: the busiest one, and what doors join to it that is busy and long enough."""
    from scipy.ndimage import find_objects

    doors = np.zeros(count + 1, dtype=int)
    for pair in sides:
        for part in set(pair) - {0}:
            doors[part] += 1
    long = np.zeros(count + 1, dtype=bool)
    for k, place in enumerate(find_objects(parts), start=1):
        long[k] = np.hypot(*(s.stop - s.start for s in place)) * CELL_M >= _LONG
    long[parts[0, 0]] = False
    wanted = long & (doors >= _BUSY * doors[long].max(initial=0))
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    joined = np.zeros(count + 1, dtype=bool)
    if wanted.any():
        joined[np.lexsort((sizes, doors, wanted))[-1]] = True
    for _ in sides:
        more = [b for pair in sides for a, b in (pair, pair[::-1]) if joined[a] and wanted[b] and not joined[b]]
        if not more:
            break
        joined[more] = True
    return joined
