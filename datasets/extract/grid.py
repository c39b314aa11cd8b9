"""`Grid`: an occupancy grid as a frozen value, and where its cells are.

Cells are those of ROS' ``nav_msgs/OccupancyGrid``: row 0 is the lowest, and column 0 the leftmost, in the grid's own
axes; ``origin`` is the pose of the outer corner of cell (0, 0) in the map's frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se2
from ..values import frozen_array, same_fields

Array = NDArray[np.float64]
Cells = NDArray[np.int8]
Mask = NDArray[np.bool_]

#: Values of a cell.
FREE, OCCUPIED, UNKNOWN = 0, 100, -1


@dataclass(frozen=True, eq=False)
class Grid:
    """``cells`` (rows, columns) of `FREE`, `OCCUPIED` or `UNKNOWN`; ``resolution`` [m] their width.

    ``origin`` (3,): x, y [m], theta [rad] of the grid's lower left corner in the map's frame.

    >>> grid = Grid("yard", np.zeros((2, 3), dtype=np.int8), 0.5, [10.0, 20.0, 0.0])
    >>> grid.points([[0, 0], [1, 2]]).tolist()
    [[10.25, 20.25], [11.25, 20.75]]
    >>> grid.at([[11.2, 20.7], [9.0, 20.0]]).tolist()
    [0, -1]
    """

    name: str
    cells: Cells
    resolution: float
    origin: Array

    def __post_init__(self) -> None:
        cells = np.array(self.cells, dtype=np.int8)
        cells.flags.writeable = False
        object.__setattr__(self, "cells", cells)
        object.__setattr__(self, "origin", frozen_array(self.origin))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.name, self.cells.shape, self.resolution))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.name, self.cells, self.resolution, self.origin)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        rows, columns = self.cells.shape
        return columns * self.resolution, rows * self.resolution

    def points(self, cells: ArrayLike) -> Array:
        """Positions (..., 2) [m, map frame] of the middles of cells (..., 2), each (row, column), fractions allowed."""
        at = (np.asarray(cells, dtype=float)[..., ::-1] + 0.5) * self.resolution
        return se2.transform(self.origin, at)

    def cells_of(self, points: ArrayLike) -> NDArray[np.intp]:
        """The cell (..., 2), as (row, column), that each point (..., 2) [m, map frame] lies in; it may be outside."""
        at = se2.transform(se2.inverse(self.origin), np.asarray(points, dtype=float))
        return np.floor(at[..., ::-1] / self.resolution).astype(np.intp)

    def at(self, points: ArrayLike) -> Cells:
        """Values (...) of the cells under points (..., 2) [m, map frame]; `UNKNOWN` outside."""
        cells = self.cells_of(points)
        inside = np.asarray(((cells >= 0) & (cells < self.cells.shape)).all(axis=-1))
        within = np.where(inside[..., None], cells, 0)
        return np.where(inside, self.cells[within[..., 0], within[..., 1]], UNKNOWN).astype(np.int8)

    def trimmed(self) -> Grid:
        """The same grid without rows and columns at its rim of which nothing is known."""
        rows, columns = (np.flatnonzero((self.cells != UNKNOWN).any(axis=k)) for k in (1, 0))
        if not len(rows):
            return self
        corner = se2.transform(self.origin, np.array([columns[0], rows[0]]) * self.resolution)
        cells = self.cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        return Grid(self.name, cells, self.resolution, np.append(corner, self.origin[2]))

    def coarser(self, factor: int) -> Grid:
        """The same grid with cells ``factor`` times as wide, each the most occupied of those that it takes in."""
        rows, columns = (-(-n // factor) * factor for n in self.cells.shape)
        cells = np.full((rows, columns), UNKNOWN, dtype=np.int8)
        cells[: self.cells.shape[0], : self.cells.shape[1]] = self.cells
        blocks = cells.reshape(rows // factor, factor, columns // factor, factor)
        return Grid(self.name, blocks.max(axis=(1, 3)), self.resolution * factor, self.origin)
