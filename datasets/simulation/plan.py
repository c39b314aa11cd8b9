"""Vector plans: a floor drawn as GeoJSON to a `Building`.

What is read of a file (UTF-8, a FeatureCollection), by each feature's property ``type``:

===============  =====================================  ==========================================================
type             geometry                               meaning
===============  =====================================  ==========================================================
corridor, path,  LineString, MultiLineString            a line that robots can drive along
pathway
wall, window,    LineString, MultiLineString, Polygon,  wall; of a polygon its rings
building_outline MultiPolygon
inaccessible_space
door             Point, LineString, Polygon             a door: where it is, the line across its opening, its outline
===============  =====================================  ==========================================================

Anything else is passed over. Coordinates are longitude and latitude in degrees (WGS 84), as the standard (RFC 7946)
has them, or metres where the document has the member ``"units": "m"``. Optional members of the document: ``name``,
``width`` [m] of the corridors, ``north`` [rad] the direction of magnetic north counter-clockwise from x.

Places and arms follow from the corridors' lines: ends, bends, junctions. Doors that a line leads through stand open and
are no landmarks; all others are closed, and stand as landmarks on the nearest line from which they can be seen.
Without corridors, lines midway between the walls are used, of the spaces that most doors open to. Without walls, walls
are built around the corridors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..errors import FileFormatError, InputError, Problem, TooLargeError
from ..files import read_whole
from ..jsondata import decode, render, said
from ..values import frozen_array
from .building import DOOR_WIDTH, Building, build
from .corridorgraph import corridor_graph
from .floors import Arm, DoorAt, Floor, Place, bearing, floor_from_graph
from .raycast import cast, clear, distances, nearest_points

Array = NDArray[np.float64]
Where = tuple[str | int, ...]

#: Larger files are refused [bytes], and plans that reach further than this [m], which no floor does.
MAX_BYTES, MAX_EXTENT = 64 * 2**20, 5000.0
#: A door's landmark is at most this far [m] from the door; doors nearer to each other along a corridor are one.
DOOR_REACH, ONE_DOOR = 3.0, 0.8
#: Where no wall says how wide corridors are [m], and how wide they may be.
WIDTH, WIDTHS = 2.0, (0.6, 6.0)

_CORRIDORS = {"corridor", "path", "pathway"}
_WALLS = {"wall", "window", "building_outline", "inaccessible_space"}
_GEOMETRIES = {
    "corridor": {"LineString", "MultiLineString"},
    "wall": {"LineString", "MultiLineString", "Polygon", "MultiPolygon"},
    "door": {"Point", "LineString", "Polygon"},
}
_DEPTH = {"Point": 0, "LineString": 1, "MultiLineString": 2, "Polygon": 2, "MultiPolygon": 3}
_LON_LAT = ("CRS84", "EPSG::4326", "EPSG:4326")
_EQUATOR, _FLATTENING = 6378137.0, 1 / 298.257223563


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """What a plan's file holds, in metres: corridor lines (k, 2) each, walls (n, 2, 2), doors.

    ``doors`` (m, 2, 2): lines across the openings, of length 0 where the file has a point; ``leaves`` (l, 2, 2): the
    doors' outlines, which are wall while the doors are closed, and ``door_of_leaf`` (l,) the door of each.
    ``origin``: longitude and latitude [degrees] of (0, 0); None for a plan in metres.
    """

    name: str
    lines: tuple[Array, ...]
    walls: Array
    doors: Array
    leaves: Array
    door_of_leaf: NDArray[np.intp]
    north: float = float(np.pi / 2)
    width: float | None = None
    origin: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "lines", tuple(frozen_array(line) for line in self.lines))
        for name in ("walls", "doors", "leaves"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))


def _closed(doors: Array, lines: Sequence[Array]) -> NDArray[np.bool_]:
    """Of each of ``doors`` (m, 2, 2) whether no corridor line leads through it, as (m,)."""
    through = np.zeros(len(doors), dtype=bool)
    for line in lines:
        for a, b in pairwise(line):
            length = float(np.hypot(*(b - a)))
            near = np.flatnonzero(~through & (distances(((a + b) / 2)[None], doors)[0] <= length / 2))
            for k in near:
                through[k] = np.isfinite(cast(a, [bearing(a, b)], doors[k : k + 1], length)[0])
    return ~through


def building_from_plan(
    path: str | Path,
    corridors: str | Path | None = None,
    *,
    steel_sigma: float = 0.15,
    steel_length: float = 4.0,
    seed: int | np.random.Generator = 0,
) -> Building:
    """The building that a vector plan shows; the module's text says what is read of the file.

    ``corridors``: a second file of the same floor, whose features are read as if they stood in the first. x points
    East and y North from the middle of a plan in longitude and latitude. ``path`` may be a building of Open-RMF
    (``*.building.yaml``, or ``*.building.yaml#LEVEL``), whose lanes are the corridors (`formats.rmf`). Steel, which no
    plan shows, is drawn as in `build`. Of the corridors the largest connected part is used.

    Raises `InputError` for a file that can't be read, `FileFormatError` (file, place, reason) for one that breaks the
    rules or has neither corridors nor anything to find them by.
    """
    found, part = _of_rmf(path)
    if found is not None:
        from ..formats.rmf import level_plan

        if corridors is not None:
            raise InputError(path, "is a building whose lanes are its corridors: a second file with some isn't read")
        plan = level_plan(found, part)
    else:
        plan = read_plan(path, corridors)
    return building_of(plan, path, steel_sigma=steel_sigma, steel_length=steel_length, seed=seed)


def _of_rmf(path: str | Path) -> tuple[Path | None, str | None]:
    """The file of an Open-RMF building and the level that is wanted of it (``FILE#LEVEL``); None for other files."""
    from ..formats.registry import split_part
    from ..formats.rmf import is_named_so

    file, part = split_part(path)
    return (file, part) if is_named_so(file) else (None, None)


def building_of(
    plan: Plan,
    path: str | Path,
    place: str = "features",
    *,
    steel_sigma: float = 0.15,
    steel_length: float = 4.0,
    seed: int | np.random.Generator = 0,
) -> Building:
    """The building that a plan shows; ``path`` and ``place`` of the plan's file are for errors. Steel as in `build`.

    Raises `FileFormatError` where it has neither corridors nor anything to find them by.
    """
    # imported here because the extraction uses the corridor graph of this folder
    from ..extract.plangrid import plan_lines

    try:
        lines = plan.lines or plan_lines(plan.walls, plan.doors, plan.leaves, plan.door_of_leaf)
        closed = _closed(plan.doors, lines)
        walls = np.concatenate([plan.walls, plan.leaves[closed[plan.door_of_leaf]]])
        nodes, edges = corridor_graph(lines, walls)
    except TooLargeError as error:
        raise FileFormatError(path, (Problem(place, f"hold {error}"),)) from None
    if not edges:
        reason = "hold no corridor, and no walls that one could be found between"
        raise FileFormatError(path, (Problem(place, reason),))
    width = plan.width or _width(nodes, edges, walls)
    floor = replace(_floor(plan.name, nodes, edges, plan.doors[closed], walls, plan.north), width=width)
    built = build(floor, steel_sigma=steel_sigma, steel_length=steel_length, seed=seed)
    return replace(built, walls=walls) if len(plan.walls) else built


def read_plan(path: str | Path, corridors: str | Path | None = None) -> Plan:
    """The plan in a file, and in a second one of the same floor; see `building_from_plan` for files and errors."""
    reader = _Reader()
    documents = [reader.add(source) for source in (path, corridors) if source is not None]
    metres = documents[0].get("units") == "m"
    if corridors is not None and (documents[1].get("units") == "m") != metres:
        raise FileFormatError(corridors, (Problem("units", "must be as in the first file"),))
    points = reader.points
    if not len(points):
        raise FileFormatError(path, (Problem("features", "hold no corridor, wall or door"),))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    origin = None if metres else (float(middle[0]), float(middle[1]))
    shapes = [(kind, _projected(parts, origin)) for kind, parts in reader.shapes]
    extent = np.ptp(np.vstack([part for _, parts in shapes for part in parts]), axis=0).max()
    if extent > MAX_EXTENT:
        reason = f"reach over {extent:,.0f} m, and no floor more than {MAX_EXTENT:,.0f} m; see units"
        raise FileFormatError(path, (Problem("features", reason),))
    doors = [parts for kind, parts in shapes if kind == "door"]
    leaves = [_segments(parts) for parts in doors]
    return Plan(
        name=documents[0].get("name") or Path(path).name.partition(".")[0],
        lines=tuple(part for kind, parts in shapes if kind == "corridor" for part in parts if len(part) > 1),
        walls=np.concatenate([_NONE, *(_segments(parts) for kind, parts in shapes if kind == "wall")]),
        doors=np.array([_across(parts[0]) for parts in doors]).reshape(-1, 2, 2),
        leaves=np.concatenate([_NONE, *leaves]),
        door_of_leaf=np.repeat(np.arange(len(doors)), [len(leaf) for leaf in leaves]),
        north=documents[0].get("north", np.pi / 2),
        width=documents[0].get("width"),
        origin=origin,
    )


_NONE: Array = np.zeros((0, 2, 2))


class _Reader:
    """Features of one or more files as (kind, parts): each part an array (k, 2) as it stands in the file."""

    def __init__(self) -> None:
        self.shapes: list[tuple[str, list[Array]]] = []

    @property
    def points(self) -> Array:
        return np.vstack([np.zeros((0, 2)), *(part for _, parts in self.shapes for part in parts)])

    def add(self, path: str | Path) -> dict[str, Any]:
        document, problems = decode(read_whole(path, MAX_BYTES), path)
        if not problems:
            problems = tuple(Problem(render(where), reason) for where, reason in self._read(document))
        if problems:
            raise FileFormatError(path, problems)
        return dict(document)

    def _read(self, document: Any) -> Iterator[tuple[Where, str]]:
        if not isinstance(document, Mapping) or document.get("type") != "FeatureCollection":
            yield ("type",), 'is missing or not "FeatureCollection": this is no GeoJSON of a floor'
            return
        yield from _document_faults(document)
        features = document.get("features")
        if not isinstance(features, list):
            yield ("features",), f"must be a list, not {said(features)}"
            return
        metres = document.get("units") == "m"
        for k, feature in enumerate(features):
            yield from self._read_feature(feature, ("features", k), metres)

    def _read_feature(self, feature: Any, where: Where, metres: bool) -> Iterator[tuple[Where, str]]:
        if not isinstance(feature, Mapping):
            yield where, f"must be an object, not {said(feature)}"
            return
        properties = feature.get("properties")
        kind = _kind(properties.get("type") if isinstance(properties, Mapping) else None)
        if kind is None:
            return
        geometry = feature.get("geometry")
        shape = geometry.get("type") if isinstance(geometry, Mapping) else None
        if not isinstance(geometry, Mapping) or not isinstance(shape, str) or shape not in _GEOMETRIES[kind]:
            allowed = ", ".join(sorted(_GEOMETRIES[kind]))
            yield (*where, "geometry"), f"of a {kind} must be one of {allowed}, not {said(shape)}"
            return
        parts: list[Array] = []
        faults = list(_parts(geometry.get("coordinates"), _DEPTH[shape], (*where, "geometry", "coordinates"), parts))
        if not faults:
            faults = list(_range_faults(parts, metres, (*where, "geometry", "coordinates")))
        yield from faults
        if parts and not faults:
            self.shapes.append((kind, parts))


def _kind(type_: Any) -> str | None:
    if not isinstance(type_, str):
        return None
    return "corridor" if type_ in _CORRIDORS else "wall" if type_ in _WALLS else "door" if type_ == "door" else None


def _document_faults(document: Mapping[str, Any]) -> Iterator[tuple[Where, str]]:
    if document.get("units") not in (None, "m"):
        yield ("units",), f'must be "m" or left out, not {said(document["units"])}'
    if not isinstance(document.get("name", ""), str):
        yield ("name",), f"must be text, not {said(document['name'])}"
    for key, low, high in (("width", 0.3, 50.0), ("north", -2 * np.pi, 2 * np.pi)):
        value = document.get(key, low)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
            yield (key,), f"must be a number from {low:.4g} to {high:.4g}, not {said(value)}"
    crs = document.get("crs")
    named = crs.get("properties") if isinstance(crs, Mapping) else None
    name = named.get("name") if isinstance(named, Mapping) else None
    if document.get("units") != "m" and crs is not None and not (isinstance(name, str) and name.endswith(_LON_LAT)):
        yield ("crs",), f'is {said(name)}; longitude and latitude (CRS84) are read, or metres with "units": "m"'


def _parts(value: Any, depth: int, where: Where, found: list[Array]) -> Iterator[tuple[Where, str]]:
    """Collect the lists of positions ``depth`` levels down (0: one position); what is wrong on the way."""
    if depth == 0:
        yield from _position_faults(value, where)
        found.append(_as_points([value]))
    elif not isinstance(value, list):
        yield where, f"must be a list, not {said(value)}"
    elif depth > 1:
        for k, item in enumerate(value):
            yield from _parts(item, depth - 1, (*where, k), found)
    elif len(value) < 2:
        yield where, f"must hold at least two positions, not {len(value)}"
    else:
        for k, item in enumerate(value):
            yield from _position_faults(item, (*where, k))
        found.append(_as_points(value))


def _as_points(positions: Sequence[Any]) -> Array:
    """Positions (k, 2) without heights; none where one of them is faulty, which is said elsewhere."""
    if any(next(_position_faults(position, ()), None) for position in positions):
        return np.zeros((0, 2))
    return np.array([position[:2] for position in positions], dtype=float)


def _position_faults(position: Any, where: Where) -> Iterator[tuple[Where, str]]:
    if not isinstance(position, list) or len(position) < 2:
        yield where, f"must be a list of two numbers, not {said(position)}"
        return
    for k, number in enumerate(position[:2]):
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not abs(number) <= 1e9:
            yield (*where, k), f"must be a number of at most 1e9, not {said(number)}"


def _range_faults(parts: Sequence[Array], metres: bool, where: Where) -> Iterator[tuple[Where, str]]:
    """Degrees that are none; near the poles there is no East."""
    points = np.vstack([np.zeros((0, 2)), *parts])
    if not metres and len(points) and (np.abs(points) > (180.0, 89.0)).any():
        yield where, 'are no longitude and latitude in degrees; a plan in metres says "units": "m"'


def _projected(parts: Sequence[Array], origin: tuple[float, float] | None) -> list[Array]:
    """Longitude and latitude [degrees] to metres East and North of ``origin``; metres as they are.

    By the ellipsoid's two radii of curvature at the origin: over 1 km the error is below 0.2 m at 60 degrees.
    """
    if origin is None:
        return list(parts)
    latitude = np.deg2rad(origin[1])
    squared = _FLATTENING * (2 - _FLATTENING)
    w = np.sqrt(1 - squared * np.sin(latitude) ** 2)
    scale = np.deg2rad(1) * np.array([_EQUATOR / w * np.cos(latitude), _EQUATOR * (1 - squared) / w**3])
    return [(part - origin) * scale for part in parts]


def _segments(parts: Sequence[Array]) -> Array:
    """The segments (n, 2, 2) of lines or rings, those of no length left out."""
    found = np.concatenate([_NONE, *(np.stack([part[:-1], part[1:]], axis=1) for part in parts if len(part) > 1)])
    return np.asarray(found[np.hypot(*(found[:, 1] - found[:, 0]).T) > 1e-6], dtype=float)


def _across(points: Array) -> Array:
    """The line (2, 2) across a door's opening: through the middle of its outline, along its longer side."""
    if len(points) > 2:
        points = points[:-1] if np.array_equal(points[0], points[-1]) else points
    middle = (points.min(axis=0) + points.max(axis=0)) / 2 if len(points) < 3 else points.mean(axis=0)
    off = points - middle
    along = np.linalg.eigh(off.T @ off)[1][:, 1]
    reach = off @ along
    return np.array([middle + reach.min() * along, middle + reach.max() * along])


def _width(nodes: Sequence[tuple[float, float]], edges: Sequence[tuple[int, int]], walls: Array) -> float:
    """Twice the median distance [m] from the corridors' lines to the nearest wall."""
    if not len(walls):
        return WIDTH
    points = [np.linspace(nodes[a], nodes[b], 2 + int(np.hypot(*np.subtract(nodes[a], nodes[b])))) for a, b in edges]
    away = [distances(piece, walls).min(axis=1) for piece in points]
    return float(np.clip(2 * np.median(np.concatenate(away)), *WIDTHS))


@dataclass(frozen=True, slots=True)
class _Landing:
    """Where a door's landmark stands: ``along`` [m] of edge ``edge``, ``direction`` [rad] to the door."""

    edge: int
    along: float
    direction: float


def _floor(
    name: str,
    nodes: Sequence[tuple[float, float]],
    edges: Sequence[tuple[int, int]],
    doors: Array,
    walls: Array,
    north: float,
) -> Floor:
    """The floor of that graph; doors beside a corridor are places, doors at a node are arms of that."""
    lines = np.array([[nodes[a], nodes[b]] for a, b in edges])
    lengths = np.hypot(*(lines[:, 1] - lines[:, 0]).T)
    landings = [landing for door in doors if (landing := _landing(door, lines, lengths, walls))]
    beside = [l for l in landings if ONE_DOOR / 2 < l.along < lengths[l.edge] - ONE_DOOR / 2]
    spots, arms = [], []
    for edge, along, directions in _joined(beside):
        way = bearing(*lines[edge])
        sides = sorted({1 if np.sin(direction - way) > 0 else -1 for direction in directions})
        spots.append(DoorAt(*edges[edge], along, sides[0]))
        arms.append([way + side * np.pi / 2 for side in sides])
    floor = floor_from_graph(name, nodes, edges, spots, north)
    open_doors = {f"d{k}": directions for k, directions in enumerate(arms)}
    for landing in landings:
        if landing not in beside:
            node = edges[landing.edge][0 if landing.along < lengths[landing.edge] / 2 else 1]
            open_doors.setdefault(f"p{node}", []).append(landing.direction)
    return replace(floor, places=tuple(_with_doors(place, open_doors.get(place.id, [])) for place in floor.places))


def _landing(door: Array, lines: Array, lengths: Array, walls: Array) -> _Landing | None:
    """The nearest point of a corridor from which the door (2, 2) is seen, not too aslant; None: there is none."""
    middle = door.mean(axis=0)
    feet = nearest_points(middle[None], lines)[0]
    away = np.hypot(*(feet - middle).T)
    wide = float(np.hypot(*(door[1] - door[0])))
    for k in np.argsort(away):
        if away[k] > DOOR_REACH:
            return None
        direction = bearing(feet[k], middle)
        # a door stands in a wall as thick as half its width at most; the face of it is what is seen
        face = feet[k] + max(0.0, away[k] - min(0.3, DOOR_WIDTH / 2)) * np.array([np.cos(direction), np.sin(direction)])
        aslant = wide > 1e-6 and abs(np.cos(bearing(*door) - direction)) > np.sqrt(0.5)
        if not aslant and (not len(walls) or clear(feet[k], face[None], walls)[0]):
            return _Landing(int(k), float(np.hypot(*(feet[k] - lines[k, 0]))), direction)
    return None


def _joined(landings: Sequence[_Landing]) -> Iterator[tuple[int, float, list[float]]]:
    """Edge, place along it and directions of doors, those within `ONE_DOOR` of the first of them taken together."""
    ordered = sorted(landings, key=lambda l: (l.edge, l.along))
    for edge, group in groupby(ordered, key=lambda l: l.edge):
        left = list(group)
        while left:
            ours = [l for l in left if l.along - left[0].along < ONE_DOOR]
            left = left[len(ours) :]
            yield edge, float(np.mean([l.along for l in ours])), [l.direction for l in ours]


def _with_doors(place: Place, directions: Sequence[float]) -> Place:
    """The same place with doors for the blocked arms that point to within 45 degrees of ``directions`` [rad]."""

    def has_door(arm: Arm) -> bool:
        off = [abs(float(se2.wrap(arm.direction - direction))) for direction in directions]
        return arm.type == "blocked" and min(off, default=np.inf) < np.pi / 4

    return replace(place, arms=tuple(replace(arm, type="door") if has_door(arm) else arm for arm in place.arms))
