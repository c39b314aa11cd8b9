"""Graphs of the Nav2 Route Server: GeoJSON with points as nodes and lines as directed edges.

Coordinates are metres in the robots' ``map`` frame, x and y to the right-handed side, whatever the file's ``crs`` says:
the editors that make these files write that of web maps, which is false. Ids are whole numbers; a landmark's own id and
type go into the ``metadata`` of its node, as ``mapfuse_id`` and ``mapfuse_type``, and are taken from there again. All
else that a node or an edge says is kept under `KEY` and written back.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..arms import wrap
from ..files import write_whole
from ..jsondata import decode, encode
from ..maps import Landmark, LandmarkMap
from .checks import Checker
from .gis import LOCAL_CRS
from .graphs import BENT as WAY_BENT
from .graphs import WAYPOINT, WAYS, Node, Way, graph_map, ways_of
from .heads import plain_name, read_bytes, stem
from .reading import Reading, remark

_LOG = logging.getLogger(__name__)

KEY = "nav2"
#: What is written of ``extra``.
KEPT = frozenset((KEY, WAYS))
ENDINGS = (".nav2.geojson", ".geojson", ".json")
ID, TYPE = "mapfuse_id", "mapfuse_type"
#: Says in an edge's metadata that nobody went straight from its start to its end.
MARK_BENT = "mapfuse_bent"
#: An arm that points elsewhere than to the other end by this [rad] leads there round a corner.
BENT = math.radians(20.0)

_LINES = ("LineString", "MultiLineString")
_EDGE = re.compile(rb'"startid"\s*:')
_NODE = re.compile(rb'"id"\s*:\s*\d+\s*[,}].{0,400}?"Point"|"Point".{0,400}?"id"\s*:\s*\d+', re.DOTALL)
_OWN = {"id", "startid", "endid"}


def detect(path: Path, head: bytes) -> bool:
    """A collection of features, of which some have ``startid``, or which only has points with whole numbers as ids."""
    if not plain_name(path).endswith((".geojson", ".json")) or b'"FeatureCollection"' not in head:
        return False
    if _EDGE.search(head):
        return True
    # nodes come first, and the edges of a large graph after what is shown here
    return b'"Polygon"' not in head and b'"LineString"' not in head and _NODE.search(head) is not None


def read(path: Path) -> Reading:
    """The map of a file, named as the collection or else as the file."""
    document, faults = decode(read_bytes(path), path)
    check = Checker(path)
    check.problems += faults
    top = check.mapping(document, "")
    remarks = _false_crs(top, check)
    nodes: list[Node] = []
    ways: list[Way] = []
    name_from_id: dict[str, str] = {}
    edges: list[tuple[Mapping[str, Any], str]] = []
    for k, record in enumerate(check.items(top.get("features"), "features")):
        place = f"features[{k}]"
        feature = check.mapping(record, place)
        geometry = check.mapping(feature.get("geometry"), f"{place}.geometry")
        properties = check.mapping(feature.get("properties"), f"{place}.properties")
        if geometry.get("type") == "Point":
            number, node = _node(properties, geometry, place, check)
            name_from_id.setdefault(number, node.name)
            nodes.append(node)
        elif geometry.get("type") in _LINES:
            edges.append((properties, place))
        elif geometry:
            check.fault(f"{place}.geometry.type", "must be Point, LineString or MultiLineString")
    for properties, place in edges:
        ways.append(_way(properties, f"{place}.properties", name_from_id, check))
    check.done()
    name = top.get("name")
    map_, more = graph_map(name if isinstance(name, str) and name else stem(path, *ENDINGS), nodes, ways)
    return Reading((map_,), remarks + more)


def _false_crs(top: Mapping[str, Any], check: Checker) -> tuple[str, ...]:
    crs = top.get("crs")
    properties = crs.get("properties") if isinstance(crs, Mapping) else None
    name = str(properties.get("name", "")) if isinstance(properties, Mapping) else ""
    if name.endswith(("CRS84", ":4326")):
        check.fault("crs", f"is {name[:60]}: degrees, and a graph of the Route Server has metres")
        return ()
    stated = f"the coordinate reference system {name[:60]} is stated, and the coordinates are metres of a robot's map"
    return (f"{stated}: ignored",) if name and not name.startswith(("ENGCRS[", "LOCAL_CS[")) else ()


def _node(properties: Mapping[str, Any], geometry: Mapping[str, Any], place: str, check: Checker) -> tuple[str, Node]:
    number = check.text(properties.get("id"), f"{place}.properties.id")
    coordinates = check.items(geometry.get("coordinates"), f"{place}.geometry.coordinates")
    if len(coordinates) < 2:
        check.fault(f"{place}.geometry.coordinates", "must be x and y")
        coordinates = [0.0, 0.0]
    x, y = (check.number(v, f"{place}.geometry.coordinates[{k}]") for k, v in enumerate(coordinates[:2]))
    metadata = properties.get("metadata")
    told = dict(metadata) if isinstance(metadata, Mapping) else {}
    name, type_ = told.pop(ID, None), told.pop(TYPE, None)
    kept = {key: value for key, value in properties.items() if key not in _OWN and key != "metadata"}
    kept |= {"metadata": told} if told else {}
    return number, Node(
        name if isinstance(name, str) and name else number,
        x,
        y,
        None,
        type_ if isinstance(type_, str) and type_ else WAYPOINT,
        {KEY: kept} if kept else {},
    )


def _way(properties: Mapping[str, Any], place: str, name_from_id: Mapping[str, str], check: Checker) -> Way:
    start, end = (check.text(properties.get(key), f"{place}.{key}") for key in ("startid", "endid"))
    number = properties.get("id")
    kept = {key: value for key, value in properties.items() if key not in _OWN}
    return Way(
        name_from_id.get(start, f"id {start}"),
        name_from_id.get(end, f"id {end}"),
        None if number is None else str(number),
        {KEY: kept},
    )


def write(map_: LandmarkMap, path: Path) -> None:
    """Write a map as a graph: landmarks as nodes 0, 1, ...; ways as edges, numbered on.

    A way that a robot recorded at one end can be driven from both; one that another graph had goes as it went there.
    Edges are straight: one whose way went round a corner says so in its metadata, and a warning names it.
    """
    number = {landmark.id: k for k, landmark in enumerate(map_.landmarks)}
    features = [_point(landmark, number[landmark.id]) for landmark in map_.landmarks]
    directed: dict[tuple[str, str], Mapping[str, Any]] = {}
    back: dict[tuple[str, str], Mapping[str, Any]] = {}
    for landmark, end, extra in ways_of(map_):
        directed.setdefault((landmark.id, end), extra)
        if not any(isinstance(value, Mapping) for value in extra.values()):
            back.setdefault((end, landmark.id), extra)
    for (start, end), extra in (
        directed | {ends: extra for ends, extra in back.items() if ends not in directed}
    ).items():
        kept = extra.get(KEY)
        features.append(_line(map_, start, end, len(features), number, kept if isinstance(kept, Mapping) else {}))
    bent = [f"{a} to {b}" for a, b in (directed | back) if _bent(map_, a, b)]
    for text in remark(bent, "ways round a corner that wasn't recorded", f"straight edges, with {MARK_BENT}"):
        _LOG.warning("%s: %s", path, text)
    document = {"type": "FeatureCollection", "name": map_.name, "crs": LOCAL_CRS, "features": features}
    write_whole(path, encode(document))


def _bent(map_: LandmarkMap, start: str, end: str) -> bool:
    """Whether a way leads round a corner where no landmark is: it says so, or an arm at either end points elsewhere."""
    for a, b in ((start, end), (end, start)):
        if any(link.extra.get(WAY_BENT) is True for link in map_[a].links if link.connected_to_id == b):
            return True
        step = map_[b].x - map_[a].x, map_[b].y - map_[a].y
        headings = [link.heading for link in map_[a].links if link.connected_to_id == b and link.heading is not None]
        if math.hypot(*step) > 1 and any(abs(wrap(math.atan2(step[1], step[0]) - h)) > BENT for h in headings):
            return True
    return False


def _point(landmark: Landmark, number: int) -> dict[str, Any]:
    kept = landmark.extra.get(KEY)
    kept = dict(kept) if isinstance(kept, Mapping) else {}
    told = {ID: landmark.id} if landmark.id != str(number) else {}
    told |= {TYPE: landmark.type} if landmark.type != WAYPOINT else {}
    metadata = {**kept.pop("metadata", {}), **told}
    properties = {"id": number, **kept} | ({"metadata": metadata} if metadata else {})
    geometry = {"type": "Point", "coordinates": [float(landmark.x), float(landmark.y)]}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _line(
    map_: LandmarkMap, start: str, end: str, number: int, number_from_id: Mapping[str, int], kept: Mapping[str, Any]
) -> dict[str, Any]:
    ends = [[float(map_[one].x), float(map_[one].y)] for one in (start, end)]
    if _bent(map_, start, end):
        kept = {**kept, "metadata": {**kept.get("metadata", {}), MARK_BENT: True}}
    properties = {"id": number, **kept, "startid": number_from_id[start], "endid": number_from_id[end]}
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "MultiLineString", "coordinates": [ends]},
    }
