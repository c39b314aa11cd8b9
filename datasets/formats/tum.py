"""TUM trajectories (``evo`` reads them): the path as lines ``t x y z qx qy qz qw``, seconds and metres, z 0."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import MapfuseError
from ..files import write_whole
from ..maps import LandmarkMap


def write(map_: LandmarkMap, path: Path) -> None:
    """Write the path of a map; raises `MapfuseError` where it has none."""
    if map_.path is None or not len(map_.path):
        raise MapfuseError(f"{path}: the map {map_.name!r} has no path, and TUM holds nothing else")
    lines = ["# t x y z qx qy qz qw"]
    for t, x, y, theta in map_.path.tolist():
        lines.append(f"{t!r} {x!r} {y!r} 0.0 0.0 0.0 {float(np.sin(theta / 2))!r} {float(np.cos(theta / 2))!r}")
    write_whole(path, "\n".join(lines) + "\n")
