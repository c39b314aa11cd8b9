"""GeoJSON for geographic information systems: landmarks, 95 % ellipses, ways, walls and path as features.

Coordinates are metres of the map's frame, x and y. The ``crs`` says so in words that GDAL and QGIS understand (an
engineering system of their own): they lie nowhere on Earth until somebody says where. The property ``kind`` says what a
feature is; landmarks have ``id``, ``type`` and what is known of them, angles in radians, covariances in square metres
as lists of rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arms import heading_of
from ..files import write_whole
from ..jsondata import decode, encode
from ..mapfile import map_from_dict
from ..maps import Landmark, LandmarkMap
from .checks import Checker
from .graphs import ways_of
from .heads import plain_name, read_bytes, stem
from .reading import Reading

Array = NDArray[np.float64]

ENDINGS = (".gis.geojson", ".geojson")
MARK = "mapfuse"
#: The coordinate system of a robot's map, in well-known text. Without any, readers take metres for degrees.
LOCAL_CRS = {
    "type": "name",
    "properties": {
        "name": 'ENGCRS["robot map",EDATUM["robot map"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],'
        'LENGTHUNIT["metre",1]]'
    },
}
#: Squared radius of the ellipse that holds 95 % of a Gaussian in the plane.
CHI2_95 = 5.991464547107979
_CORNERS = 48
_TOLD = ("heading", "covariance", "existence", "visit_counter", "detection_counter")


def detect(path: Path, head: bytes) -> bool:
    """A collection of features that says it is one of ours."""
    return plain_name(path).endswith(".geojson") and b'"mapfuse":"gis/1"' in head.replace(b" ", b"")


def read(path: Path) -> Reading:
    """The map of a file that `write` wrote, perhaps edited: its landmarks, walls and path."""
    document, faults = decode(read_bytes(path), path)
    check = Checker(path)
    check.problems += faults
    top = check.mapping(document, "")
    records: dict[str, list[Any]] = {"landmark": [], "wall": [], "path": []}
    for k, item in enumerate(check.items(top.get("features"), "features")):
        feature = check.mapping(item, f"features[{k}]")
        properties = check.mapping(feature.get("properties"), f"features[{k}].properties")
        geometry = check.mapping(feature.get("geometry"), f"features[{k}].geometry")
        coordinates = check.items(geometry.get("coordinates"), f"features[{k}].geometry.coordinates")
        kind = properties.get("kind")
        if kind == "landmark" and len(coordinates) < 2:
            check.fault(f"features[{k}].geometry.coordinates", "must be x and y")
        elif kind in records:
            records[str(kind)].append((properties, coordinates))
    check.done()
    name = top.get("name")
    map_document: dict[str, Any] = {
        "format": "mapfuse.map/1",
        "name": name if isinstance(name, str) and name else stem(path, *ENDINGS),
        "landmarks": [_record(*found) for found in records["landmark"]],
    }
    if records["wall"]:
        map_document["walls"] = [coordinates for _, coordinates in records["wall"]]
    if records["path"]:
        properties, coordinates = records["path"][0]
        map_document["path"] = _path(properties, coordinates)
    return Reading((map_from_dict(map_document, path),))


def _record(properties: Mapping[str, Any], coordinates: list[Any]) -> dict[str, Any]:
    told = {key: properties[key] for key in _TOLD if properties.get(key) is not None}
    return {
        "id": properties.get("id"),
        "type": properties.get("type"),
        "x": coordinates[0],
        "y": coordinates[1],
        **told,
    }


def _path(properties: Mapping[str, Any], coordinates: list[Any]) -> list[Any]:
    times, headings = properties.get("t"), properties.get("theta")
    if not (isinstance(times, list) and isinstance(headings, list) and len(times) == len(headings) == len(coordinates)):
        return [[k, *xy, 0.0] if isinstance(xy, list) else xy for k, xy in enumerate(coordinates)]
    return [
        [t, *xy, theta] if isinstance(xy, list) else xy
        for t, xy, theta in zip(times, coordinates, headings, strict=True)
    ]


def write(map_: LandmarkMap, path: Path) -> None:
    """Write a map as features: points, ellipses, lines."""
    features = [_feature("Point", [float(l.x), float(l.y)], kind="landmark", **_told(l)) for l in map_.landmarks]
    for landmark, covariance in zip(map_.landmarks, _covariances(map_), strict=True):
        if covariance is not None:
            ring = ellipse(np.array([landmark.x, landmark.y]), covariance)
            features.append(_feature("Polygon", [ring.tolist()], kind="ellipse", id=landmark.id, share=0.95))
    for landmark, end, _ in ways_of(map_):
        ends = [[float(landmark.x), float(landmark.y)], [float(map_[end].x), float(map_[end].y)]]
        features.append(_feature("LineString", ends, kind="way", start=landmark.id, end=end))
    features += [_feature("LineString", wall.tolist(), kind="wall") for wall in map_.walls]
    if map_.path is not None:
        p = map_.path
        told = {"t": p[:, 0].tolist(), "theta": p[:, 3].tolist()}
        features.append(_feature("LineString", p[:, 1:3].tolist(), kind="path", **told))
    document = {"type": "FeatureCollection", "name": map_.name, MARK: "gis/1", "crs": LOCAL_CRS, "features": features}
    write_whole(path, encode(document))


def _feature(shape: str, coordinates: list[Any], **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": shape, "coordinates": coordinates}}


def _told(landmark: Landmark) -> dict[str, Any]:
    told: dict[str, Any] = {"id": landmark.id, "type": landmark.type}
    if (heading := heading_of(landmark)) is not None:
        told["heading"] = float(heading)
    if landmark.covariance is not None:
        told["covariance"] = landmark.covariance.tolist()
    if landmark.existence is not None:
        told["existence"] = float(landmark.existence)
    return told | {"visit_counter": landmark.visit_counter, "detection_counter": landmark.detection_counter}


def _covariances(map_: LandmarkMap) -> list[Array | None]:
    """Of each landmark's position (2, 2), its own or that in the joint one."""
    joint = map_.joint_covariance
    place = {} if joint is None else {identifier: k for k, identifier in enumerate(joint.order)}
    found: list[Array | None] = []
    for landmark in map_.landmarks:
        if landmark.covariance is not None:
            found.append(landmark.covariance[:2, :2])
        elif joint is not None and landmark.id in place:
            at = joint.rows * place[landmark.id]
            found.append(joint.matrix[at : at + 2, at : at + 2])
        else:
            found.append(None)
    return found


def ellipse(xy: Array, covariance: Array) -> Array:
    """The closed ring (n, 2) [m], counter-clockwise, around 95 % of a Gaussian at ``xy`` with that covariance.

    >>> ring = ellipse(np.zeros(2), np.diag([4.0, 1.0]))
    >>> float(ring[:, 0].max().round(3)), float(ring[:, 1].max().round(3))
    (4.895, 2.448)
    """
    values, vectors = np.linalg.eigh(covariance)
    if np.linalg.det(vectors) < 0:
        vectors = vectors[:, ::-1]
        values = values[::-1]
    angles = np.linspace(0, 2 * np.pi, _CORNERS + 1)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    ring = xy + (circle * np.sqrt(CHI2_95 * np.maximum(values, 0))) @ vectors.T
    ring[-1] = ring[0]
    return np.asarray(ring)
