"""Several grids into one, given where each lies: what grid mergers give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se2
from ..errors import MapfuseError, TooLargeError
from .grid import UNKNOWN, Grid

Array = NDArray[np.float64]

#: Larger grids are refused [cells].
MAX_CELLS = 2**27
#: Rows of cells that are looked up at a time.
_ROWS = 256
#: Corners this close to a cell's edge, in cells, are on it.
_SAME = 1e-6


def merged_grid(grids: Sequence[Grid], poses: Sequence[ArrayLike], name: str = "merged") -> Grid:
    """One grid that holds all ``grids``, each in a frame whose pose (3,) in the common one is in ``poses``.

    Its axes are those of the common frame, its cells the finest of all; of what several grids know of a cell the most
    occupied counts. Cells are looked up where their middles fall, so nothing is blurred; one grid alone that isn't
    turned comes back cell by cell. Raises `TooLargeError` above
    `MAX_CELLS` cells, `MapfuseError` where there is no grid, or another number of poses than of grids.

    >>> half = Grid("half", np.array([[0, 100]], dtype=np.int8), 1.0, [0, 0, 0])
    >>> merged_grid([half, half], [[0, 0, 0], [2, 0, 0]]).cells.tolist()
    [[0, 100, 0, 100]]
    """
    if not grids or len(grids) != len(poses):
        raise MapfuseError(f"{len(grids)} grids and {len(poses)} poses can't be merged: one pose for each is needed")
    origins = [se2.compose(np.asarray(pose, dtype=float), grid.origin) for grid, pose in zip(grids, poses, strict=True)]
    resolution = min(grid.resolution for grid in grids)
    corners = np.vstack([_corners(grid, origin) for grid, origin in zip(grids, origins, strict=True)])
    anchor = origins[0][:2]
    low = np.floor((corners.min(axis=0) - anchor) / resolution + _SAME)
    high = np.ceil((corners.max(axis=0) - anchor) / resolution - _SAME)
    columns, rows = (high - low).astype(int).tolist()
    if rows * columns > MAX_CELLS:
        raise TooLargeError(f"the merged grid would have {rows * columns:,} cells; at most {MAX_CELLS:,} are made")
    origin = np.append(anchor + low * resolution, 0.0)
    empty = Grid(name, np.full((rows, columns), UNKNOWN, dtype=np.int8), resolution, origin)
    cells = empty.cells.copy()
    for first in range(0, rows, _ROWS):
        part = cells[first : first + _ROWS]
        at = empty.points(np.moveaxis(np.indices(part.shape), 0, -1) + np.array([first, 0]))
        for grid, pose in zip(grids, poses, strict=True):
            np.maximum(part, grid.at(se2.transform(se2.inverse(np.asarray(pose, dtype=float)), at)), out=part)
    return Grid(name, cells, resolution, origin)


def _corners(grid: Grid, origin: Array) -> Array:
    """The grid's four corners (4, 2) [m] with its lower left one at ``origin`` (3,)."""
    width, height = grid.size
    return se2.transform(origin, np.array([[0, 0], [width, 0], [0, height], [width, height]]))
