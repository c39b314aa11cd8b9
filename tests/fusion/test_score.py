"""The score against truth, and its NEES against filterpy's."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.stats import NEES

from mapfuse.datasets import se2
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.fusion import fuse
from mapfuse.fusion.score import score_pair


@pytest.fixture(scope="module")
def merged():
    map1, map2, truth = simulated_pair(3)
    return fuse([map1, map2]), truth


def test_nees_of_T12_is_filterpys(merged):
    fused, truth = merged
    pair = fused.pairs[0]
    truth_T12 = truth.T12("A", "B").array
    # filterpy doesn't wrap angles: the truth's is brought next to the estimate's
    truth_T12[2] = pair.T12.theta + se2.wrap(truth_T12[2] - pair.T12.theta)
    (expected,) = NEES(truth_T12[None], pair.T12.array[None], [pair.T12.covariance])
    assert score_pair(fused, truth).nees_T12 == pytest.approx(float(expected))


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
