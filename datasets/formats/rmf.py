"""Buildings of Open-RMF's traffic editor (``building.yaml``): doors and named vertices as landmarks, lanes as ways.

Positions are pixels of a floor plan, x to the right and y down; ``measurements`` say how many metres are between two
vertices, which gives the level's scale. Here x stays and y is turned round, so that the frame is right-handed with its
origin at the plan's upper left corner; that is what Open-RMF's own tools do. Buildings in ``cartesian_meters`` are
metres with y up already. A door is where its middle is; its name is its id. Each level is a map of its own, and a plan
that robots can be driven through (`level_plan`): lanes are its corridors.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError, InputError
from . import safeyaml
from .checks import Checker
from .graphs import Node, graph_map, unique_names
from .heads import plain_name, stem
from .lanes import Lane, lane_ways
from .reading import Reading, counted, remark

if TYPE_CHECKING:
    from ..maps import LandmarkMap
    from ..simulation.plan import Plan

Array = NDArray[np.float64]

#: Metres per pixel that Open-RMF takes where a level has no measurement.
DEFAULT_SCALE = 0.05
#: Measurements of one level that differ by more than this share are remarked on.
SCALE_TOLERANCE = 0.02
_LEVELS = re.compile(rb"(?m)^levels:")
_TYPES = (("is_charger", "charger"), ("is_parking_spot", "parking"), ("is_holding_point", "holding point"))
_LEFT_OUT = ("floors", "models", "fiducials", "human_lanes", "layers", "features")


def is_named_so(path: Path) -> bool:
    """Whether a file is a building by its name."""
    return plain_name(path).endswith((".building.yaml", ".building.yml"))


def detect(path: Path, head: bytes) -> bool:
    """YAML whose name says so, or with levels that have vertices."""
    name = plain_name(path)
    by_content = _LEVELS.search(head) is not None and b"vertices:" in head
    return is_named_so(path) or (name.endswith((".yaml", ".yml")) and by_content)


@dataclass(frozen=True, eq=False, slots=True)
class Level:
    """One level in metres: where its vertices are (n, 2), which of them have a name (its place, name, type), doors
    (m, 2, 2) and their names, walls (w, 2, 2), lanes between vertices; ``remarks`` on what is odd or left out."""

    name: str
    part: str
    vertices: Array
    named: tuple[tuple[int, str, str], ...]
    doors: Array
    door_names: tuple[str, ...]
    walls: Array
    lanes: tuple[Lane, ...]
    remarks: tuple[str, ...]


def read(path: Path, part: str | None = None, landmarks: str = "named") -> Reading:
    """A map of each level, or of the level ``part`` alone.

    ``landmarks``: ``named`` (doors and named vertices, with the lanes as ways) or ``lanes`` (the corners, junctions
    and doors along the lanes, as a robot finds them).
    """
    if landmarks not in ("named", "lanes"):
        raise ConfigError(f"{path}: option landmarks must be named or lanes, not {landmarks!r}")
    levels, left = read_levels(path, part)
    maps, remarks = [], []
    for level in levels:
        map_, odd = _named_map(level) if landmarks == "named" else _lanes_map(level, path)
        maps.append(map_)
        remarks += [f"level {level.part}: {text}" for text in (*level.remarks, *odd)]
    return Reading(tuple(maps), (*remarks, *left), tuple(level.part for level in levels))


def level_plan(path: Path, part: str | None = None) -> Plan:
    """A level (``part``, or the only one) as a plan for robots to drive through; its lanes are the corridors.

    Raises `InputError` where there are several levels, and what `read` does.
    """
    levels, _ = read_levels(path, part)
    if len(levels) != 1:
        told = ", ".join(level.part for level in levels)
        raise InputError(path, f"holds {len(levels)} levels ({told}); name one as {path}#{levels[0].part}")
    return _plan(levels[0])


def _plan(level: Level) -> Plan:
    from ..simulation.plan import Plan

    lines = tuple(level.vertices[[lane.start, lane.end]] for lane in level.lanes)
    lines = tuple(line for line in lines if (line[0] != line[1]).any())
    return Plan(level.name, lines, level.walls, level.doors, level.doors, np.arange(len(level.doors)))


def _lanes_map(level: Level, path: Path) -> tuple[LandmarkMap, tuple[str, ...]]:
    from ..extract.planmap import map_of_floor, polylines
    from ..simulation.plan import building_of

    building = building_of(_plan(level), path, f"levels.{level.part}", steel_sigma=0.0)
    return map_of_floor(building.floor, polylines(building.walls)), ()


def _named_map(level: Level) -> tuple[LandmarkMap, tuple[str, ...]]:
    middles = level.doors.mean(axis=1)
    told = [(name, "door", at) for name, at in zip(level.door_names, middles, strict=True)]
    told += [(name, type_, level.vertices[k]) for k, name, type_ in level.named]
    ids, renamed = unique_names([name for name, _, _ in told])
    nodes = [
        Node(identifier, float(at[0]), float(at[1]), type=type_)
        for identifier, (_, type_, at) in zip(ids, told, strict=True)
    ]
    ways, odd = lane_ways(ids, level.doors, [k for k, _, _ in level.named], level.vertices, level.lanes)
    map_, more = graph_map(level.name, nodes, ways)
    walls = tuple(wall for wall in level.walls if (wall[0] != wall[1]).any())
    remarks = (*remark(renamed, "names that stand more than once", "numbered"), *odd, *more)
    return map_.replace(walls=walls), remarks


def read_levels(path: Path, part: str | None = None) -> tuple[tuple[Level, ...], tuple[str, ...]]:
    """All levels of a building, or ``part`` alone, and what was left out of the building itself.

    Raises `InputError` for a level that isn't there, `FileFormatError` for a file that breaks the rules.
    """
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
    found = []
    for key, record in levels.items():
        if part is None or key == part:
            level = check.mapping(record, f"levels.{key}")
            found.append(_level(name, str(key), level, f"levels.{key}", pixels, check))
    check.done()
    lifts = document.get("lifts")
    return tuple(found), counted({"lifts": len(lifts) if isinstance(lifts, (Mapping, list)) else 0}, "left out")


def _level(name: str, part: str, level: Mapping[str, Any], place: str, pixels: bool, check: Checker) -> Level:
    vertices = [
        _vertex(v, f"{place}.vertices[{k}]", check)
        for k, v in enumerate(check.items(level.get("vertices", []), f"{place}.vertices"))
    ]
    raw = np.array([v[0] for v in vertices], dtype=float).reshape(-1, 2)
    scale, remarks = _scale(level, raw, place, check) if pixels else (1.0, ())
    xy = raw * (scale, -scale if pixels else scale)
    doors, walls, lanes = (_pairs(level, key, len(xy), place, check) for key in ("doors", "walls", "lanes"))
    left = {key: len(level[key]) for key in _LEFT_OUT if isinstance(level.get(key), (list, Mapping))}
    return Level(
        name=f"{name}-{part}",
        part=part,
        vertices=xy,
        named=tuple((k, text, type_) for k, (_, text, type_) in enumerate(vertices) if text),
        doors=_segments(xy, doors),
        door_names=tuple(_door_name(record, k) for k, (_, _, record) in enumerate(doors, start=1)),
        walls=_segments(xy, walls),
        lanes=tuple(Lane(a, b, _value(record.get("bidirectional")) is True) for a, b, record in lanes),
        remarks=(*remarks, *counted(left, "left out")),
    )


def _segments(xy: Array, pairs: Sequence[tuple[int, int, Any]]) -> Array:
    return np.asarray(xy[np.array([pair[:2] for pair in pairs], dtype=np.intp).reshape(-1, 2)])


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
