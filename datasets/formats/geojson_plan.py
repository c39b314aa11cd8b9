"""Vector plans of a floor in GeoJSON (walls, doors, corridors): the landmarks that a robot would find along them.

What is read of a file, in which units, is said in `simulation.plan`. The frame is the plan's own: metres East and North
of the middle of a plan in longitude and latitude, which ``extra`` of the map keeps.
"""

from __future__ import annotations

import re
from pathlib import Path

from .heads import plain_name
from .reading import Reading

_FEATURE = re.compile(
    rb'"type"\s*:\s*"(corridor|path|pathway|wall|window|building_outline|inaccessible_space|door)"',
)


def detect(path: Path, head: bytes) -> bool:
    """A collection of features that are walls, doors or corridors by their property ``type``."""
    wanted = plain_name(path).endswith((".geojson", ".json")) and b'"FeatureCollection"' in head
    return wanted and b'"startid"' not in head and _FEATURE.search(head) is not None


def read(path: Path, corridors: str | None = None) -> Reading:
    """The landmarks of a plan; ``corridors``: a second file of the same floor, that has its corridors."""
    from ..extract.planmap import plan_landmarks

    return Reading((plan_landmarks(path, corridors),))
