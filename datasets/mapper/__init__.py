"""From a robot's log to its map: dead reckoning, association, loop closing, smoothing."""

from .changes import Change, Corrected, LandmarkAdded, LandmarkRemoved, LandmarkUpdated, LoopClosed
from .config import WITH_KEYFRAMES, MapperConfig
from .evaluation import truth_of_map
from .mapper import Mapper, map_log

__all__ = [
    "WITH_KEYFRAMES",
    "Change",
    "Corrected",
    "LandmarkAdded",
    "LandmarkRemoved",
    "LandmarkUpdated",
    "LoopClosed",
    "Mapper",
    "MapperConfig",
    "map_log",
    "truth_of_map",
]
