"""The real recordings that other tests stand on: what is read is what the files say, and gives nothing away."""

from itertools import combinations

import numpy as np

from mapfuse.datasets import se2


def count_near(map1, map2, T12):
    """Landmarks of map 1 with one of map 2 of their type within 0.75 m under T12."""
    apart = np.linalg.norm(map1.positions[:, None] - se2.transform(T12, map2.positions)[None], axis=-1)
    alike = np.array(map1.types)[:, None] == np.array(map2.types)[None]
    return int(((apart < 0.75) & alike).any(axis=1).sum())


def test_slideslam_maps_hold_the_files_objects_under_new_names_and_order(shared_data, slideslam_maps):
    for number, map_ in enumerate(slideslam_maps):
        rows = np.loadtxt(shared_data / "slideslam" / f"robot{number}Map_indoor.txt")
        expected = sorted((f"class-{int(label)}", x, y) for label, x, y, _ in rows)
        assert sorted((l.type, l.x, l.y) for l in map_.landmarks) == expected
        assert not np.array_equal(map_.positions, rows[:, 1:3])
    assert {t for map_ in slideslam_maps for t in map_.types} == {"class-1", "class-2", "class-3"}


def test_slideslam_reference_lays_objects_onto_objects_of_their_class(slideslam_maps, slideslam_T12):
    for (one, two), T12 in slideslam_T12.items():
        map1, map2 = slideslam_maps[one], slideslam_maps[two]
        right = count_near(map1, map2, T12.array)
        centre = map2.positions.mean(axis=0)
        half_turn = np.array([*(2 * centre), np.pi])
        wrong = count_near(map1, map2, se2.compose(T12.array, half_turn))
        assert right >= 10
        assert wrong < right


def test_slideslam_reference_closes_its_cycle(slideslam_T12):
    T01, T12, T02 = (slideslam_T12[pair].array for pair in ((0, 1), (1, 2), (0, 2)))
    gap = se2.between(se2.compose(T01, T12), T02)
    assert np.hypot(*gap[:2]) < 0.5
    assert abs(gap[2]) < np.deg2rad(2)


def test_mrclam_truth_lays_each_map_onto_the_survey(mrclam_maps, mrclam_truth):
    for number, maps in mrclam_maps.items():
        truth = mrclam_truth[number]
        for map_ in maps:
            places = np.array([truth.places[truth.landmarks[map_.name][i]] for i in map_.ids])
            placed = se2.transform(truth.frames[map_.name], map_.positions)
            assert np.sqrt(np.mean(np.sum((placed - places) ** 2, axis=1))) < 0.25


def test_mrclam_truth_moves_common_tubes_onto_each_other(mrclam_maps, mrclam_truth):
    for number, maps in mrclam_maps.items():
        for map1, map2 in combinations(maps, 2):
            truth = mrclam_truth[number]
            T12 = truth.T12(map1.name, map2.name)
            pairs = truth.true_pairs(map1.name, map2.name)
            apart = [
                np.hypot(*(map1.positions[map1.index_from_id[a]] - T12.apply(map2.positions[map2.index_from_id[b]])))
                for a, b in pairs
            ]
            assert len(pairs) >= 13
            assert np.mean(apart) < 0.5


def test_mrclam_maps_give_away_nothing(mrclam_maps, mrclam_truth):
    for number, maps in mrclam_maps.items():
        for map_ in maps:
            assert set(map_.types) == {"tube"}
            assert len(map_.landmarks) in (14, 15)
            numbers = [int(mrclam_truth[number].landmarks[map_.name][i]) for i in map_.ids]
            assert numbers != sorted(numbers)
        pairs = mrclam_truth[number].true_pairs(maps[0].name, maps[1].name)
        assert sum(a == b for a, b in pairs) < len(pairs) / 2
