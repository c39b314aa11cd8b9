"""Walls of a grid as polylines: the middle lines of what is occupied."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..simulation.corridorgraph import chains, simplified
from .cleaning import wall_cells
from .config import ExtractConfig
from .grid import Grid
from .skeleton import neighbours

Array = NDArray[np.float64]


def walls_of(grid: Grid, config: ExtractConfig) -> tuple[Array, ...]:
    """Walls as polylines (k, 2) [m, map frame], without specks and pieces shorter than the parameters say."""
    from skimage.morphology import skeletonize

    bones = np.argwhere(skeletonize(wall_cells(grid, config)))
    index = np.full(grid.cells.shape, -1, dtype=np.intp)
    index[tuple(bones.T)] = np.arange(len(bones))
    points = grid.points(bones)
    lines = [points[run] for run in chains(neighbours(index))]
    kept = [line for line in lines if np.hypot(*np.diff(line, axis=0).T).sum() >= config.wall_shortest_m]
    return tuple(simplified(line, config.wall_straight_m) for line in kept)
