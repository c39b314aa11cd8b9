"""Vector plans: floors read back from what was drawn, real ones, and files that are wrong."""

import copy
import json

import numpy as np
import pytest

from mapfuse.datasets import FileFormatError, InputError, MapfuseError
from mapfuse.datasets.simulation import (
    build,
    building_from_plan,
    hospital_like,
    make_floor,
    read_plan,
    salvatori_like,
)
from mapfuse.datasets.simulation.corridorgraph import chains, corridor_graph
from mapfuse.datasets.simulation.raycast import distances

NO_WALLS = np.zeros((0, 2, 2))


def feature(kind, shape, coordinates):
    return {
        "type": "Feature",
        "properties": {"type": kind},
        "geometry": {"type": shape, "coordinates": coordinates},
    }


def line(kind, *points):
    return feature(kind, "LineString", [list(map(float, point)) for point in points])


def box(kind, x0, y0, x1, y1):
    return feature(kind, "Polygon", [[[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]])


def document(*features, **members):
    return {"type": "FeatureCollection", "units": "m", **members, "features": list(features)}


def written(tmp_path, content, name="floor.geojson"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    return path


def t_plan():
    return document(
        line("corridor", (0, 0), (12, 0)), line("path", (5, 0.2), (5, 8)), feature("door", "Point", [9.0, 1.0]),
        feature("door", "Point", [2.0, -1.0]), feature("room", "Polygon", "whatever"), name="T", width=1.6, north=0.5,
    )  # fmt: skip


def test_a_plan_drawn_by_hand(tmp_path):
    floor = building_from_plan(written(tmp_path, t_plan())).floor
    assert (floor.name, floor.width, floor.north) == ("T", 1.6, 0.5)
    found = sorted((place.type, round(place.x, 6), round(place.y, 6)) for place in floor.places)
    assert found == [
        ("corner", 0, 0),
        ("corner", 5, 8),
        ("corner", 12, 0),
        ("door", 2, 0),
        ("door", 9, 0),
        ("junction", 5, 0),
    ]
    arms = {
        (round(place.x, 6), round(np.rad2deg(arm.direction))): arm.type
        for place in floor.places
        for arm in place.arms
        if abs(place.y) < 1e-6
    }
    assert arms[9.0, 90] == "door"
    assert arms[9.0, -90] == "blocked"
    assert arms[2.0, -90] == "door"
    assert [arms[5.0, degrees] for degrees in (0, 90, 180, -90)] == ["open", "open", "open", "blocked"]
    assert floor.length == pytest.approx(20.0)


def test_walls_are_built_where_a_plan_has_none_and_kept_where_it_has(tmp_path):
    built = building_from_plan(written(tmp_path, t_plan()))
    assert np.array_equal(built.walls, build(built.floor).walls)
    walls = [line("wall", (-1, -0.9), (13, -0.9)), line("wall", (-1, 0.9), (4, 0.9)), line("wall", (6, 0.9), (13, 0.9))]
    plan = t_plan()
    del plan["width"]
    plan["features"] += walls
    read = building_from_plan(written(tmp_path, plan))
    assert len(read.walls) == 3
    assert read.ranges([9, 0, 0], [-np.pi / 2], 5.0) == pytest.approx([0.9])
    assert read.floor.width == pytest.approx(1.8)


@pytest.mark.parametrize("kind", ["irregular", "alike", "symmetric", "oblique", "wings"])
@pytest.mark.parametrize("seed", range(3))
def test_a_floor_written_as_a_plan_is_read_back(tmp_path, kind, seed):
    """Corridors as lines in any order, cut anywhere, doors as lines in the walls: places and arms come back."""
    check_read_back(tmp_path, make_floor(kind, np.random.default_rng(seed)), seed)


@pytest.mark.parametrize("floor", [salvatori_like(), hospital_like()])
def test_a_named_floor_written_as_a_plan_is_read_back(tmp_path, floor):
    check_read_back(tmp_path, floor, 0)


def check_read_back(tmp_path, floor, seed):
    rng, building = np.random.default_rng(seed), build(floor)
    features = []
    for corridor in floor.corridors:
        a, b = (floor.place_from_id[i].xy for i in (corridor.places[0], corridor.places[-1]))
        cut = a + rng.uniform(0.3, 0.7) * (b - a)
        features += [line("corridor", a, cut), line("corridor", b, cut)]
    features += [line("door", *door) for door in building.doors]
    features += [line("wall", *wall) for wall in building.walls]
    plan = document(*(features[k] for k in rng.permutation(len(features))))
    found = building_from_plan(written(tmp_path, plan)).floor
    assert len(found.places) == len(floor.places)
    assert found.length == pytest.approx(floor.length, abs=1e-6)
    for place in floor.places:
        nearest = min(found.places, key=lambda other: np.hypot(*(other.xy - place.xy)))
        assert np.hypot(*(nearest.xy - place.xy)) < 1e-6
        assert nearest.type == place.type
        for arm in place.arms:
            if arm.type != "blocked":
                assert nearest.arms[nearest.arm_towards(arm.direction)].type == arm.type
    assert found.width == pytest.approx(floor.width, abs=0.05)


@pytest.mark.parametrize(
    ("latitude", "north_m", "east_m"),
    # metres per degree on WGS 84, as published (NGA)
    [(0.0, 110_574, 111_320), (45.0, 111_132, 78_847), (60.0, 111_412, 55_800), (-30.0, 110_852, 96_486)],
)
def test_longitude_and_latitude_become_metres(tmp_path, latitude, north_m, east_m):
    step = 1e-3
    plan = document(
        line("path", (10 - step, latitude), (10 + step, latitude)), line("path", (10, latitude), (10, latitude + step))
    )
    del plan["units"]
    read = read_plan(written(tmp_path, plan))
    assert np.ptp(read.lines[0], axis=0) == pytest.approx([2 * step * east_m, 0.0], rel=2e-5, abs=1e-6)
    assert np.ptp(read.lines[1], axis=0) == pytest.approx([0.0, step * north_m], rel=2e-5, abs=1e-6)
    assert read.lines[1][1, 1] > read.lines[1][0, 1], "y is North"
    assert read.north == pytest.approx(np.pi / 2)


def test_doors_that_a_line_leads_through_stand_open(tmp_path):
    walls = [line("wall", (0, 1), (20, 1)), line("wall", (0, -1), (20, -1))]
    ends = [line("wall", (0, -1), (0, 1)), line("wall", (20, -1), (20, 1))]
    doors = [box("door", 9.9, -1.0, 10.1, 1.0), box("door", 4.5, 0.9, 5.5, 1.1), box("door", 14.5, 0.9, 15.5, 1.1)]
    plan = document(line("path", (1, 0), (19, 0)), *walls, *ends, *doors)
    building = building_from_plan(written(tmp_path, plan))
    assert sorted(round(p.x, 6) for p in building.floor.places if p.type == "door") == [5.0, 15.0]
    assert building.ranges([5, 0, 0], [0.0, np.pi / 2], 30.0) == pytest.approx([15.0, 0.9])
    # without the line the middle door still stands across the corridor that leads up to it on both sides
    without = building_from_plan(written(tmp_path, document(*walls, *ends, *doors)))
    assert sorted(round(p.x, 1) for p in without.floor.places if p.type == "door") == [5.0, 15.0]
    assert without.floor.positions[:, 1] == pytest.approx(np.zeros(4), abs=0.05)
    assert without.ranges([5, 0, 0], [0.0], 30.0) == pytest.approx([15.0])


def test_doors_facing_each_other_are_one_place(tmp_path):
    plan = document(
        line("path", (0, 0), (20, 0)),
        *(feature("door", "Point", [x, y]) for x, y in ((8.0, 1.0), (8.3, -1.0), (14, 1))),
        feature("door", "Point", [21.0, 0.1]),
    )  # fmt: skip
    floor = building_from_plan(written(tmp_path, plan)).floor
    both, one = sorted((p for p in floor.places if p.type == "door"), key=lambda place: place.x)
    assert both.x == pytest.approx(8.15)
    assert sorted(arm.type for arm in both.arms) == ["door", "door", "open", "open"]
    assert sorted(arm.type for arm in one.arms) == ["blocked", "door", "open", "open"]
    end = max(floor.places, key=lambda place: place.x)
    assert [arm.type for arm in end.arms if abs(arm.direction) < 0.1] == ["door"], "a door at the end is its arm"


def test_a_corridor_between_rooms_is_found_by_its_walls(tmp_path):
    """An L of corridor 2 m wide with five doors; a room with one door, larger than the corridor, is no corridor."""
    outer = [line("wall", (0, 0), (20, 0), (20, 14), (18, 14), (18, 2), (0, 2), (0, 0))]
    room = [line("wall", (0, 2), (0, 12), (17, 12), (17, 2))]
    doors = [
        line("door", *ends) for ends in (((3, 0), (4, 0)), ((9, 2), (10, 2)), ((15, 0), (16, 0)), ((20, 6), (20, 7)))
    ]
    doors.append(line("door", (20, 10), (20, 11)))
    floor = building_from_plan(written(tmp_path, document(*outer, *room, *doors))).floor
    assert sum(place.type == "door" for place in floor.places) == 5
    corner = next(p for p in floor.places if p.type == "corner" and len([a for a in p.arms if a.type == "open"]) == 2)
    assert corner.xy == pytest.approx([19.0, 1.0], abs=0.3)
    assert (
        distances(floor.positions, np.array([[[1, 1], [19, 1]], [[19, 1], [19, 13]]], dtype=float)).min(axis=1).max()
        < 0.3
    )
    assert floor.width == pytest.approx(2.0, abs=0.1)


def test_the_graph_of_lines_does_not_hang_on_how_they_were_drawn():
    lines = [
        np.array(points, dtype=float)
        for points in ([(0, 0), (10, 0)], [(10, 0), (10, 8), (0, 8), (0, 0)], [(5, 0), (5, 8)])
    ]
    nodes, edges = corridor_graph(lines, NO_WALLS)
    assert sorted(nodes) == [(0, 0), (0, 8), (5, 0), (5, 8), (10, 0), (10, 8)]
    assert len(edges) == 7
    rng = np.random.default_rng(0)
    for _ in range(10):
        drawn = []
        for k in rng.permutation(len(lines)):
            jittered = lines[k] + rng.uniform(-0.15, 0.15, lines[k].shape)
            drawn.append(jittered[::-1] if rng.random() < 0.5 else jittered)
        # the same way twice, a stub in the corner, an island elsewhere
        drawn += [lines[0] + 0.1, np.array([[0, 0], [-0.6, -0.6]]), np.array([[30, 30], [34, 30]])]
        again, edges = corridor_graph(drawn, NO_WALLS)
        assert len(again) == 6
        assert len(edges) == 7
        off = np.hypot(*np.moveaxis(np.array(again)[:, None] - np.array(nodes)[None], -1, 0)).min(axis=1)
        assert off.max() < 0.5


def test_lines_through_walls_lead_nowhere():
    wall = np.array([[[6.0, -3.0], [6.0, 3.0]]])
    ways = [np.array([[0.0, 0.0], [4.0, 0.0]]), np.array([[4.0, 0.0], [8.0, 0.0]]), np.array([[4.0, 0.0], [4.0, 5.0]])]
    nodes, edges = corridor_graph(ways, wall)
    assert sorted(nodes) == [(0, 0), (4, 0), (4, 5)]
    assert len(edges) == 2


def test_near_parallel_ways_out_of_a_place_are_laid_on_each_other():
    ways = [
        np.array([[0.0, 0.0], [6.0, 0.6]]),
        np.array([[0.0, 0.0], [12.0, -0.6]]),
        np.array([[0.0, 0.0], [0.0, 5.0]]),
    ]
    nodes, edges = corridor_graph(ways, NO_WALLS)
    for k, node in enumerate(nodes):
        ends = [np.subtract(nodes[b if a == k else a], node) for a, b in edges if k in (a, b)]
        angles = np.sort([np.arctan2(y, x) for x, y in ends])
        assert np.diff([*angles, angles[0] + 2 * np.pi]).min() >= np.deg2rad(20)


def test_a_ring_is_one_chain():
    assert chains([(0, 1), (1, 2), (0, 2)]) == [[0, 1, 2, 0]]


# Real plans ----------------------------------------------------------------------------------------------------------


def check_real(building):
    floor, rng = building.floor, np.random.default_rng(0)
    assert building.free(floor.positions).mean() > 0.9
    for place in floor.places:
        for there in floor.neighbours[place.id]:
            towards = float(np.arctan2(*(floor.place_from_id[there].xy - place.xy)[::-1]))
            assert place.arms[place.arm_towards(towards)].type == "open"
    for k in rng.integers(len(building.steps), size=30):
        a, b = building.steps[k]
        way = a + np.linspace(0, 1, 50)[:, None] * (b - a)
        assert building.clearance(way).min() > 0.05, "corridors' lines keep clear of the walls"


@pytest.mark.parametrize("number", [3, 4])
def test_a_real_floor_without_ways_is_read(shared_data, number):
    building = building_from_plan(shared_data / "westport" / f"westport-house-floor-{number}.geojson")
    check_real(building)
    floor = building.floor
    # the North and the West wing's corridors are 30 m long and about 1.5 m wide, with flats' doors on both sides
    assert 65 < floor.length < 80
    assert 1.0 < floor.width < 2.0
    assert sum(place.type == "door" for place in floor.places) >= 18
    scans = [
        building.ranges([*middle, 0.0], np.linspace(-np.pi, np.pi, 60), 60.0) for middle in building.steps.mean(axis=1)
    ]
    assert np.isfinite(scans).all()


def test_a_real_floor_with_ways_in_a_second_file(shared_data):
    folder = shared_data / "westport"
    building = building_from_plan(
        folder / "westport-house-floor-2.geojson", folder / "westport-house-floor-2-paths.geojson"
    )
    check_real(building)
    floor = building.floor
    assert floor.length > 250
    assert len(floor.places) > 50
    edges = sum(len(corridor.places) - 1 for corridor in floor.corridors)
    assert edges - len(floor.places) + 1 >= 5, "the office's ways make loops"
    x0, y0, x1, y1 = building.bounds
    assert 45 < x1 - x0 < 60
    assert 60 < y1 - y0 < 70


# Hostile files -------------------------------------------------------------------------------------------------------

GOOD = document(line("corridor", (0, 0), (9, 0)))
WRONG = {
    "empty": (b"", "is empty"),
    "no json": (b"corridor", "is not JSON"),
    "cut off": (json.dumps(GOOD).encode()[:-9], "not complete JSON"),
    "binary": (b"\x00\xff\xfe", "UTF-8|not JSON"),
    "deep": (b'{"a":' * 100_000, "nested too deeply|not complete"),
    "deep coordinates": (
        json.dumps(GOOD).replace("[[0.0, 0.0], [9.0, 0.0]]", "[" * 500 + "]" * 500).encode(),
        r"features\[0\].geometry.coordinates: must hold at least two positions",
    ),
    "a list": ([], 'type: is missing or not "FeatureCollection"'),
    "a feature": (line("corridor", (0, 0), (9, 0)), "FeatureCollection"),
    "no features": ({**GOOD, "features": None}, "features: must be a list, not null"),
    "nothing in it": (document(), "features: hold no corridor, wall or door"),
    "rooms only": (document(box("room", 0, 0, 5, 5)), "hold no corridor, wall or door"),
    "doors only": (document(feature("door", "Point", [1.0, 1.0])), "hold no corridor, and no walls"),
    "one wall": (document(line("wall", (0, 0), (5, 0))), "hold no corridor, and no walls"),
    "a feature that is none": (document(7), r"features\[0\]: must be an object, not 7"),
    "no geometry": (document({"properties": {"type": "wall"}}), r"features\[0\].geometry: of a wall must be one of"),
    "wrong geometry": (document(feature("corridor", "Point", [0, 0])), "of a corridor must be one of LineString"),
    "geometry's type": (document(feature("corridor", ["LineString"], [])), "geometry: of a corridor must be one of"),
    "text": (document(feature("path", "LineString", "0 0")), r'coordinates: must be a list, not "0 0"'),
    "one position": (document(line("path", (0, 0))), "at least two positions, not 1"),
    "a number": (document(feature("path", "LineString", [1, 2])), r"coordinates\[0\]: must be a list of two numbers"),
    "a bool": (document(feature("door", "Point", [True, 1])), r"coordinates\[0\]: must be a number"),
    "null": (document(line("path", (0, 0), (1, 1)), feature("door", "Point", [None, 1])), r"s\[1\]\S+\[0\]: must be"),
    "NaN": (json.dumps(GOOD).replace("9.0", "NaN").encode(), r"coordinates\[1\]\[0\]: must be a finite number"),
    "huge": (document(line("path", (0, 0), (1e300, 0))), r"\[1\]\[0\]: must be a number of at most 1e9, not 1e\+300"),
    "huge integer": (json.dumps(GOOD).replace("9.0", "9" * 400).encode(), "must be a number of at most 1e9|finite"),
    "far": (document(line("path", (0, 0), (2e4, 0))), "reach over 20,000 m"),
    "metres as degrees": ({**document(line("path", (0, 0), (300, 0))), "units": None}, 'says "units": "m"'),
    "the pole": ({**document(line("path", (0, 90), (1, 90))), "units": None}, "no longitude and latitude"),
    "feet": ({**GOOD, "units": "ft"}, 'units: must be "m" or left out, not "ft"'),
    "another crs": (
        {**GOOD, "units": None, "crs": {"type": "name", "properties": {"name": "EPSG:27700"}}},
        'crs: is "EPSG:27700"; longitude and latitude',
    ),
    "a crs of nothing": ({**GOOD, "units": None, "crs": 5}, "crs: is null"),
    "name": ({**GOOD, "name": 5}, "name: must be text, not 5"),
    "width": ({**GOOD, "width": -1}, "width: must be a number from 0.3 to 50, not -1"),
    "north": ({**GOOD, "north": "up"}, 'north: must be a number from .*, not "up"'),
    "twice": (b'{"type": "FeatureCollection", "type": "FeatureCollection", "features": []}', "type: stands twice"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_plan_is_refused_with_its_place(tmp_path, case):
    content, reason = WRONG[case]
    path = written(tmp_path, content)
    with pytest.raises(FileFormatError, match=reason) as error:
        building_from_plan(path)
    assert str(path) in str(error.value)


def test_a_fault_in_the_second_file_names_that(tmp_path):
    good, bad = written(tmp_path, GOOD), written(tmp_path, document(7), "ways.geojson")
    with pytest.raises(FileFormatError, match=r"ways\.geojson: features\[0\]"):
        building_from_plan(good, bad)
    other = dict(GOOD)
    del other["units"]
    with pytest.raises(FileFormatError, match=r"ways\.geojson: units: must be as in the first file"):
        building_from_plan(good, written(tmp_path, other, "ways.geojson"))


def test_plans_that_are_too_much_are_refused(tmp_path):
    zigzag = [(k % 2 * 30.0, k * 0.6) for k in range(4000)]
    with pytest.raises(FileFormatError, match="straight pieces of corridor; at most"):
        building_from_plan(written(tmp_path, document(line("path", *zigzag))))
    wide = [line("wall", (0, y), (900, y)) for y in (0, 900)]
    with pytest.raises(FileFormatError, match="cells of plan; at most"):
        building_from_plan(written(tmp_path, document(*wide)))
    with pytest.raises(InputError, match="there is no such file"):
        building_from_plan(tmp_path / "none.geojson")


@pytest.mark.parametrize("seed", range(60))
def test_a_plan_with_random_damage_is_read_or_refused(tmp_path, seed):
    """Whatever is put in place of some values: a building, or an error that mapfuse raises on purpose."""
    rng = np.random.default_rng(seed)
    plan = t_plan()
    plan["features"] += [line("wall", (-1, 1), (13, 1)), box("door", 9.5, 0.9, 10.5, 1.1)]
    junk = [None, True, -1, 1e308, 10**40, "", "x", [], {}, [[]], [[0, 0]], [1, 2], {"type": "Point"}, [[1, 1], [1, 1]]]
    for _ in range(int(rng.integers(1, 4))):
        target = plan
        while True:
            keys = list(target) if isinstance(target, dict) else list(range(len(target)))
            if not keys:
                break
            key = keys[int(rng.integers(len(keys)))]
            if isinstance(target[key], (dict, list)) and rng.random() < 0.8:
                target = target[key]
            else:
                target[key] = copy.deepcopy(junk[int(rng.integers(len(junk)))])
                break
    try:
        building = building_from_plan(written(tmp_path, plan))
    except MapfuseError:
        return
    assert np.isfinite(building.walls).all()
    assert np.isfinite(building.floor.positions).all()
