"""GraphNav maps of Boston Dynamics' Spot: a ``graph`` file, or the folder that holds it. Needs bosdyn-api.

Waypoints become point landmarks with their ways, fiducials that the anchoring holds become landmarks of type
``fiducial``. Positions are metres in the seed frame where the map is anchored, else in that of the first waypoint, from
edge to edge; z is up in both, so that x and y are kept and z is left out. Waypoints that nothing joins to the first one
are left out and said.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..errors import FileFormatError, InputError, MapfuseError, Problem
from ..maps import Landmark
from .checks import Checker, yaw_of
from .graphs import Node, Way, graph_map, unique_names
from .heads import read_bytes
from .reading import Reading, remark

Array = NDArray[np.float64]

KEY = "graphnav"
FIDUCIAL = "fiducial"
FILE = "graph"
#: Larger files are refused [bytes]: graphs have a kilobyte per waypoint.
MAX_BYTES = 2**26
_SNAPSHOTS = "waypoint_snapshots"


def detect(path: Path, head: bytes) -> bool:
    """A folder with ``graph`` and snapshots, or that file."""
    folder = path if path.is_dir() else path.parent
    return (folder / FILE).is_file() and (folder / _SNAPSHOTS).is_dir() and (path.is_dir() or path.name == FILE)


def read(path: Path) -> Reading:
    """The map of a graph, named as its folder."""
    graph = _graph(path / FILE if path.is_dir() else path)
    check = Checker(path)
    poses, told = _poses(graph, check)
    known = [waypoint for waypoint in graph.waypoints if waypoint.id in poses]
    lost = [waypoint.id for waypoint in graph.waypoints if waypoint.id not in poses]
    nodes = [
        Node(waypoint.id, float(pose[0]), float(pose[1]), extra=_kept(waypoint, pose))
        for waypoint, pose in ((waypoint, poses[waypoint.id]) for waypoint in known)
    ]
    edges = [(edge.id.from_waypoint, edge.id.to_waypoint) for edge in graph.edges]
    # an edge can be walked both ways, and stands once
    there = set(edges)
    ways = [Way(a, b) for a, b in edges] + [Way(b, a) for a, b in edges if (b, a) not in there]
    check.done()
    folder = path if path.is_dir() else path.resolve().parent
    map_, remarks = graph_map(folder.name or "graph", nodes, ways)
    fiducials = _fiducials(graph, set(map_.ids), check)
    check.done()
    more = remark(lost, "waypoints that nothing joins to the first one", "left out")
    return Reading((map_.replace(landmarks=(*map_.landmarks, *fiducials)),), (*told, *remarks, *more))


def _graph(path: Path) -> Any:
    try:
        from bosdyn.api.graph_nav import map_pb2
        from google.protobuf.message import DecodeError
    except ImportError as error:
        raise MapfuseError(f"{path}: a GraphNav map needs bosdyn-api: pip install 'mapfuse[graphnav]'") from error
    data = read_bytes(path, MAX_BYTES)
    graph = map_pb2.Graph()
    try:
        graph.ParseFromString(data)
    except (DecodeError, RecursionError) as error:
        raise FileFormatError(path, (Problem("", "is no GraphNav graph: it can't be decoded"),)) from error
    if not graph.waypoints:
        raise InputError(path, "is no GraphNav graph, or one without waypoints")
    return graph


def _kept(waypoint: Any, pose: Array) -> Mapping[str, Any]:
    name = waypoint.annotations.name
    return {KEY: {"orientation": float(pose[2]), **({"name": name} if name else {})}}


def _planar(transform: Any, place: str, check: Checker) -> Array:
    at, q = transform.position, transform.rotation
    x, y = check.number(at.x, f"{place}.position.x"), check.number(at.y, f"{place}.position.y")
    parts = [check.number(getattr(q, axis), f"{place}.rotation.{axis}", -1e6, 1e6) for axis in "xyzw"]
    yaw = yaw_of(*parts)
    # protobuf leaves out what is 0: a rotation without any number is none
    return np.array([x, y, 0.0 if yaw is None else yaw])


def _poses(graph: Any, check: Checker) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Poses of waypoints in the plane, and what they were taken from."""
    anchors = {
        anchor.id: _planar(anchor.seed_tform_waypoint, f"anchoring.anchors[{k}]", check)
        for k, anchor in enumerate(graph.anchoring.anchors)
    }
    ids = {waypoint.id for waypoint in graph.waypoints}
    if anchors and ids <= anchors.keys():
        return anchors, ()
    near: dict[str, list[tuple[str, Array]]] = {}
    for k, edge in enumerate(graph.edges):
        a, b = edge.id.from_waypoint, edge.id.to_waypoint
        motion = _planar(edge.from_tform_to, f"edges[{k}].from_tform_to", check)
        if a in ids and b in ids:
            near.setdefault(a, []).append((b, motion))
            near.setdefault(b, []).append((a, se2.inverse(motion)))
    check.done()
    known = {identifier: pose for identifier, pose in anchors.items() if identifier in ids}
    poses = known or {graph.waypoints[0].id: np.zeros(3)}
    queue = deque(poses)
    while queue:
        a = queue.popleft()
        for b, motion in near.get(a, ()):
            if b not in poses:
                poses[b] = se2.compose(poses[a], motion)
                queue.append(b)
    source = (
        "from edge to edge, beginning at the anchored ones" if known else "from edge to edge: the map isn't anchored"
    )
    return poses, (f"positions of waypoints are taken {source}",)


def _fiducials(graph: Any, taken: set[str], check: Checker) -> tuple[Landmark, ...]:
    if not graph.anchoring.anchors:
        return ()
    objects = list(graph.anchoring.objects)
    names = [f"{FIDUCIAL}-{o.id}" if f"{FIDUCIAL}-{o.id}" not in taken else f"{FIDUCIAL}-{o.id}-" for o in objects]
    found = []
    for k, (name, item) in enumerate(zip(unique_names(names)[0], objects, strict=True)):
        pose = _planar(item.seed_tform_object, f"anchoring.objects[{k}]", check)
        found.append(Landmark(name, FIDUCIAL, float(pose[0]), float(pose[1])))
    return tuple(found)
