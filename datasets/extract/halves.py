"""One grid cut in two that overlap, each in a frame of its own: as if two robots had mapped a part each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import se2
from .grid import UNKNOWN, Grid
from .merging import merged_grid

Array = NDArray[np.float64]

#: The halves' frames lie at random up to this far [m] off.
_SHIFT = 30.0


def grid_halves(grid: Grid, rng: np.random.Generator, overlap: float = 0.3) -> tuple[Grid, Grid, Array]:
    """Two parts of a grid and T12 (3,): x, y [m], theta [rad].

    The grid is cut across a random direction, so that the share ``overlap`` of its known cells is in both parts. Each
    part is turned and shifted at random, its cells looked up anew; its name is that of the grid with -1 or -2.
    """
    angle = rng.uniform(-np.pi, np.pi)
    along = grid.points(np.moveaxis(np.indices(grid.cells.shape), 0, -1)) @ [np.cos(angle), np.sin(angle)]
    low, high = np.quantile(along[grid.cells != UNKNOWN], [0.5 - overlap / 2, 0.5 + overlap / 2])
    halves, poses = [], []
    for k, kept in enumerate((along <= high, along >= low), start=1):
        part = Grid(f"{grid.name}-{k}", np.where(kept, grid.cells, UNKNOWN), grid.resolution, grid.origin)
        poses.append(np.array([*rng.uniform(-_SHIFT, _SHIFT, 2), rng.uniform(-np.pi, np.pi)]))
        halves.append(merged_grid([part.trimmed()], [poses[-1]], part.name).trimmed())
    return halves[0], halves[1], se2.compose(poses[0], se2.inverse(poses[1]))
