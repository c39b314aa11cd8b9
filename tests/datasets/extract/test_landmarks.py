"""Landmarks out of grids that were drawn by hand or of simulated floors, whose places are known."""

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import map_from_dict, map_to_dict, se2, validate
from mapfuse.datasets.arms import Kind, signature
from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.extract import FREE, OCCUPIED, UNKNOWN, ExtractConfig, Grid, extract_landmarks, merged_grid
from mapfuse.datasets.extract.plangrid import plan_grid
from mapfuse.datasets.simulation import make_building
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.prepared import prepare

#: Fewer looks than a user takes: what is tested doesn't hang on their number.
QUICK = ExtractConfig(looks=5)
NO_DOORS = np.zeros((0, 2, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=np.intp)


def drawn(*rooms, walls=(), size=(30.0, 20.0), resolution=0.1):
    """Rectangles (x0, y0, x1, y1) [m] of free space with walls around, and ``walls`` within."""
    cells = np.full((int(size[1] / resolution), int(size[0] / resolution)), UNKNOWN, dtype=np.int8)

    def fill(box, value, grow=0.0):
        x0, y0, x1, y1 = (round((v + s * grow) / resolution) for v, s in zip(box, (-1, -1, 1, 1), strict=True))
        cells[y0:y1, x0:x1] = value

    for room in rooms:
        fill(room, OCCUPIED, 0.2)
    for room in rooms:
        fill(room, FREE)
    for wall in walls:
        fill(wall, OCCUPIED)
    return Grid("drawn", cells, resolution, np.zeros(3))


def kinds(map_):
    """Kind and place of all landmarks, sorted; of an end only that it is one, since its walls may be left unsaid."""
    kind = {Kind.UNKNOWN: Kind.END}
    return sorted((kind.get(signature(l).kind, signature(l).kind), round(l.x), round(l.y)) for l in map_.landmarks)


def test_an_l_of_two_corridors():
    # 2 m wide: the middle lines are x = 3 and y = 3, and ends are as far from the end's wall as from the others
    map_ = extract_landmarks(drawn((2, 2, 22, 4), (2, 2, 4, 16)), QUICK)
    assert kinds(map_) == [(Kind.CORNER, 3, 3), (Kind.END, 3, 15), (Kind.END, 21, 3)]
    corner, far, up = (
        min(map_.landmarks, key=lambda l: np.hypot(l.x - x, l.y - y)) for x, y in ((3, 3), (21, 3), (3, 15))
    )
    np.testing.assert_allclose([corner.x, corner.y, far.y, up.x], 3.0, atol=0.1)
    ways = {link.connected_to_id: link for link in corner.links if link.connected_to_id}
    assert set(ways) == {far.id, up.id}
    assert ways[far.id].heading == pytest.approx(0.0, abs=0.02)
    assert ways[up.id].heading == pytest.approx(np.pi / 2, abs=0.02)
    assert ways[far.id].distance == pytest.approx(np.hypot(far.x - corner.x, far.y - corner.y))
    assert sorted(link.type for link in corner.links) == ["blocked", "blocked", "open", "open"]


def test_a_t_junction_and_a_crossing():
    map_ = extract_landmarks(drawn((2, 9, 28, 11), (9, 2, 11, 18), (19, 2, 21, 11)), QUICK)
    found = kinds(map_)
    assert (Kind.CROSSING, 10, 10) in found
    assert (Kind.T_JUNCTION, 20, 10) in found
    assert sum(kind == Kind.END for kind, _, _ in found) == 5
    assert len(found) == 7


def test_a_narrow_place_is_a_door_with_the_corridors_linked_through_it():
    map_ = extract_landmarks(drawn((2, 2, 26, 4), walls=((14, 2, 14.2, 2.6), (14, 3.5, 14.2, 4))), QUICK)
    assert map_.types.count("door") == 1
    door = next(l for l in map_.landmarks if l.type == "door")
    np.testing.assert_allclose([door.x, door.y], [14.1, 3.05], atol=0.15)
    assert sum(link.connected_to_id is not None for link in door.links) == 2


def test_speckle_furniture_and_rays_change_nothing():
    plain = drawn((2, 2, 22, 4), (2, 2, 4, 16))
    cells = plain.cells.copy()
    rng = np.random.default_rng(0)
    free = np.argwhere(cells == FREE)
    cells[tuple(free[rng.choice(len(free), 30, replace=False)].T)] = OCCUPIED
    cells[22:26, 120:126] = OCCUPIED  # a cupboard in the corridor
    cells[41:43, 100], cells[43:160, 100:102] = FREE, FREE  # a ray through a gap in the wall
    assert kinds(extract_landmarks(replace(plain, cells=cells), QUICK)) == kinds(extract_landmarks(plain, QUICK))


def test_a_room_is_no_corridor():
    map_ = extract_landmarks(drawn((2, 8, 12, 18), (12, 12, 28, 14)), QUICK)
    assert all(landmark.x > 11 for landmark in map_.landmarks)
    assert Kind.END in {signature(l).kind for l in map_.landmarks}


@pytest.mark.parametrize("turn", [0.4, 1.1])
def test_a_turned_grid_has_the_same_landmarks(turn):
    grid = drawn((2, 9, 28, 11), (9, 2, 11, 18), (19, 2, 21, 11))
    pose = np.array([5.0, -3.0, turn])
    map1, map2 = extract_landmarks(grid, QUICK), extract_landmarks(merged_grid([grid], [pose]), QUICK)
    assert sorted(map1.types) == sorted(map2.types)
    moved = se2.transform(pose, map1.positions)
    apart = np.hypot(*np.moveaxis(moved[:, None] - map2.positions[None], -1, 0))
    off = apart.min(axis=1)
    # ends are where a middle line stops, which is the least certain
    assert off[np.array(map1.types) == "junction"].max() < 0.15
    assert off.max() < 0.5
    kinds = [
        (signature(map1.landmarks[k]).kind, signature(map2.landmarks[j]).kind)
        for k, j in enumerate(apart.argmin(axis=1).tolist())
    ]
    # an arm that too few looks agree on is left out, and the kind then unknown
    known = [pair for pair in kinds if Kind.UNKNOWN not in pair]
    assert len(known) >= len(kinds) - 1
    assert all(one == two for one, two in known)


def test_a_grid_with_a_turned_origin_gives_the_turned_map():
    grid = drawn((2, 2, 22, 4), (2, 2, 4, 16))
    pose = np.array([4.0, 1.0, 0.6])
    turned = extract_landmarks(replace(grid, origin=pose), QUICK)
    plain = extract_landmarks(grid, QUICK)
    expected = se2.transform(pose, plain.positions)
    apart = np.hypot(*np.moveaxis(expected[:, None] - turned.positions[None], -1, 0))
    assert apart.min(axis=1).max() < 0.2
    for landmark, there in zip(plain.landmarks, apart.argmin(axis=1).tolist(), strict=True):
        arms1, arms2 = signature(landmark), signature(turned.landmarks[there])
        assert se2.wrap(arms2.heading - arms1.heading) == pytest.approx(0.6, abs=0.1)


@pytest.mark.parametrize(("kind", "seed"), [("irregular", 3), ("irregular", 4)])
def test_places_of_a_simulated_floor_are_found(kind, seed):
    """Two independent ways to the same places: the generator's graph, and the free space between its walls."""
    building = make_building(kind, seed)
    map_ = extract_landmarks(plan_grid(kind, building.walls, *NO_DOORS), QUICK)
    places = [place for place in building.floor.places if place.type != "door"]
    at = np.array([place.xy for place in places])
    apart = np.hypot(*np.moveaxis(map_.positions[:, None] - at[None], -1, 0))
    assert apart.min(axis=1).max() < 0.7, "nothing is found where there is nothing"
    near = apart.argmin(axis=1)
    assert len(set(near.tolist())) >= 0.9 * len(places)
    assert np.median(apart.min(axis=1)) < 0.1
    assert all(map_.types[k] == places[j].type for k, j in enumerate(near.tolist()))
    linked = {
        frozenset((k, map_.index_from_id[link.connected_to_id]))
        for k, l in enumerate(map_.landmarks)
        for link in l.links
        if link.connected_to_id
    }
    assert len(linked) >= 0.8 * len(places)


def test_the_map_keeps_all_rules_and_can_be_prepared():
    map_ = extract_landmarks(drawn((2, 9, 28, 11), (9, 2, 11, 18), (19, 2, 21, 11)), QUICK)
    assert not validate(map_)
    assert map_from_dict(map_to_dict(map_)) == map_
    assert all(0 < landmark.existence < 1 for landmark in map_.landmarks)
    eigenvalues = np.linalg.eigvalsh(map_.joint_covariance.matrix)
    assert eigenvalues.min() > 0.05**2
    prepared = prepare(map_, SolvingConfig())
    np.testing.assert_allclose(prepared.positions, map_.positions, atol=1e-3)
    assert len(prepared.corridors) == 6


def test_walls_run_along_the_space():
    map_ = extract_landmarks(drawn((2, 2, 22, 4)), QUICK)
    points = np.vstack(map_.walls)
    # the walls are two cells thick: 0.1 m outside of the space
    lowest, highest = points.min(axis=0), points.max(axis=0)
    np.testing.assert_allclose([*lowest, *highest], [1.9, 1.9, 22.1, 4.1], atol=0.11)
    assert sum(np.hypot(*np.diff(wall, axis=0).T).sum() for wall in map_.walls) == pytest.approx(44, rel=0.05)


@pytest.mark.parametrize(
    "cells", [np.full((20, 20), UNKNOWN), np.zeros((1, 1)), np.full((30, 30), OCCUPIED), np.zeros((5, 200))]
)
def test_a_grid_without_corridors_is_an_empty_map_or_a_small_one(cells):
    map_ = extract_landmarks(Grid("g", cells.astype(np.int8), 0.1, np.zeros(3)), QUICK)
    assert len(map_) <= 2
    assert not validate(map_)


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_no_map(seed):
    rng = np.random.default_rng(seed)
    cells = rng.choice([UNKNOWN, FREE, OCCUPIED], (120, 120)).astype(np.int8)
    assert not validate(extract_landmarks(Grid("noise", cells, 0.1, np.zeros(3)), QUICK))


def test_the_same_grid_gives_the_same_map():
    grid = drawn((2, 9, 28, 11), (9, 2, 11, 18))
    assert extract_landmarks(grid, QUICK) == extract_landmarks(grid, QUICK)


def test_parameters_are_checked():
    with pytest.raises(ConfigError, match=r"extract\.spur_m is -1; it must lie between"):
        ExtractConfig(spur_m=-1)
