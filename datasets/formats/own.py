"""``mapfuse.map/1`` as one of the formats."""

from __future__ import annotations

from pathlib import Path

from ..mapfile import read_map, write_map
from ..maps import LandmarkMap
from .heads import plain_name
from .reading import Reading


def detect(path: Path, head: bytes) -> bool:
    """By its ending, or as JSON that names a format of mapfuse; a file of any other name may be a pipe."""
    if plain_name(path).endswith(".map.json") or path.is_fifo():
        return True
    text = head.lstrip()
    return text.startswith(b"{") and b'"mapfuse.' in text


def read(path: Path) -> Reading:
    """The map of the file."""
    return Reading((read_map(path),))


def write(map_: LandmarkMap, path: Path) -> None:
    """Write the map."""
    write_map(map_, path)
