"""Vector plans: their corridors by free space, and their landmarks."""

import numpy as np

from mapfuse.datasets import validate
from mapfuse.datasets.extract import FREE, OCCUPIED, UNKNOWN, map_of_floor
from mapfuse.datasets.extract.plangrid import plan_grid, plan_lines
from mapfuse.datasets.extract.planmap import polylines
from mapfuse.datasets.simulation import make_building

NO_LEAVES = np.zeros((0, 2, 2)), np.zeros(0, dtype=np.intp)


def box(x0, y0, x1, y1):
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=float)
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


#: Two corridors end to end with a door between them, rooms with one door each along both.
ROOMS = [(x, y, x + 5, y + 4) for x in (0, 5, 10, 15) for y in (2, -4)]
BESIDE = np.array([[(10.0, 0.0), (10.0, 0.5)], [(10.0, 1.5), (10.0, 2.0)]])
WALLS = np.concatenate([box(0, 0, 20, 2), BESIDE, *(box(*room) for room in ROOMS)])
DOORS = np.array(
    [[(10.0, 0.5), (10.0, 1.5)], *([(x + 2.0, y), (x + 3.0, y)] for x in (0, 5, 10, 15) for y in (0.0, 2.0))]
)


def test_doors_between_corridors_stand_open_and_rooms_stay_closed():
    grid = plan_grid("plan", WALLS, DOORS, *NO_LEAVES)
    assert grid.at([[5.0, 1.0], [10.0, 1.0], [15.0, 1.0]]).tolist() == [FREE] * 3
    assert grid.at([[2.5, 4.0], [17.5, -2.0]]).tolist() == [UNKNOWN] * 2
    assert grid.at([[2.5, 2.0], [10.0, 0.2]]).tolist() == [OCCUPIED] * 2


def test_lines_run_along_the_middle_through_the_open_door():
    lines = plan_lines(WALLS, DOORS, *NO_LEAVES)
    points = np.vstack(lines)
    assert np.abs(points[:, 1] - 1.0).max() < 0.3
    assert points[:, 0].min() < 1.5
    assert points[:, 0].max() > 18.5


def test_no_walls_no_lines():
    nothing = np.zeros((0, 2, 2))
    assert plan_lines(nothing, nothing, *NO_LEAVES) == []
    assert plan_lines(np.array([[[0.0, 0.0], [9.0, 0.0]]]), nothing, *NO_LEAVES) == []


def test_a_floors_map_has_every_place_and_every_corridor():
    floor = make_building("irregular", 5).floor
    map_ = map_of_floor(floor)
    assert not validate(map_)
    np.testing.assert_array_equal(map_.positions, floor.positions)
    for place in floor.places:
        links = {link.connected_to_id: link for link in map_[place.id].links if link.connected_to_id}
        assert set(links) == set(floor.neighbours[place.id])
        for other, link in links.items():
            assert link.distance == floor.distance(place.id, other)


def test_polylines_hold_every_segment_once():
    rng = np.random.default_rng(0)
    runs = [rng.uniform(0, 9, (n, 2)) for n in (2, 5, 3)]
    segments = np.concatenate([np.stack([run[:-1], run[1:]], axis=1) for run in runs])
    for run, line in zip(runs, polylines(segments), strict=True):
        np.testing.assert_array_equal(run, line)
    assert polylines(np.zeros((0, 2, 2))) == ()
