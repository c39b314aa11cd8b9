"""Buildings of Open-RMF's traffic editor (``building.yaml``): doors and named vertices as landmarks, walls as walls.

Positions are pixels of a floor plan, x to the right and y down; ``measurements`` say how many metres are between two
vertices, which gives the level's scale. Here x stays and y is turned round, so that the frame is right-handed with its
origin at the plan's upper left corner; that is what Open-RMF's own tools do. Buildings in ``cartesian_meters`` are
metres with y up already. A door is where its middle is; its name is its id. Each level is a map of its own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..maps import Landmark, LandmarkMap
from . import safeyaml
from .checks import Checker
from .graphs import unique_names
from .heads import plain_name, stem
from .reading import Reading, counted, remark

#: Metres per pixel that Open-RMF takes where a level has no measurement.
DEFAULT_SCALE = 0.05
#: Measurements of one level that differ by more than this share are remarked on.
SCALE_TOLERANCE = 0.02
_LEVELS = re.compile(rb"(?m)^levels:")
_TYPES = (("is_charger", "charger"), ("is_parking_spot", "parking"), ("is_holding_point", "holding point"))
_LEFT_OUT = ("lanes", "floors", "models", "fiducials", "human_lanes", "layers", "features")


def detect(path: Path, head: bytes) -> bool:
    """YAML whose name says so, or with levels that have vertices."""
    name = plain_name(path)
    if name.endswith((".building.yaml", ".building.yml")):
        return True
    return name.endswith((".yaml", ".yml")) and _LEVELS.search(head) is not None and b"vertices:" in head


def read(path: Path, part: str | None = None) -> Reading:
    """A map of each level, or of the level ``part`` alone."""
    check = Checker(path)
    document = check.mapping(safeyaml.load(path), "")
    check.done()
    levels = check.mapping(document.get("levels"), "levels")
    check.done()
    if part is not None and part not in levels:
        raise InputError(path, f"has no level {part!r}; there are {', '.join(map(str, levels))}")
    name = document.get("name")
    name = name if isinstance(name, str) and name else stem(path, ".building.yaml", ".building.yml")
    pixels = document.get("coordinate_system", "reference_image") == "reference_image"
    if document.get("coordinate_system") == "wgs84":
        check.fault("coordinate_system", "is wgs84: degrees, which aren't read")
    maps, remarks, parts = [], [], []
    for key, record in levels.items():
        if part is None or key == part:
            level = check.mapping(record, f"levels.{key}")
            map_, more = _level(f"{name}-{key}", level, f"levels.{key}", pixels, check)
            maps.append(map_)
            parts.append(str(key))
            remarks += [f"level {key}: {text}" for text in more]
    check.done()
    lifts = document.get("lifts")
    remarks += counted({"lifts": len(lifts) if isinstance(lifts, (Mapping, list)) else 0}, "left out")
    return Reading(tuple(maps), tuple(remarks), tuple(parts))


def _level(
    name: str, level: Mapping[str, Any], place: str, pixels: bool, check: Checker
) -> tuple[LandmarkMap, Sequence[str]]:
    vertices = [
        _vertex(v, f"{place}.vertices[{k}]", check)
        for k, v in enumerate(check.items(level.get("vertices", []), f"{place}.vertices"))
    ]
    raw = np.array([v[0] for v in vertices], dtype=float).reshape(-1, 2)
    scale, remarks = _scale(level, raw, place, check) if pixels else (1.0, ())
    xy = raw * (scale, -scale if pixels else scale)
    doors, walls = (_pairs(level, key, len(xy), place, check) for key in ("doors", "walls"))
    landmarks = [
        (_door_name(record, k), "door", xy[[a, b]].mean(axis=0)) for k, (a, b, record) in enumerate(doors, start=1)
    ]
    landmarks += [(text, type_, xy[k]) for k, (_, text, type_) in enumerate(vertices) if text]
    ids, renamed = unique_names([text for text, _, _ in landmarks])
    left = {key: len(level[key]) for key in _LEFT_OUT if isinstance(level.get(key), (list, Mapping))}
    remarks = (
        *remarks,
        *remark(renamed, "names that stand more than once", "numbered"),
        *counted(left, "left out"),
    )
    found = tuple(
        Landmark(identifier, type_, float(at[0]), float(at[1]))
        for identifier, (_, type_, at) in zip(ids, landmarks, strict=True)
    )
    return LandmarkMap(name, found, walls=tuple(xy[[a, b]] for a, b, _ in walls if a != b)), remarks


def _vertex(record: Any, place: str, check: Checker) -> tuple[tuple[float, float], str, str]:
    """Position as it stands, name (may be empty) and type of a vertex ``[x, y, z, name, parameters]``."""
    row = check.items(record, place)
    if len(row) < 2:
        check.fault(place, "must be [x, y, z, name]")
        return (0.0, 0.0), "", ""
    x, y = (check.number(value, f"{place}[{k}]") for k, value in enumerate(row[:2]))
    name = str(row[3]).strip() if len(row) > 3 and row[3] is not None else ""
    told = row[4] if len(row) > 4 and isinstance(row[4], Mapping) else {}
    type_ = next((word for key, word in _TYPES if _value(told.get(key)) is True), "place")
    return (x, y), name, type_


def _value(parameter: Any) -> Any:
    """A parameter's value: it is written ``[kind, value]``."""
    return parameter[1] if isinstance(parameter, list) and len(parameter) == 2 else parameter


def _pairs(
    level: Mapping[str, Any], key: str, count: int, place: str, check: Checker
) -> list[tuple[int, int, Mapping[str, Any]]]:
    """Records ``[vertex, vertex, parameters]``."""
    found = []
    for k, record in enumerate(check.items(level.get(key) or [], f"{place}.{key}")):
        row = check.items(record, f"{place}.{key}[{k}]")
        ends = [end for end in row[:2] if type(end) is int and 0 <= end < count]
        if len(ends) < 2:
            check.fault(f"{place}.{key}[{k}]", f"must begin with two of the {count} vertices")
        else:
            found.append((ends[0], ends[1], row[2] if len(row) > 2 and isinstance(row[2], Mapping) else {}))
    return found


def _scale(
    level: Mapping[str, Any], raw: np.ndarray[Any, Any], place: str, check: Checker
) -> tuple[float, tuple[str, ...]]:
    """Metres per pixel: the mean of what the measurements say, as Open-RMF takes it."""
    scales = []
    for k, (a, b, record) in enumerate(_pairs(level, "measurements", len(raw), place, check)):
        at = f"{place}.measurements[{k}]"
        length = check.number(_value(record.get("distance")), f"{at}.distance", 0.0)
        apart = float(np.hypot(*(raw[a] - raw[b])))
        if apart <= 0 or length <= 0:
            check.fault(at, "must be a distance between two places")
        else:
            scales.append(length / apart)
    if not scales:
        return DEFAULT_SCALE, (f"there is no measurement: {DEFAULT_SCALE} m per pixel are taken",)
    scale = float(np.mean(scales))
    spread = (max(scales) - min(scales)) / scale
    odd = f"measurements differ by {100 * spread:.0f} %: their mean is taken, {scale:.4f} m per pixel"
    return scale, (odd,) if spread > SCALE_TOLERANCE else ()


def _door_name(record: Mapping[str, Any], k: int) -> str:
    name = _value(record.get("name"))
    return name if isinstance(name, str) and name.strip() else f"door-{k}"
