"""Occupancy grids and vector plans as formats of maps: found out, read, and refused by one sentence."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.formats import format_of, read_any

#: An L of corridors 2 m wide, 0.1 m a cell: 20 m along x, then 12 m up.
CELL = 0.1


def grid(folder, image="floor.pgm", name="floor.yaml"):
    cells = np.full((160, 260), 205, dtype=np.uint8)
    for x0, y0, x1, y1 in ((2, 2, 22, 4), (20, 2, 22, 14)):
        rows = slice(160 - round(y1 / CELL), 160 - round(y0 / CELL))
        columns = slice(round(x0 / CELL), round(x1 / CELL))
        edge = cells[rows.start - 1 : rows.stop + 1, columns.start - 1 : columns.stop + 1]
        edge[edge != 254] = 0
        cells[rows, columns] = 254
    (folder / "floor.pgm").write_bytes(b"P5\n260 160\n255\n" + cells.tobytes())
    path = folder / name
    path.write_text(
        f"image: {image}\nresolution: {CELL}\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return path


def plan(folder):
    def line(*points):
        geometry = {"type": "LineString", "coordinates": [list(p) for p in points]}
        return {"type": "Feature", "properties": {"type": "corridor"}, "geometry": geometry}

    document = {"type": "FeatureCollection", "units": "m", "features": [line((0, 0), (20, 0)), line((20, 0), (20, 12))]}
    path = folder / "floor.geojson"
    path.write_text(json.dumps(document))
    return path


def test_a_grid_is_found_out_and_its_corner_and_ends_read(tmp_path):
    path = grid(tmp_path)
    assert format_of(path).name == "ros_map"
    map_ = read_any(path)[0]
    corners = [l for l in map_.landmarks if l.type == "corner"]
    at = np.array([(l.x, l.y) for l in corners])
    # the corner's middle lines cross at (21, 3)
    assert np.hypot(*(at - [21.0, 3.0]).T).min() < 0.3
    assert len(corners) == 3
    assert all(l.links for l in corners)


def test_a_plan_is_found_out_and_read(tmp_path):
    path = plan(tmp_path)
    assert format_of(path).name == "plan"
    map_ = read_any(path)[0]
    assert sorted((round(l.x), round(l.y)) for l in map_.landmarks) == [(0, 0), (20, 0), (20, 12)]
    corner = next(l for l in map_.landmarks if (round(l.x), round(l.y)) == (20, 0))
    assert sorted(round(l.distance) for l in corner.links if l.distance is not None) == [12, 20]


@pytest.mark.parametrize("image", ["../floor.pgm", "/etc/hostname", "nothing.pgm"])
def test_a_grid_whose_picture_is_elsewhere_or_nowhere_reads_no_other_file(tmp_path, image):
    inside = tmp_path / "inside"
    inside.mkdir()
    path = grid(inside, image, name="other.yaml")
    with pytest.raises(MapfuseError) as refused:
        read_any(path)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize("cut", [3, 15, 2000])
def test_a_picture_cut_off_is_refused(tmp_path, cut):
    path = grid(tmp_path)
    picture = tmp_path / "floor.pgm"
    picture.write_bytes(picture.read_bytes()[:cut])
    with pytest.raises(MapfuseError, match="floor"):
        read_any(path)


def test_a_plan_cut_off_is_refused(tmp_path):
    path = plan(tmp_path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(MapfuseError, match="floor"):
        read_any(path)
