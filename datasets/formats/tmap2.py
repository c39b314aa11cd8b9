"""Topological maps of LCAS and STRANDS: ``tmap2`` (an object with ``nodes``) and the older lists (tplg, tmap), in YAML.

A node has a name, a pose in the frame of the metric map [m], and edges to other nodes. Its orientation is where a robot
is to look that stops there, not a property of the place, and often all zeros; it is kept as the file has it (under
`KEY`, as ``orientation`` [rad]) and is no heading of the landmark, which would be compared. What else a node and an
edge say is kept under the same key and written back.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..files import write_whole
from ..maps import Landmark, LandmarkMap
from . import safeyaml
from .checks import Checker
from .graphs import WAYPOINT, WAYS, Node, Way, graph_map, ways_of
from .heads import plain_name, stem
from .reading import Reading, remark

KEY = "tmap2"
#: What is written of ``extra``.
KEPT = frozenset((KEY, WAYS))
#: Property of a node that says a landmark's type, where it is no mere waypoint.
TYPE = "mapfuse_type"
ENDINGS = (".tmap2.yaml", ".tmap2", ".tplg", ".tmap", ".yaml", ".yml")

_LIST = re.compile(rb"(?m)^- (meta|node):")
_NODES = re.compile(rb"(?m)^nodes:")
_OWN_NODE = {"name", "pose", "edges"}
_OWN_EDGE = {"node"}
#: Corners of the area around a node in which a robot is at it: an octagon of 0.75 m.
_AREA = [(0.69, 0.29), (0.29, 0.69), (-0.29, 0.69), (-0.69, 0.29)]
_AREA += [(-x, -y) for x, y in _AREA]


def detect(path: Path, head: bytes) -> bool:
    """YAML with a list of nodes that have poses and edges."""
    if not plain_name(path).endswith(ENDINGS):
        return False
    return bool(_LIST.search(head) or _NODES.search(head)) and b"edges:" in head


def read(path: Path) -> Reading:
    """The map of a file; its name is ``name``, else the list's ``pointset``, else the file's."""
    document = safeyaml.load(path)
    check = Checker(path)
    top: Mapping[str, Any] = document if isinstance(document, Mapping) else {}
    records = check.items(top.get("nodes") if top else document, "nodes" if top else "the list of nodes")
    nodes, ways = [], []
    for k, record in enumerate(records):
        place = f"nodes[{k}]"
        node = check.mapping(check.mapping(record, place).get("node"), f"{place}.node")
        if node:
            nodes.append(_node(node, f"{place}.node", check))
            ways += _ways(node, nodes[-1].name, f"{place}.node.edges", check)
    check.done()
    map_, remarks = graph_map(_name(top, path), nodes, ways)
    silent = [node.name for node in nodes if node.extra[KEY]["orientation"] is None]
    about = {key: value for key, value in top.items() if key not in ("nodes", "name")}
    map_ = map_.replace(extra={KEY: about}) if about else map_
    return Reading((map_,), remarks + remark(silent, "nodes with an orientation of zeros", "taken as not known"))


def _name(top: Mapping[str, Any], path: Path) -> str:
    name = top.get("name")
    return name if isinstance(name, str) and name.strip() else stem(path, *ENDINGS)


def _node(record: Mapping[str, Any], place: str, check: Checker) -> Node:
    name = check.text(record.get("name"), f"{place}.name")
    pose = check.mapping(record.get("pose"), f"{place}.pose")
    position = check.mapping(pose.get("position"), f"{place}.pose.position")
    x, y = (check.number(position.get(key), f"{place}.pose.position.{key}") for key in "xy")
    yaw = check.yaw(pose.get("orientation"), f"{place}.pose.orientation")
    properties = record.get("properties")
    type_ = properties.get(TYPE) if isinstance(properties, Mapping) else None
    kept = {key: value for key, value in record.items() if key not in _OWN_NODE}
    if position.get("z"):
        kept["z"] = check.number(position["z"], f"{place}.pose.position.z")
    extra = {KEY: {"orientation": yaw, **kept}}
    return Node(name, x, y, None, type_ if isinstance(type_, str) and type_ else WAYPOINT, extra)


def _ways(record: Mapping[str, Any], start: str, place: str, check: Checker) -> list[Way]:
    found = []
    for k, item in enumerate(check.items(record.get("edges", []), place)):
        edge = check.mapping(item, f"{place}[{k}]")
        if edge:
            end = check.text(edge.get("node"), f"{place}[{k}].node")
            name = edge.get("edge_id")
            kept = {key: value for key, value in edge.items() if key not in _OWN_EDGE}
            found.append(Way(start, end, name if isinstance(name, str) else None, {KEY: kept}))
    return found


def write(map_: LandmarkMap, path: Path) -> None:
    """Write a map as tmap2, in its own coordinates, which should be those of the robots' metric map."""
    import yaml

    about = _kept(map_.extra)
    metric = about.get("metric_map", map_.name)
    edges: dict[str, list[dict[str, Any]]] = {landmark.id: [] for landmark in map_.landmarks}
    for landmark, end, extra in ways_of(map_):
        edges[landmark.id].append(_edge(landmark.id, end, _kept(extra)))
    document = {
        "meta": {"last_updated": "2000-01-01_00-00-00"},
        "metric_map": metric,
        "pointset": map_.name,
        **about,
        "name": map_.name,
        "nodes": [
            {
                "meta": {"map": metric, "node": landmark.id, "pointset": map_.name},
                "node": _record(landmark, edges[landmark.id]),
            }
            for landmark in map_.landmarks
        ],
    }
    write_whole(path, yaml.dump(document, Dumper=_dumper(yaml), sort_keys=True, allow_unicode=True))


def _dumper(yaml: Any) -> Any:
    class Plain(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
        def ignore_aliases(self, data: Any) -> bool:
            return True

    return Plain


def _kept(extra: Mapping[str, Any]) -> dict[str, Any]:
    kept = extra.get(KEY)
    return dict(kept) if isinstance(kept, Mapping) else {}


def _edge(start: str, end: str, kept: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "action": "NavigateToPose",
        "action_type": "geometry_msgs/PoseStamped",
        "config": [],
        "edge_id": f"{start}_{end}",
        "fail_policy": "fail",
        "fluid_navigation": True,
        "goal": {"target_pose": {"header": {"frame_id": "$node.parent_frame"}, "pose": "$node.pose"}},
        "recovery_behaviours_config": "",
        "restrictions_planning": "True",
        "restrictions_runtime": "True",
        **kept,
        "node": end,
    }


def _record(landmark: Landmark, edges: list[dict[str, Any]]) -> dict[str, Any]:
    kept = _kept(landmark.extra)
    yaw, z = kept.pop("orientation", None), kept.pop("z", 0.0)
    yaw = 0.0 if yaw is None else float(yaw)
    properties = dict(kept.pop("properties", None) or {"xy_goal_tolerance": 0.3, "yaw_goal_tolerance": 0.1})
    if landmark.type != WAYPOINT:
        properties[TYPE] = landmark.type
    return {
        "localise_by_topic": "",
        "parent_frame": "map",
        "restrictions_planning": "True",
        "restrictions_runtime": "True",
        "verts": [{"x": x, "y": y} for x, y in _AREA],
        **kept,
        "name": landmark.id,
        "pose": {
            "position": {"x": float(landmark.x), "y": float(landmark.y), "z": z},
            "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)},
        },
        "edges": edges,
        "properties": properties,
    }
