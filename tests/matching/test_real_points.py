"""Hypotheses on recorded maps of point landmarks, ids dropped: the best one is the true transformation."""

from itertools import combinations

import numpy as np
import pytest

from mapfuse.matching.point_pairs import match_point_pairs


def displacement(hypothesis, T12, points2):
    """Mean distance [m] between where the hypothesis and the truth take points of map 2."""
    return float(np.hypot(*(hypothesis.T12.apply(points2) - T12.apply(points2)).T).mean())


@pytest.mark.parametrize("pair", [(0, 1), (0, 2), (1, 2)])
def test_slideslam_indoor_objects(slideslam_maps, slideslam_T12, pair):
    map1, map2 = (slideslam_maps[k] for k in pair)
    found = match_point_pairs(map1, map2)
    assert displacement(found[0], slideslam_T12[pair], map2.positions) < 0.6
    back = match_point_pairs(map2, map1)
    assert displacement(back[0], slideslam_T12[pair].inverse(), map1.positions) < 0.6


@pytest.mark.parametrize("number", [2, 4, 6])
def test_mrclam_tubes(mrclam_maps, mrclam_truth, number):
    for map1, map2 in combinations(mrclam_maps[number], 2):
        T12 = mrclam_truth[number].T12(map1.name, map2.name)
        pairs = mrclam_truth[number].true_pairs(map1.name, map2.name)
        common2 = np.array([map2.positions[map2.index_from_id[b]] for _, b in pairs])
        best = match_point_pairs(map1, map2)[0]
        assert displacement(best, T12, common2) < 0.5, (map1.name, map2.name)
        assert len(set(best.correspondences) & set(pairs)) >= 0.8 * len(pairs)
