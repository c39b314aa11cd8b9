"""Fusing recorded maps that nobody here made: point landmarks whose ids are not used."""

from itertools import combinations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.fusion import fuse
from mapfuse.fusion.score import score_pair


def mean_displacement(T12, reference, points2):
    """Mean distance [m] between where two transformations take points (k, 2) of map 2."""
    return float(np.linalg.norm(T12.apply(points2) - reference.apply(points2), axis=1).mean())


@pytest.mark.parametrize("pair", [(0, 1), (0, 2), (1, 2)])
def test_indoor_objects_of_three_robots(slideslam_maps, slideslam_T12, pair):
    map1, map2 = (slideslam_maps[k] for k in pair)
    fused = fuse([map1, map2])
    assert fused.decision in ("merged", "ambiguous")
    assert mean_displacement(fused.pairs[0].T12, slideslam_T12[pair], map2.positions) < 0.6


@pytest.mark.parametrize("number", [2, 4, 6])
def test_tubes_of_five_robots(mrclam_maps, mrclam_truth, number):
    truth = mrclam_truth[number]
    for map1, map2 in combinations(mrclam_maps[number], 2):
        fused = fuse([map1, map2])
        names = (map1.name, map2.name)
        common2 = np.array([map2.positions[map2.index_from_id[b]] for _, b in truth.true_pairs(*names)])
        assert mean_displacement(fused.pairs[0].T12, truth.T12(*names), common2) < 0.5, names
        # which of two tubes that stand 0.2 m apart is which can't be told, so no share of right correspondences
        assert fused.decision != "merged" or score_pair(fused, truth).displacement < 0.5, names


def test_halves_of_one_real_drive(victoria_park):
    map1, map2, truth = victoria_park
    fused = fuse([map1, map2])
    assert fused.decision == "merged"
    into_frame = se2.inverse(truth.frames[map1.name])
    place_of = {a: truth.landmarks[map1.name][a] for a, _ in truth.true_pairs(map1.name, map2.name)}
    found = {place_of.get(landmark.sources.get(map1.name, ("",))[0]): landmark for landmark in fused.landmarks}
    displaced = [
        np.linalg.norm(np.array([found[place].x, found[place].y]) - se2.transform(into_frame, truth.places[place]))
        for place in place_of.values()
    ]
    assert np.median(displaced) < 0.5
