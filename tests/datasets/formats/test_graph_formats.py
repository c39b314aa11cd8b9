"""Nav2, tmap2, Open-RMF and GraphNav, on small files whose maps are known by hand, and on real ones."""

import json
import math

import numpy as np
import pytest
import yaml

from mapfuse.datasets.errors import FileFormatError
from mapfuse.datasets.formats import read_all, read_any, write_any
from mapfuse.datasets.formats.graphs import WAYS
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link


def nav2(nodes, edges, **top):
    point = lambda n, x, y, **p: {  # noqa: E731
        "type": "Feature",
        "properties": {"id": n, **p},
        "geometry": {"type": "Point", "coordinates": [x, y]},
    }
    line = lambda n, a, b, **p: {  # noqa: E731
        "type": "Feature",
        "properties": {"id": n, "startid": a, "endid": b, **p},
        "geometry": {"type": "LineString", "coordinates": [[0, 0], [1, 1]]},
    }
    features = [point(*n) if isinstance(n, tuple) else n for n in nodes] + [line(*e) for e in edges]
    return {"type": "FeatureCollection", "features": features, **top}


def read_nav2(tmp_path, document):
    path = tmp_path / "it.geojson"
    path.write_text(json.dumps(document))
    return read_all(path, format="nav2")[0]


def test_nav2_nodes_are_waypoints_and_directed_edges_are_ways(tmp_path):
    reading = read_nav2(tmp_path, nav2([(0, 1.5, -2.0), (7, 4.0, 2.0)], [(100, 0, 7)], name="depot"))
    (map_,) = reading.maps
    assert map_.name == "depot"
    assert map_.ids == ("0", "7")
    assert map_.positions.tolist() == [[1.5, -2.0], [4.0, 2.0]]
    (link,) = map_["0"].links
    # the file measured no distance and no direction: nothing may count twice
    assert (link.connected_to_id, link.distance, link.heading) == ("7", None, None)
    assert map_["7"].links == ()
    assert reading.remarks == ()


def test_nav2_oddities_are_said_and_what_is_valid_stays(tmp_path):
    nodes = [(0, 0.0, 0.0), (1, 5.0, 0.0), (2, 5.0, 0.0), (0, 9.0, 9.0)]
    edges = [(10, 0, 1), (10, 1, 0), (11, 0, 99), (12, 1, 1), (13, 0, 1)]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}
    reading = read_nav2(tmp_path, nav2(nodes, edges, crs=crs))
    (map_,) = reading.maps
    assert map_.ids == ("0", "1", "2", "0#2")
    assert [link.connected_to_id for link in map_["0"].links] == ["1"]
    assert [link.connected_to_id for link in map_["1"].links] == ["0"]
    said = "\n".join(reading.remarks)
    for part in (
        "EPSG::3857 is stated, and the coordinates are metres of a robot's map: ignored",
        "nodes with the name of another one (0#2)",
        "ways from or to nodes that aren't there (0 to id 99): left out",
        "ways from a node to itself (1)",
        "ways that stand more than once (0 to 1)",
        "ids that several ways have (10)",
        "nodes at the same place (1 and 2): both kept",
    ):
        assert part in said


def test_nav2_ways_beyond_four_are_kept_and_written(tmp_path):
    nodes = [(0, 0.0, 0.0)] + [(k, float(k), 0.0) for k in range(1, 7)]
    reading = read_nav2(tmp_path, nav2(nodes, [(20 + k, 0, k) for k in range(6, 0, -1)]))
    (map_,) = reading.maps
    assert [link.connected_to_id for link in map_["0"].links] == ["1", "2", "3", "4"]
    assert [way["to"] for way in map_["0"].extra[WAYS]] == ["5", "6"]
    assert "nodes with more than 4 ways (0)" in reading.remarks[0]
    assert write_any(map_, tmp_path / "back.geojson")[1] == ()  # its own keys are no loss
    assert write_any(map_, tmp_path / "back.tmap2.yaml")[1] == ("extra",)
    written = json.loads((tmp_path / "back.geojson").read_text())
    ends = sorted(f["properties"]["endid"] for f in written["features"] if "startid" in f["properties"])
    assert ends == [1, 2, 3, 4, 5, 6]


def test_nav2_says_what_a_node_and_an_edge_say_again(tmp_path):
    metadata = {"speed": 0.5, "class": "dock"}
    document = nav2([], [])
    document["features"] = [
        {
            "type": "Feature",
            "properties": {"id": n, "frame": "map", "metadata": metadata},
            "geometry": {"type": "Point", "coordinates": [n, 0]},
        }
        for n in (0, 1)
    ]
    document["features"].append(
        {
            "type": "Feature",
            "properties": {"id": 5, "startid": 0, "endid": 1, "cost": 3.0, "overridable": False},
            "geometry": {"type": "MultiLineString", "coordinates": [[[0, 0], [1, 0]]]},
        }
    )
    map_ = read_nav2(tmp_path, document).maps[0]
    write_any(map_, tmp_path / "back.geojson")
    first, _, edge = json.loads((tmp_path / "back.geojson").read_text())["features"]
    assert first["properties"] == {"id": 0, "frame": "map", "metadata": metadata}
    assert edge["properties"] == {"id": 2, "cost": 3.0, "overridable": False, "startid": 0, "endid": 1}
    assert edge["geometry"] == {"type": "MultiLineString", "coordinates": [[[0.0, 0.0], [1.0, 0.0]]]}


def test_a_way_recorded_at_one_end_is_driven_both_ways(tmp_path):
    corner = Landmark("c1", "corner", 0.0, 0.0, links=(Link("open", 0.0, connected_to_id="d1", distance=3.0),))
    write_any(LandmarkMap("m", (corner, Landmark("d1", "door", 3.0, 0.0))), tmp_path / "m.geojson")
    features = json.loads((tmp_path / "m.geojson").read_text())["features"]
    assert [f["properties"]["id"] for f in features] == [0, 1, 2, 3]  # one numbering for nodes and edges
    assert [(f["properties"]["startid"], f["properties"]["endid"]) for f in features[2:]] == [(0, 1), (1, 0)]
    assert features[0]["properties"]["metadata"] == {"mapfuse_id": "c1", "mapfuse_type": "corner"}


def test_a_way_round_a_corner_is_no_straight_edge_and_says_so(tmp_path, caplog):
    # the robot left c1 to the east, and came to c2, which lies to the north-east
    c1 = Landmark("c1", "corner", 0.0, 0.0, links=(Link("open", 0.0, connected_to_id="c2"),))
    d1 = Landmark("d1", "door", 4.0, 4.0, links=(Link("open", 0.0, connected_to_id="e1"),))
    map_ = LandmarkMap("m", (c1, Landmark("c2", "corner", 5.0, 5.0), d1, Landmark("e1", "door", 9.0, 4.2)))
    write_any(map_, tmp_path / "m.geojson")
    edges = [f["properties"] for f in json.loads((tmp_path / "m.geojson").read_text())["features"][4:]]
    assert {(e["startid"], e["endid"], e.get("metadata", {}).get("mapfuse_bent", False)) for e in edges} == {
        (0, 1, True),
        (1, 0, True),
        (2, 3, False),
        (3, 2, False),
    }
    assert "ways round a corner that wasn't recorded (c1 to c2, c2 to c1): straight edges" in caplog.text


def test_nav2_in_degrees_is_refused(tmp_path):
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    with pytest.raises(FileFormatError, match=r"crs: is urn:.*CRS84: degrees"):
        read_nav2(tmp_path, nav2([(0, 1.0, 2.0)], [], crs=crs))


def test_real_nav2_graphs(shared_data):
    for name, nodes in (("depot", 34), ("turtlebot3", 20), ("warehouse", 96)):
        reading, found = read_all(shared_data / "nav2" / f"{name}_graph.geojson")
        assert found.name == "nav2"
        assert len(reading.maps[0]) == nodes
        assert "coordinate reference system" in reading.remarks[0]
    depot = "\n".join(read_all(shared_data / "nav2" / "depot_graph.geojson")[0].remarks)
    assert "nodes at the same place (6 and 33): both kept" in depot
    assert "ids that several ways have (10006, " in depot


TPLG = """
- meta: {map: m, node: A, pointset: p}
  node:
    edges:
    - {action: move_base, edge_id: A_B, node: B, top_vel: 0.55}
    - {action: move_base, edge_id: A_C, node: C, top_vel: 0.55}
    map: m
    name: A
    pointset: p
    pose:
      orientation: {w: 0.7071067811865476, x: 0.0, y: 0.0, z: 0.7071067811865476}
      position: {x: 1.0, y: -2.5, z: 0.0}
    verts:
    - {x: 0.5, y: 0.5}
- meta: {map: m, node: B, pointset: p}
  node:
    edges: []
    name: B
    pose:
      orientation: {w: 0.0, x: 0.0, y: 0.0, z: 0.0}
      position: {x: 4.0, y: 0.0, z: 1.5}
"""


def test_a_topological_map_as_a_list(tmp_path):
    path = tmp_path / "ward.tplg"
    path.write_text(TPLG)
    reading, found = read_all(path)
    (map_,) = reading.maps
    assert (found.name, map_.name, map_.ids) == ("tmap2", "ward", ("A", "B"))
    assert (map_["A"].x, map_["A"].y, map_["A"].type, map_["A"].heading) == (1.0, -2.5, "waypoint", None)
    assert map_["A"].extra["tmap2"]["orientation"] == pytest.approx(math.pi / 2)
    assert map_["B"].extra["tmap2"]["orientation"] is None
    assert map_["B"].extra["tmap2"]["z"] == 1.5
    assert reading.remarks == (
        "ways from or to nodes that aren't there (A to C): left out",
        "nodes with an orientation of zeros (B): taken as not known",
    )


def test_tmap2_is_written_with_all_that_a_navigator_reads(tmp_path):
    (tmp_path / "ward.tplg").write_text(TPLG)
    write_any(read_any(tmp_path / "ward.tplg")[0], tmp_path / "ward.tmap2.yaml")
    document = yaml.safe_load((tmp_path / "ward.tmap2.yaml").read_text())
    node = document["nodes"][0]["node"]
    assert document["name"] == "ward"
    assert node["pose"]["position"] == {"x": 1.0, "y": -2.5, "z": 0.0}
    assert node["pose"]["orientation"]["z"] == pytest.approx(math.sqrt(0.5))
    assert node["verts"] == [{"x": 0.5, "y": 0.5}]
    assert [(edge["node"], edge["edge_id"], edge["top_vel"]) for edge in node["edges"]] == [("B", "A_B", 0.55)]


def test_real_topological_maps(shared_data):
    for name, nodes in (("aaf_y2.tplg", 91), ("aaf_y3.tplg", 115), ("aaf_y4.tplg", 89)):
        assert len(read_any(shared_data / "strands" / name)[0]) == nodes
    map_, found = read_any(shared_data / "tmap2" / "network_autogen.tmap2.yaml")
    assert (found.name, map_.name, len(map_)) == ("tmap2", "strawberry_polytunnel", 190)


RMF = """
coordinate_system: reference_image
name: house
lifts: {lift1: {x: 1}}
levels:
  L1:
    doors: [[2, 3, {name: [1, front], type: [1, hinged]}]]
    lanes: [[0, 1, {}]]
    measurements:
    - [0, 1, {distance: [3, 10.0]}]
    - [0, 1, {distance: [3, 12.0]}]
    vertices:
    - [0, 0, 0, ""]
    - [100, 0, 0, kitchen, {is_charger: [4, true]}]
    - [0, 200, 0, ""]
    - [20, 200, 0, ""]
    walls: [[0, 2, {}], [3, 1, {}]]
"""


def test_rmf_pixels_become_metres_with_y_up(tmp_path):
    path = tmp_path / "house.building.yaml"
    path.write_text(RMF)
    reading, found = read_all(path)
    (map_,) = reading.maps
    assert (found.name, map_.name, reading.parts) == ("rmf", "house-L1", ("L1",))
    # 100 pixels are 10 m and 12 m: 0.11 m per pixel
    np.testing.assert_allclose([map_["front"].x, map_["front"].y], [1.1, -22.0])
    assert map_["front"].type == "door"
    np.testing.assert_allclose([map_["kitchen"].x, map_["kitchen"].y], [11.0, 0.0])
    assert map_["kitchen"].type == "charger"
    np.testing.assert_allclose(map_.walls[0], [[0, 0], [0, -22]])
    assert reading.remarks == (
        "level L1: measurements differ by 18 %: their mean is taken, 0.1100 m per pixel",
        "1 lifts: left out",
    )


def test_rmf_in_metres_keeps_its_axes(tmp_path):
    path = tmp_path / "house.building.yaml"
    path.write_text("coordinate_system: cartesian_meters\nlevels: {L: {vertices: [[1, 2, 0, a]]}}")
    map_ = read_any(path)[0]
    assert (map_["a"].x, map_["a"].y) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("levels: {L: {vertices: [[1, 2, 0, a]], walls: [[0, 1, {}]]}}", r"levels\.L\.walls\[0\]: must begin with two"),
        ("levels: {L: {vertices: [[1, x, 0, a]]}}", r"levels\.L\.vertices\[0\]\[1\]: must be a finite number"),
        ("levels: {L: {vertices: [[1, .inf, 0, a]]}}", r"vertices\[0\]\[1\]: must be a finite number, not Infinity"),
        ("levels: {L: {vertices: [[1, 2, 0, a]], lanes: [[0, 7, {}]]}}", r"levels\.L\.lanes\[0\]: must begin with two"),
        ("levels: [1]", "levels: must be an object, not a list"),
        ("coordinate_system: wgs84\nlevels: {L: {vertices: []}}", "is wgs84: degrees"),
    ],
)
def test_broken_buildings_are_refused(tmp_path, text, message):
    path = tmp_path / "house.building.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_all(path)


def test_real_rmf_buildings(shared_data):
    reading, _ = read_all(shared_data / "rmf" / "clinic.building.yaml")
    assert [(map_.name, len(map_)) for map_ in reading.maps] == [("clinic-L1", 94), ("clinic-L2", 68)]
    office = read_any(shared_data / "rmf" / "office.building.yaml")[0]
    # the office's own measurements: its three vertices' distances, to the mean of their scales
    assert {"main_door", "coe_door", "hardware_door"} <= set(office.ids)
    assert 15 < np.ptp(office.positions[:, 0]) < 30


def test_graphnav_anchored(tmp_path, graphnav):
    folder = graphnav(tmp_path / "plant")
    reading, found = read_all(folder)
    (map_,) = reading.maps
    assert (found.name, map_.name) == ("graphnav", "plant")
    assert map_.positions.tolist() == [[10.0, 0.0], [11.0, 0.0], [12.0, 0.0], [0.0, -3.0]]
    assert (map_["fiducial-523"].type, map_["w0"].extra["graphnav"]["name"]) == ("fiducial", "place w0")
    assert [link.connected_to_id for link in map_["w1"].links] == ["w2", "w0"]
    assert reading.remarks == ()
    assert read_any(folder / "graph")[0] == map_


def test_graphnav_from_edge_to_edge(tmp_path, graphnav):
    reading, _ = read_all(graphnav(tmp_path / "plant", anchored=False))
    np.testing.assert_allclose(reading.maps[0].positions, [[0, 0], [2, 0], [2, 2]], atol=1e-12)
    assert "the map isn't anchored" in reading.remarks[0]


def test_graphnav_that_does_not_hang_together(tmp_path, graphnav):
    reading, _ = read_all(graphnav(tmp_path / "plant", anchored=False, stray=True))
    assert reading.maps[0].ids == ("w0", "w1")
    assert "waypoints that nothing joins to the first one (w2): left out" in reading.remarks
