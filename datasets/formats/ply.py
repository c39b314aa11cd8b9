"""PLY point clouds for viewers (MeshLab, CloudCompare, Open3D): landmarks coloured by type, walls and path as edges.

Plain text, metres in the map's frame, z 0. Types are numbered in the property ``type`` and named in comments.
"""

from __future__ import annotations

import colorsys
from pathlib import Path

import numpy as np

from ..files import write_whole
from ..maps import LandmarkMap

#: Golden section: neighbouring numbers get colours far from each other.
_TURN = 0.61803398875
_WALL, _PATH = (120, 120, 120), (40, 40, 40)


def write(map_: LandmarkMap, path: Path) -> None:
    """Write landmarks first, one vertex each in their order, then walls and the path with the edges that join them."""
    types = sorted(set(map_.types))
    colours = {type_: _colour(k) for k, type_ in enumerate(types)}
    lines = list(map_.walls) + ([] if map_.path is None else [map_.path[:, 1:3]])
    shades = [_WALL] * len(map_.walls) + [_PATH] * (map_.path is not None)
    vertices = [(l.x, l.y, *colours[l.type], types.index(l.type)) for l in map_.landmarks]
    edges: list[tuple[int, int]] = []
    for line, shade in zip(lines, shades, strict=True):
        first = len(vertices)
        vertices += [(float(x), float(y), *shade, -1) for x, y in np.asarray(line)]
        edges += [(k, k + 1) for k in range(first, len(vertices) - 1)]
    header = ["ply", "format ascii 1.0", f"comment map {_word(map_.name)}"]
    header += [f"comment type {k} {_word(type_)}" for k, type_ in enumerate(types)]
    header += [f"element vertex {len(vertices)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    header += ["property int type", f"element edge {len(edges)}", "property int vertex1", "property int vertex2"]
    body = [f"{float(x)!r} {float(y)!r} 0 {r} {g} {b} {kind}" for x, y, r, g, b, kind in vertices]
    body += [f"{a} {b}" for a, b in edges]
    write_whole(path, "\n".join([*header, "end_header", *body]) + "\n")


def _colour(k: int) -> tuple[int, int, int]:
    r, g, b = colorsys.hsv_to_rgb(k * _TURN % 1, 0.75, 0.85)
    return round(255 * r), round(255 * g), round(255 * b)


def _word(text: str) -> str:
    """Text that stays on its line: PLY is ASCII."""
    return " ".join(text.split()).encode("ascii", errors="backslashreplace").decode()
