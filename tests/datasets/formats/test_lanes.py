"""Lanes of Open-RMF buildings: as ways between doors and named vertices, and as corridors that robots drive through."""

import json
import math
from itertools import combinations, pairwise

import numpy as np
import pytest

from mapfuse.datasets.errors import ConfigError, InputError
from mapfuse.datasets.formats import read_all, read_any, write_any
from mapfuse.datasets.formats.lanes import MAX_LANDMARKS, Lane, lane_ways
from mapfuse.datasets.simulation import building_from_plan

NO_DOORS = np.zeros((0, 2, 2))


def joined(ids, lanes, vertices, named, doors=NO_DOORS):
    ways, remarks = lane_ways(ids, np.asarray(doors, dtype=float), named, np.asarray(vertices, dtype=float), lanes)
    assert remarks == ()
    return {(way.start, way.end) for way in ways}


def test_of_three_places_round_a_hub_the_longest_way_is_left_to_the_others():
    # from the hub at the origin (no name): 1 m to a, 2 m to b, 5 m to c; so a-b is 3 m, a-c 6 m, b-c 7 m
    vertices = [(0, 0), (1, 0), (0, 2), (-5, 0)]
    lanes = [Lane(0, 1), Lane(0, 2), Lane(3, 0)]
    assert joined("abc", lanes, vertices, [1, 2, 3]) == {("a", "b"), ("b", "a"), ("a", "c"), ("c", "a")}


def test_no_way_leads_through_a_third_place():
    vertices = [(0, 0), (1, 0), (2, 0)]
    lanes = [Lane(0, 1), Lane(1, 2)]
    assert joined("abc", lanes, vertices, [0, 1, 2]) == {("a", "b"), ("b", "a"), ("b", "c"), ("c", "b")}


def test_a_lane_of_one_way_leads_one_way():
    assert joined("ab", [Lane(0, 1, both=False)], [(0, 0), (4, 0)], [0, 1]) == {("a", "b")}


def test_doors_stand_on_the_lanes_that_cross_them_in_the_order_of_the_lane():
    doors = [[(6, -1), (6, 1)], [(2, -1), (2, 1)], [(4, 2), (4, 5)]]  # the last one is beside the lane
    found = joined(["far", "near", "beside", "a", "b"], [Lane(0, 1)], [(0, 0), (8, 0)], [0, 1], doors)
    one_way = {("a", "near"), ("near", "far"), ("far", "b")}
    assert found == one_way | {(end, start) for start, end in one_way}


def test_ways_round_a_corner_are_marked_and_written_so(tmp_path):
    map_ = read_any(building(tmp_path))[0]
    # from the dock to the desk the lanes go round the corner of the L
    assert [link.extra for link in map_["dock"].links] == [{"bent": True}]
    write_any(map_, tmp_path / "house.geojson")
    features = json.loads((tmp_path / "house.geojson").read_text())["features"]
    edges = [f["properties"] for f in features if "startid" in f["properties"]]
    assert [edge["metadata"] for edge in edges] == [{"mapfuse_bent": True}] * 2
    ways, _ = lane_ways("ab", NO_DOORS, [0, 1], np.array([[0.0, 0.0], [4.0, 3.0]]), [Lane(0, 1)])
    assert [way.extra for way in ways] == [{}, {}]


def test_places_at_one_spot_are_joined():
    assert joined("ab", [Lane(0, 1)], [(3, 3), (3, 3)], [0, 1]) == {("a", "b"), ("b", "a")}


@pytest.mark.parametrize("seed", range(20))
def test_ways_join_what_lanes_join(seed):
    """Which landmarks can be reached from which is the same along lanes and along ways, whatever was left out."""
    rng = np.random.default_rng(seed)
    count = 14
    vertices = rng.uniform(0, 20, (count, 2))
    lanes = [Lane(int(a), int(b)) for a, b in rng.integers(0, count, (13, 2))]
    named = np.sort(rng.choice(count, 6, replace=False)).tolist()
    ids = [f"v{k}" for k in named]

    def reached(pairs, names):
        group = {name: {name} for name in names}
        for a, b in pairs:
            whole = group[a] | group[b]
            for name in whole:
                group[name] = whole
        return group

    by_lanes = reached([(f"v{l.start}", f"v{l.end}") for l in lanes], [f"v{k}" for k in range(count)])
    by_ways = reached(joined(ids, lanes, vertices, named), ids)
    for a, b in combinations(ids, 2):
        assert (b in by_ways[a]) == (b in by_lanes[a])


def test_very_large_levels_are_read_without_their_lanes():
    ids = [f"v{k}" for k in range(MAX_LANDMARKS + 1)]
    xy = np.column_stack([np.arange(len(ids)), np.zeros(len(ids))])
    ways, remarks = lane_ways(ids, NO_DOORS, range(len(ids)), xy, [Lane(0, 1)])
    assert ways == []
    assert remarks == ("1 lanes: left out, of a level with more than 1,000 landmarks",)


def building(folder, levels=("L1",)):
    """An L of lanes, 20 m and 12 m, with walls 1 m to either side and a door to a room, 0.1 m a pixel and y down."""
    places = [(10, 210, "dock"), (210, 210, ""), (210, 90, "desk")]
    outer = [(0, 220), (220, 220), (220, 80), (200, 80), (200, 200), (105, 200), (95, 200), (0, 200)]
    ring = [*range(3, 3 + len(outer)), 3]
    walls = [[a, b, {}] for a, b in pairwise(ring) if (a, b) != (8, 9)]
    level = {
        "vertices": [[x, y, 0, name] for x, y, name in places] + [[x, y, 0, ""] for x, y in outer],
        "lanes": [[0, 1, {"bidirectional": [4, True]}], [1, 2, {"bidirectional": [4, True]}]],
        "walls": walls,
        "doors": [[8, 9, {"name": [1, "office"]}]],
        "measurements": [[0, 1, {"distance": [3, 20.0]}]],
    }
    path = folder / "house.building.yaml"
    path.write_text(json.dumps({"name": "house", "levels": dict.fromkeys(levels, level)}))
    return path


def test_lanes_are_ways_of_the_map(tmp_path):
    map_ = read_any(building(tmp_path))[0]
    assert [(l.id, l.type, [link.connected_to_id for link in l.links]) for l in map_.landmarks] == [
        ("office", "door", []),
        ("dock", "place", ["desk"]),
        ("desk", "place", ["dock"]),
    ]


def test_landmarks_along_the_lanes_are_what_a_robot_finds_there(tmp_path):
    map_ = read_any(building(tmp_path), landmarks="lanes")[0]
    at = {(l.type, round(l.x, 1), round(l.y, 1)) for l in map_.landmarks}
    assert at == {("corner", 1.0, -21.0), ("corner", 21.0, -21.0), ("corner", 21.0, -9.0), ("door", 10.0, -21.0)}
    door = next(l for l in map_.landmarks if l.type == "door")
    assert sorted(link.distance for link in door.links if link.distance is not None) == [9.0, 11.0]
    (arm,) = (link for link in door.links if link.type == "door")
    assert arm.heading == pytest.approx(math.pi / 2)
    with pytest.raises(ConfigError, match="must be named or lanes"):
        read_any(building(tmp_path), landmarks="all")


def test_a_building_can_be_driven_through(tmp_path):
    built = building_from_plan(building(tmp_path), steel_sigma=0.0)
    assert (built.name, built.floor.length, built.floor.width) == ("house-L1", 32.0, pytest.approx(2.0))
    assert len(built.walls) == 8  # and the door, which is closed
    several = building(tmp_path, ("L1", "L2"))
    assert building_from_plan(f"{several}#L2").name == "house-L2"
    with pytest.raises(InputError, match=r"holds 2 levels \(L1, L2\); name one as .*#L1"):
        building_from_plan(several)
    with pytest.raises(InputError, match="a second file with some isn't read"):
        building_from_plan(f"{several}#L2", several)


def test_real_buildings_have_their_lanes(shared_data):
    office = read_any(shared_data / "rmf" / "office.building.yaml")[0]
    # as the drawing shows: lanes lead through both inner doors, and none through the main one
    linked = {l.id: {link.connected_to_id for link in l.links} for l in office.landmarks}
    assert linked["main_door"] == set()
    assert "coe" in linked["coe_door"]
    assert "hardware_2" in linked["hardware_door"]
    reading, _ = read_all(shared_data / "rmf" / "clinic.building.yaml", landmarks="lanes")
    for map_ in reading.maps:
        assert map_.types.count("door") >= 20
        assert map_.types.count("junction") >= 10
