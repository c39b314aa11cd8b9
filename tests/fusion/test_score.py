"""The score against truth, and its NEES against filterpy's."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.stats import NEES
from scipy.stats import chi2

from mapfuse.datasets import se2
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.datasets.transform import Transform
from mapfuse.fusion import fuse
from mapfuse.fusion.score import nees_of_transform, score_pair


@pytest.fixture(scope="module")
def merged():
    map1, map2, truth = simulated_pair(3)
    return fuse([map1, map2]), truth


def test_nees_of_what_turns_about_its_own_origin_is_filterpys():
    found = Transform(3.0, -2.0, 3.1, np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.0025]]))
    true = np.array([3.3, -2.1, -3.1])
    # filterpy doesn't wrap angles: the truth's is brought next to the estimate's
    beside = np.array([*true[:2], found.theta + se2.wrap(true[2] - found.theta)])
    (expected,) = NEES(beside[None], found.array[None], [found.covariance])
    assert nees_of_transform(found, Transform.from_array(true)) == pytest.approx(float(expected))


def test_nees_of_T12_is_the_usual_one_where_turns_are_small(merged):
    fused, truth = merged
    pair = fused.pairs[0]
    off = pair.T12.array - truth.T12("A", "B").array
    off[2] = se2.wrap(off[2])
    assert abs(off[2]) < 0.02
    expected = off @ np.linalg.solve(pair.T12.covariance, off)
    assert score_pair(fused, truth).nees_T12 == pytest.approx(expected, rel=0.02)


def test_nees_holds_for_frames_that_are_turned_far_from_their_origin():
    """2,000 estimates, turned by 0.12 rad about a point 60 m away: in the axes their error is no normal one."""
    rng, centre, true = np.random.default_rng(71), np.array([50.0, -34.0]), np.array([1.0, 2.0, 0.3])
    told, usual = [], []
    for _ in range(2000):
        turn, shift = rng.normal(0.0, 0.12), rng.normal(0.0, 0.3, 2)
        about = np.array([*(centre - se2.rotation(turn) @ centre), turn])
        found = se2.compose(about, true) + np.array([*shift, 0.0])
        x, y = found[:2] - centre - shift
        tangent = np.array([[-y, x, 1.0]])
        C = 0.12**2 * tangent.T @ tangent + np.diag([0.09, 0.09, 0.0])
        told.append(nees_of_transform(Transform.from_array(found, C), Transform.from_array(true)))
        usual.append((found - true) @ np.linalg.solve(C, found - true))
    low, high = chi2.ppf([0.001, 0.999], 6000) / 2000
    assert low < np.mean(told) < high
    assert np.mean(usual) > 5.0


def test_a_merge_with_renamed_truth_is_wrong(merged):
    fused, truth = merged
    ids = list(truth.landmarks["B"])
    shuffled = dict(zip(ids, np.roll(np.array([truth.landmarks["B"][i] for i in ids], dtype=object), 1), strict=True))
    wrong = type(truth)(truth.frames, {**truth.landmarks, "B": shuffled}, truth.places)
    assert not score_pair(fused, truth).merged_wrongly
    assert score_pair(fused, wrong).merged_wrongly


def test_a_displaced_merge_is_wrong(merged):
    fused, truth = merged
    moved = tuple(replace(landmark, x=landmark.x + 4.0) for landmark in fused.landmarks)
    assert score_pair(replace(fused, landmarks=moved), truth).merged_wrongly


def test_the_first_maps_own_drift_is_no_wrong_merge(merged):
    # all places elsewhere: as far off in the first map alone as in the merged one
    fused, truth = merged
    away = {name: xy + 5.0 for name, xy in truth.places.items()}
    score = score_pair(fused, type(truth)(truth.frames, truth.landmarks, away))
    assert min(score.displacement, score.own_displacement) > 3.0
    assert not score.merged_wrongly


def test_what_was_not_merged_is_not_merged_wrongly():
    map1, map2, truth = simulated_pair(0, same=False)
    score = score_pair(fuse([map1, map2]), truth)
    assert score.decision != "merged"
    assert not score.merged_wrongly
    assert not len(score.nees_landmarks)
    assert np.isnan(score.nees_T12)
