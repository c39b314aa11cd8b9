"""Buildings: closed walls, rays and sight against independent methods, steel against its stated statistics."""

from itertools import pairwise

import numpy as np
import pytest

from mapfuse.datasets import ConfigError
from mapfuse.datasets.simulation import (
    DoorAt,
    build,
    draw_steel,
    floor_from_graph,
    hospital_like,
    irregular_floor,
    make_building,
    make_floor,
    salvatori_like,
    wings_floor,
)
from mapfuse.datasets.simulation.outline import corridor_walls
from mapfuse.datasets.simulation.raycast import cast, distances
from mapfuse.datasets.simulation.walls import floor_walls

KINDS = ("irregular", "oblique", "alike", "symmetric", "wings")


def star(degrees, length=9.0):
    """A node with straight corridors at these angles."""
    nodes = [(0.0, 0.0), *((length * np.cos(a), length * np.sin(a)) for a in np.deg2rad(degrees))]
    return floor_from_graph("star", nodes, [(0, k + 1) for k in range(len(degrees))])


AWKWARD = {
    "end": star([0]),
    "straight": star([0, 180]),
    "right angle": star([0, 90]),
    "obtuse": star([0, 150]),
    "acute": star([0, 35]),
    "very acute": star([0, 21]),
    "T": star([0, 90, 180]),
    "oblique T": star([0, 50, 180]),
    "Y": star([10, 130, 250]),
    "three on one side": star([0, 40, 80]),
    "oblique crossing": star([0, 60, 180, 240]),
    "five": star([0, 72, 144, 216, 288]),
    "six unequal": star([0, 25, 95, 130, 200, 290]),
    "crossing without a place": floor_from_graph("x", [(-9, 0), (9, 0), (-3, -8), (4, 8)], [(0, 1), (2, 3)]),
    "close parallels": floor_from_graph("h", [(0, 0), (9, 0), (9, 1.5), (0, 1.5)], [(0, 1), (1, 2), (2, 3)]),
    "end beside a corridor": floor_from_graph("i", [(0, 0), (9, 0), (4, 1.6), (4, 8)], [(0, 1), (2, 3)]),
    "short link": floor_from_graph("z", [(0, 0), (8, 0), (8, 1), (16, 1)], [(0, 1), (1, 2), (2, 3)]),
    "touching": floor_from_graph("u", [(0, 0), (9, 0), (9, 2), (0, 2)], [(0, 1), (1, 2), (2, 3)]),
    "triangle": floor_from_graph("t", [(0, 0), (12, 0), (4, 7)], [(0, 1), (1, 2), (2, 0)]),
    "salvatori": salvatori_like(),
    "hospital": hospital_like(),
}


def inside(points, walls, direction=0.7312):
    """Even-odd rule with a ray along one direction: independent of how closely the walls' ends meet in `cast`."""
    c, s = np.cos(direction), np.sin(direction)
    turned = walls @ np.array([[c, -s], [s, c]])
    found = []
    for x, y in np.asarray(points) @ np.array([[c, -s], [s, c]]):
        (x0, y0), (x1, y1) = np.moveaxis(turned[:, 0], -1, 0), np.moveaxis(turned[:, 1], -1, 0)
        crosses = (y0 > y) != (y1 > y)
        at = x0 + (y - y0) / np.where(crosses, y1 - y0, 1.0) * (x1 - x0)
        found.append(np.sum(crosses & (at > x)) % 2 == 1)
    return np.array(found)


def line_points(building, rng, count):
    """Random points on the corridors' lines."""
    steps = building.steps[rng.integers(len(building.steps), size=count)]
    return steps[:, 0] + rng.uniform(size=(count, 1)) * (steps[:, 1] - steps[:, 0])


def check_walls(floor):
    building, rng = build(floor, steel_sigma=0), np.random.default_rng(1)
    points = line_points(building, rng, 40)
    assert inside(points, building.walls).all(), "every point of a corridor's line is walled in"
    for point in points:
        found = building.ranges([*point, 0.0], rng.uniform(-np.pi, np.pi, 90), np.inf)
        assert np.isfinite(found).all(), "no ray escapes"
        assert found.min() > floor.width / 2 - 1e-6
    shares = rng.uniform(size=(len(building.walls), 20, 1))
    on_walls = building.walls[:, :1] + shares * (building.walls[:, 1:] - building.walls[:, :1])
    away = distances(on_walls.reshape(-1, 2), building.steps).min(axis=1)
    assert away.min() > floor.width / 2 - 1e-6, "no wall stands in a corridor"
    assert away.max() <= floor.width + 1e-6, "walls stay at the corridors"
    low, high = building.walls.min(axis=(0, 1)), building.walls.max(axis=(0, 1))
    anywhere = rng.uniform(low - 1, high + 1, (300, 2))
    distance = distances(anywhere, building.steps).min(axis=1)
    within = inside(anywhere, building.walls)
    assert within[distance < floor.width / 2 - 1e-6].all()
    assert not within[distance > floor.width + 1e-6].any()


@pytest.mark.parametrize("name", AWKWARD)
def test_walls_are_closed_around_corridors(name):
    check_walls(AWKWARD[name])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_walls_of_generated_floors_are_closed(kind, seed):
    check_walls(make_floor(kind, np.random.default_rng(seed)))


@pytest.mark.parametrize("seed", range(8))
def test_walls_around_random_stars_are_closed(seed):
    rng = np.random.default_rng(seed)
    gaps = rng.dirichlet(np.ones(int(rng.integers(2, 6))))
    gaps = 25 + gaps * (360 - 25 * len(gaps))
    check_walls(star(rng.uniform(0, 360) + np.cumsum(gaps)))


@pytest.mark.parametrize("name", ["right angle", "T", "oblique T", "oblique crossing", "end", "Y"])
def test_walls_are_those_that_pictures_of_maps_show(name):
    """Two constructions of one outline: where corridors neither overlap nor meet too sharply they are the same."""
    floor = AWKWARD[name]
    drawn = np.array([wall for wall in corridor_walls(floor, floor.corridors) if len(wall) == 2])
    walls = floor_walls(floor)
    for a, b in ((drawn, walls), (walls, drawn)):
        points = (a[:, :1] + np.linspace(0, 1, 30)[:, None] * (a[:, 1:] - a[:, :1])).reshape(-1, 2)
        assert distances(points, b).min(axis=1).max() < 1e-6


def test_ranges_at_a_t_junction_by_hand():
    building = build(star([0, 90, 180], length=8.0), steel_sigma=0)
    bearings = np.deg2rad([0, 90, 180, -90, 45, 135])
    # half a width behind the ends, the wall below, the two corners where the corridors' sides meet
    expected = [9, 9, 9, 1, np.sqrt(2), np.sqrt(2)]
    assert building.ranges([0, 0, 0], bearings, 20.0) == pytest.approx(expected, abs=1e-5)
    assert building.ranges([0, 0, np.pi / 2], bearings - np.pi / 2, 20.0) == pytest.approx(expected, abs=1e-5)
    assert building.ranges([0, 0, 0], bearings, 8.0)[:4].tolist() == [np.inf, np.inf, np.inf, 1.0]
    assert building.ranges([0, 0, 0], [], 8.0).shape == (0,)


def marched(building, point, direction, reach):
    """The range by steps as long as the nearest wall is away: a second method that knows no intersections."""
    r, heading = 0.0, np.array([np.cos(direction), np.sin(direction)])
    while r < reach:
        step = float(building.clearance(point + r * heading))
        if step < 1e-6:
            return r
        r += step
    return np.inf


@pytest.mark.parametrize("kind", ["oblique", "wings"])
def test_ranges_agree_with_marching(kind):
    building, rng = make_building(kind, 5), np.random.default_rng(2)
    for point in line_points(building, rng, 12):
        directions = rng.uniform(-np.pi, np.pi, 12)
        found = building.ranges([*point, 0.3], directions - 0.3, 12.0)
        by_steps = [marched(building, point, direction, 12.0) for direction in directions]
        # marching stops a millionth of a metre before the wall, which grazing rays meet up to a thousand times as far
        assert found == pytest.approx(by_steps, abs=2e-3)


def test_a_ray_along_a_wall_or_from_it_is_no_fault():
    wall = np.array([[[0.0, 0.0], [4.0, 0.0]], [[4.0, -1.0], [4.0, 1.0]], [[2.0, 2.0], [2.0, 2.0]]])
    assert cast([1.0, 0.0], [0.0], wall).tolist() == pytest.approx([4.0 - 1.0])
    assert cast([1.0, 1.0], [-np.pi / 2], wall).tolist() == pytest.approx([1.0])
    assert cast([0.0, 0.0], [0.0, 1.0], np.zeros((0, 2, 2))).tolist() == [np.inf, np.inf]


@pytest.mark.parametrize("kind", ["irregular", "oblique", "wings"])
def test_places_are_seen_exactly_where_the_line_to_them_stays_within_the_walls(kind):
    building, rng = make_building(kind, 11), np.random.default_rng(3)
    checked = 0
    for point in line_points(building, rng, 16):
        seen = set(building.sees([*point, 0.0], reach=15.0).tolist())
        for k, place in enumerate(building.floor.places):
            if np.hypot(*(place.xy - point)) > 15.0:
                assert k not in seen
                continue
            way = point + np.linspace(0, 1, 120)[:, None] * (place.xy - point)
            stays = bool(inside(way, building.walls).all())
            # a line may cut off a corner between two of the points
            if not stays or building.clearance(way).min() > 0.15:
                assert (k in seen) == stays
                checked += 1
    assert checked > 40


def test_field_of_view_and_reach_bound_what_is_seen():
    building = build(floor_from_graph("I", [(0, 0), (20, 0)], [(0, 1)], [DoorAt(0, 1, 6.0, 1), DoorAt(0, 1, 13.0, -1)]))
    names = [place.id for place in building.floor.places]

    def seen(pose, reach, degrees):
        return {names[k] for k in building.sees(pose, reach, np.deg2rad(degrees))}

    assert seen([10, 0, 0], 4.0, 90) == {"d1"}
    assert seen([10, 0, np.pi], 4.0, 90) == {"d0"}
    assert seen([10, 0, np.pi], 4.0, 360) == {"d0", "d1"}
    assert seen([10, 0, np.pi / 2], 30.0, 179) == set()
    assert seen([10, 0, np.pi / 2], 30.0, 181) == {"p0", "p1", "d0", "d1"}
    assert seen([13, 0, 0.4], 0.5, 1) == {"d1"}, "whoever stands on a place sees it"
    assert building.sees([10, 0, 0], 0.5, 1).shape == (0,)


def test_doors_stand_in_the_walls_where_their_places_arms_point():
    for floor in (salvatori_like(), make_floor("oblique", np.random.default_rng(4))):
        building = build(floor)
        assert len(building.doors) == sum(place.type == "door" for place in floor.places)
        assert distances(building.doors.mean(axis=1), building.walls).min(axis=1).max() < 1e-6
        assert distances(building.doors.mean(axis=1), building.steps).min(axis=1) == pytest.approx(1.0)


def test_free_is_within_a_corridor_with_room_around():
    building = build(star([0, 90, 180], length=8.0))
    points = [[5, 0], [5, 0.99], [5, 1.01], [0, -0.99], [0, 5], [2, 2], [8.9, 0], [9.1, 0], [50, 50]]
    assert building.free(points).tolist() == [True, True, False, True, True, False, True, False, False]
    assert building.free(np.array(points)[:, None], radius=0.5)[:, 0].tolist() == [True] + 3 * [False] + [True] + 4 * [
        False
    ]
    assert building.free([5.0, 0.0]).shape == ()


@pytest.mark.parametrize("correlation", ["gaussian", "exponential"])
def test_steel_has_its_stated_mean_sigma_and_correlation_length(correlation):
    """2,000 draws: the standard error of a mean is 0.0034 rad, of a correlation at most 0.022; four of these."""
    sigma, length, draws = 0.15, 4.0, 2000
    lags = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0])
    turn = 2.1
    points = np.array([30.0, -12.0]) + lags[:, None] * (np.cos(turn), np.sin(turn))
    rng = np.random.default_rng(7)
    bends = np.array([draw_steel(rng, sigma, length, correlation).bend(points) for _ in range(draws)])
    assert np.abs(bends.mean(axis=0)).max() < 4 * sigma / np.sqrt(draws)
    assert bends.std(axis=0) == pytest.approx(np.full(len(lags), sigma), rel=4 / np.sqrt(2 * draws))
    expected = np.exp(-((lags / length) ** 2) / 2) if correlation == "gaussian" else np.exp(-lags / length)
    assert np.corrcoef(bends.T)[0] == pytest.approx(expected, abs=4 / np.sqrt(draws))
    skew, kurtosis = (np.mean((bends / sigma) ** k) for k in (3, 4))
    assert abs(skew) < 0.15
    assert kurtosis == pytest.approx(3.0, abs=0.3), "normal, but for 1.5 / 256 of its kurtosis"


def test_a_buildings_steel_is_the_same_for_every_robot():
    points = np.random.default_rng(0).uniform(-20, 20, (50, 2))
    one, same, other = make_building("wings", 3), make_building("wings", 3), make_building("wings", 4)
    assert np.array_equal(one.bend(points), same.bend(points))
    assert one.bend(points[7]) == pytest.approx(one.bend(points)[7], abs=1e-12)
    assert not np.allclose(one.bend(points), other.bend(points))
    assert one.floor == same.floor
    assert np.array_equal(one.walls, same.walls)
    assert build(one.floor, steel_sigma=0).bend(points).tolist() == [0.0] * 50


@pytest.mark.parametrize("wrong", [{"sigma": -1}, {"sigma": np.nan}, {"length": 0}, {"correlation": "white"}])
def test_steel_that_cannot_be_is_refused(wrong):
    with pytest.raises(ConfigError, match=f"{next(iter(wrong))} of steel"):
        draw_steel(np.random.default_rng(0), **wrong)


def test_walls_cannot_be_written_to():
    building = build(salvatori_like())
    with pytest.raises(ValueError, match="read-only"):
        building.walls[0] = 0


# Shapes of floors ----------------------------------------------------------------------------------------------------


def steps_of(floor):
    return [(a, b) for corridor in floor.corridors for a, b in pairwise(corridor.places)]


def parts_of(nodes, steps):
    """Connected parts, by repeated relabelling."""
    label = {node: node for node in nodes}
    for _ in nodes:
        for a, b in steps:
            label[a] = label[b] = min(label[a], label[b])
    return len(set(label.values())), label


def loops_of(floor):
    """Steps that lie on some loop, and how many separate groups of loops there are."""
    nodes, steps = list(floor.place_from_id), steps_of(floor)
    on_loops = [step for step in steps if parts_of(nodes, [s for s in steps if s != step])[0] == 1]
    used = {node for step in on_loops for node in step}
    return on_loops, parts_of(used, on_loops)[0]


def ends_of(floor):
    return [i for i, near in floor.neighbours.items() if len(near) == 1]


def test_salvatori_like_has_one_loop_of_80_m_and_one_cul_de_sac():
    floor = salvatori_like()
    on_loop, groups = loops_of(floor)
    assert groups == 1
    assert sum(floor.distance(*step) for step in on_loop) == pytest.approx(80.0, abs=1e-9)
    assert len(steps_of(floor)) - len(floor.places) + 1 == 1, "one loop"
    assert len(ends_of(floor)) == 1
    # the paper's fullest maps have 20 landmarks, a fifth of the spatial ones false alarms
    assert 16 <= len(floor.places) <= 20
    assert salvatori_like() == floor


def test_hospital_like_has_two_wings_round_a_central_loop():
    floor = hospital_like()
    on_loop, groups = loops_of(floor)
    ring = {place for step in on_loop for place in step}
    assert groups == 1
    assert sum(floor.distance(*step) for step in on_loop) == pytest.approx(60.0)
    assert floor.length == pytest.approx(141.5)
    rest = [step for step in steps_of(floor) if step not in on_loop]
    _, label = parts_of(floor.place_from_id, rest)
    by_x = sorted(floor.places, key=lambda place: place.x)
    west, east = by_x[0], by_x[-1]
    assert east.x - west.x > 50.0
    assert label[west.id] != label[east.id], "from wing to wing the way is by the loop"
    for wing in (west, east):
        gates = [place for place in ring if label[place] == label[wing.id]]
        assert len(gates) == 1, "each wing meets the loop at one junction"
    assert hospital_like() == floor


@pytest.mark.parametrize("wings", [2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_wings_are_blocks_with_loops_joined_by_one_corridor(wings, seed):
    floor = wings_floor(np.random.default_rng(seed), wings=wings)
    assert loops_of(floor)[1] >= wings
    assert floor == wings_floor(np.random.default_rng(seed), wings=wings)
    assert parts_of(floor.place_from_id, steps_of(floor))[0] == 1
    assert min(floor.isolation(place.id) for place in floor.places) >= 2.49
    assert 12 <= sum(place.type != "door" for place in floor.places) <= 25
    assert 8 <= sum(place.type == "door" for place in floor.places) <= 20


@pytest.mark.parametrize("seed", range(4))
def test_loops_and_culs_de_sac_can_be_asked_for(seed):
    floor = irregular_floor(np.random.default_rng(seed), loops=3, culs_de_sac=2)
    assert len(steps_of(floor)) - len(floor.places) + 1 >= 3
    assert len(ends_of(floor)) >= 2
    assert irregular_floor(np.random.default_rng(seed)) == make_floor("irregular", np.random.default_rng(seed))


@pytest.mark.parametrize("wanted", [{"loops": 9}, {"culs_de_sac": 30}, {"loops": -1}])
def test_floors_that_never_come_about_are_refused(wanted):
    with pytest.raises(ConfigError, match=next(iter(wanted))):
        irregular_floor(np.random.default_rng(0), **wanted)
    with pytest.raises(ConfigError, match="wings"):
        wings_floor(np.random.default_rng(0), wings=1)
