"""Landmarks out of occupancy grids and vector plans: corridors, doors and walls, as a `LandmarkMap`."""

from .config import ExtractConfig
from .grid import FREE, OCCUPIED, UNKNOWN, Grid
from .gridfile import GridReading, read_grid, write_grid
from .landmarks import extract_landmarks
from .merging import merged_grid

__all__ = [
    "FREE",
    "OCCUPIED",
    "UNKNOWN",
    "ExtractConfig",
    "Grid",
    "GridReading",
    "extract_landmarks",
    "merged_grid",
    "read_grid",
    "write_grid",
]
