"""g2o graphs of a robot in the plane with landmarks: VERTEX_SE2, VERTEX_XY, EDGE_SE2, EDGE_SE2_XY.

Metres and radians; an edge's matrix is the upper triangle of its information, row by row, of a motion in the axes of
its end. What stands in the map is the
optimum of the edges (`slamgraph`). A map is written as its path and its landmarks, each with one edge from the first
pose that says its covariance; ids, types and times, which g2o has no place for, go into comments and are read again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..errors import MapfuseError
from ..files import write_whole
from ..maps import LandmarkMap
from .heads import plain_name, stem
from .reading import Reading
from .slamgraph import solved_map
from .slamlines import read_lines, triangle

Array = NDArray[np.float64]

TYPE = "landmark"
#: A covariance's standard deviations are at least this in a file, since none of g2o's may be infinitely sure [m].
LEAST_SIGMA_M = 1e-6
#: Begins the comment that says what g2o has no place for.
MARK = "mapfuse "

TAGS = {
    "VERTEX_SE2": ("pose", None),
    "VERTEX_XY": ("point", None),
    "EDGE_SE2": ("motion", triangle),
    "EDGE_SE2_XY": ("sighting", triangle),
    "LANDMARK2": ("sighting", triangle),
    "FIX": ("skip", None),
}


def detect(path: Path, head: bytes) -> bool:
    """By its ending or its first word."""
    return plain_name(path).endswith(".g2o") or head.lstrip().startswith((b"VERTEX_SE2", b"EDGE_SE2", b"VERTEX_XY"))


def read(path: Path, type: str = TYPE) -> Reading:
    """The map of a graph; raises `FileFormatError` for one in space, which is not for a map of the plane."""
    found, comments = read_lines(path, TAGS)
    found = replace(found, motions=tuple((a, b, z, _in_axes_of_start(z, I)) for a, b, z, I in found.motions))
    told = _told(comments)
    ids, types = _texts(told.get("ids")), _texts(told.get("types"))
    name = told.get("name")
    name = name if isinstance(name, str) and name else stem(path, ".g2o")
    try:
        reading = solved_map(name, found, type, ids, types)
    except MapfuseError as error:
        raise MapfuseError(f"{path}: {error}") from error
    return _with_times(reading, told.get("times"), bool(told.get("path", True)))


def _in_axes_of_start(motion: Array, information: Array) -> Array:
    """g2o's error of a motion is in the axes of the measured end, ours in those of its start."""
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(motion[2]).T
    return np.asarray(turn.T @ information @ turn)


def _told(comments: list[str]) -> Mapping[str, Any]:
    for line in comments:
        if line.startswith(MARK):
            try:
                told = json.loads(line.removeprefix(MARK))
            except (ValueError, RecursionError):
                return {}
            return told if isinstance(told, dict) else {}
    return {}


def _texts(told: Any) -> dict[int, str]:
    items = told.items() if isinstance(told, dict) else ()
    return {int(key): value for key, value in items if key.isdecimal() and len(key) < 19 and isinstance(value, str)}


def _with_times(reading: Reading, times: Any, has_path: bool) -> Reading:
    map_ = reading.maps[0]
    if not has_path:
        return Reading((map_.replace(path=None),), reading.remarks)
    if map_.path is None or not isinstance(times, list) or len(times) != len(map_.path):
        return reading
    if not all(type(t) in (int, float) for t in times):
        return reading
    path = map_.path.copy()
    path[:, 0] = times
    return Reading((map_.replace(path=path),), reading.remarks)


def write(map_: LandmarkMap, path: Path) -> None:
    """Write a map as vertices, and its landmarks' covariance as edges from the first pose."""
    poses = map_.path[:, 1:] if map_.path is not None and len(map_.path) else np.zeros((1, 3))
    covariances = _covariances(map_)
    numbers = range(len(poses), len(poses) + len(map_))
    told = {
        "name": map_.name,
        "path": map_.path is not None,
        "times": [] if map_.path is None else map_.path[:, 0].tolist(),
        "ids": {n: landmark.id for n, landmark in zip(numbers, map_.landmarks, strict=True)},
        "types": {n: landmark.type for n, landmark in zip(numbers, map_.landmarks, strict=True)},
    }
    lines = [f"# {MARK}{json.dumps(told)}"]
    lines += [_line("VERTEX_SE2", k, *pose) for k, pose in enumerate(poses.tolist())]
    lines += [_line("VERTEX_XY", n, l.x, l.y) for n, l in zip(numbers, map_.landmarks, strict=True)]
    lines.append("FIX 0")
    R = se2.rotation(poses[0, 2])
    seen = se2.transform(se2.inverse(poses[0]), map_.positions)
    for n, xy, covariance in zip(numbers, seen.tolist(), covariances, strict=True):
        information = np.linalg.inv(R.T @ covariance @ R)
        lines.append(_line(f"EDGE_SE2_XY 0 {n}", *xy, *information[np.triu_indices(2)].tolist()))
    write_whole(path, "\n".join(lines) + "\n")


def _line(tag: str, *values: float) -> str:
    return " ".join([tag, *(repr(value) if isinstance(value, int) else repr(float(value)) for value in values)])


def _covariances(map_: LandmarkMap) -> list[Array]:
    """Of each landmark's position (2, 2): its own, that in the joint one, or what the noise says."""
    joint = map_.joint_covariance
    place = {} if joint is None else {identifier: k for k, identifier in enumerate(joint.order)}
    found = []
    for landmark in map_.landmarks:
        covariance = np.eye(2) * map_.noise.position_sigma**2
        if landmark.covariance is not None:
            covariance = landmark.covariance[:2, :2]
        elif joint is not None and landmark.id in place:
            at = joint.rows * place[landmark.id]
            covariance = joint.matrix[at : at + 2, at : at + 2]
        values, vectors = np.linalg.eigh(covariance)
        found.append(vectors @ np.diag(np.maximum(values, LEAST_SIGMA_M**2)) @ vectors.T)
    return found
