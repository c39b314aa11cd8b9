"""Landmarks out of occupancy grids and vector plans: corridors, doors and walls, as a `LandmarkMap`."""

from .config import ExtractConfig
from .grid import FREE, OCCUPIED, UNKNOWN, Grid
from .gridfile import GridReading, read_grid, write_grid
from .halves import grid_halves
from .landmarks import extract_landmarks
from .merging import merged_grid
from .planmap import map_of_floor, plan_landmarks

__all__ = [
    "FREE",
    "OCCUPIED",
    "UNKNOWN",
    "ExtractConfig",
    "Grid",
    "GridReading",
    "extract_landmarks",
    "grid_halves",
    "map_of_floor",
    "merged_grid",
    "plan_landmarks",
    "read_grid",
    "write_grid",
]
