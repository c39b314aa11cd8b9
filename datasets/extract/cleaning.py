"""A grid without its speckle: where there is room for a robot, and where what is known ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .config import ExtractConfig
from .grid import FREE, UNKNOWN, Grid, Mask

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Space:
    """``free``: room that a robot can drive in; ``wall``: cells that are occupied or lean to it, speckle left out.

    All of one shape, that of the grid with a rim of one unknown cell around it. ``clearance`` [m]: from free cells to
    the nearest that isn't; ``to_wall`` [m]: to the nearest wall, larger where the space ends at what nobody saw.
    """

    free: Mask
    wall: Mask
    clearance: Array
    to_wall: Array


def cleaned(grid: Grid, config: ExtractConfig) -> Space:
    """The grid's free space: furniture and small holes filled, rays and gaps narrower than a passage closed."""
    # imported here because scipy and scikit-image take longer to import than the whole package does
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    cells = np.pad(grid.cells, 1, constant_values=UNKNOWN)
    free = (cells >= FREE) & (cells < config.occupied_from)
    free = gaussian_filter(free.astype(np.float32), config.smooth_m / grid.resolution) > 0.5
    free = _without_islands(free, config.furniture_m / grid.resolution)
    free = _opened(free, config.passage_m / 2 / grid.resolution)
    free = _parts(free, config.part_m2 / grid.resolution**2)
    wall = (cells >= config.occupied_from) & ~free
    far = np.full(free.shape, np.inf)
    return Space(
        free,
        wall,
        np.asarray(distance_transform_edt(free) * grid.resolution),
        np.asarray(distance_transform_edt(~wall) * grid.resolution) if wall.any() else far,
    )


def wall_cells(grid: Grid, config: ExtractConfig) -> Mask:
    """Cells that are occupied or lean to it, less specks that measure at most ``speckle_m`` both ways."""
    from scipy.ndimage import find_objects, label

    occupied = grid.cells >= config.occupied_from
    parts, count = label(occupied, np.ones((3, 3), dtype=bool))
    large = np.zeros(count + 1, dtype=bool)
    for k, place in enumerate(find_objects(parts), start=1):
        large[k] = max(s.stop - s.start for s in place) * grid.resolution > config.speckle_m
    return np.asarray(large[parts])


def _without_islands(free: Mask, limit: float) -> Mask:
    """Free cells, and what stands alone among them and measures at most ``limit`` [cells] both ways."""
    from scipy.ndimage import find_objects, label

    parts, count = label(~free, np.ones((3, 3), dtype=bool))
    filled = np.zeros(count + 1, dtype=bool)
    for k, place in enumerate(find_objects(parts), start=1):
        inside = all(s.start > 0 and s.stop < n for s, n in zip(place, free.shape, strict=True))
        filled[k] = inside and max(s.stop - s.start for s in place) <= limit
    return np.asarray(free | filled[parts])


def _opened(free: Mask, radius: float) -> Mask:
    """What a disc of ``radius`` [cells] can reach."""
    from scipy.ndimage import distance_transform_edt

    inner = distance_transform_edt(free) > radius
    return np.asarray(distance_transform_edt(~inner) <= radius) & free


def _parts(free: Mask, smallest: float) -> Mask:
    """The largest connected part, and all others of at least ``smallest`` cells."""
    from scipy.ndimage import label

    parts, count = label(free)
    if not count:
        return free
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    kept = sizes >= smallest
    kept[np.argmax(sizes)] = True
    kept[0] = False
    return np.asarray(kept[parts])
