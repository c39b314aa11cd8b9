"""One merge against the truth, with figures worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.truth import Truth
from mapfuse.fusion.compare.evaluation import Evaluation, evaluated
from mapfuse.fusion.compare.method import Merge, MergedLandmark


def points(name, *xy):
    return LandmarkMap(name, tuple(Landmark(f"{name}{k}", "tree", *p) for k, p in enumerate(xy)))


ONE = points("A", (0.0, 0.0), (4.0, 0.0), (0.0, 3.0))
TWO = points("B", (4.0, 0.0), (0.0, 3.0), (9.0, 9.0))
TRUTH = Truth(
    {"A": np.zeros(3), "B": np.array([1.0, 0.0, 0.0])},
    {"A": {"A0": "p", "A1": "q", "A2": "r"}, "B": {"B0": "q", "B1": "r", "B2": None}},
    {"p": np.array([0.0, 0.0]), "q": np.array([4.0, 0.0]), "r": np.array([0.0, 3.0])},
)


def merge(*landmarks, matches=(), T12=None):
    return Merge("merged", T12, matches, tuple(landmarks))


def as_evaluation(made):
    return Evaluation(("A", "B"), "m", 9, 0, made, 0, 0, 0.0, evaluated(ONE, TWO, made, TRUTH))


def test_errors_of_T12_are_at_the_origin_of_map_2():
    t = evaluated(ONE, TWO, merge(T12=Transform(4.0, 4.0, 0.25)), TRUTH)
    assert t.error_m == pytest.approx(5.0)
    assert t.error_rad == pytest.approx(0.25)


def test_every_recorded_place_counts_once_in_rms():
    made = merge(
        MergedLandmark(0.0, 0.0, ("A0",), ()),
        MergedLandmark(4.0, 0.3, ("A1",), ("B0",)),  # counts twice
        MergedLandmark(0.4, 3.0, ("A2",), ("B1",)),
        MergedLandmark(50.0, 50.0, (), ("B2",)),  # isn't there, has no place
        matches=(("A1", "B0"), ("A2", "B1")),
    )
    e = as_evaluation(made)
    assert e.truth.rms == pytest.approx(np.sqrt((2 * 0.09 + 2 * 0.16) / 5))
    assert e.truth.displacement == pytest.approx(0.35)
    assert (e.truth.right, e.truth.common, e.count, e.correctness) == (2, 2, 2, 1.0)
    assert e.merged_wrongly is False


def test_a_wrong_match_shows_in_rms_and_correctness():
    made = merge(
        MergedLandmark(0.0, 0.0, ("A0",), ("B0",)),
        MergedLandmark(4.0, 0.0, ("A1",), ()),
        MergedLandmark(0.0, 3.0, ("A2",), ("B1",)),
        matches=(("A0", "B0"), ("A2", "B1")),
    )
    e = as_evaluation(made)
    assert e.correctness == 0.5
    assert e.truth.rms == pytest.approx(np.sqrt(16 / 5))  # B0 is q, 4 m away
    assert e.best_is_right is False
    assert e.merged_wrongly is True


def test_a_merge_that_is_moved_as_a_whole_is_right_after_alignment():
    c, s = np.cos(0.3), np.sin(0.3)
    at = [(2 + c * x - s * y, 1 + s * x + c * y) for x, y in ((0, 0), (4, 0), (0, 3))]
    made = merge(*(MergedLandmark(x, y, (i,), ()) for (x, y), i in zip(at, ONE.ids, strict=True)))
    t = evaluated(ONE, TWO, made, TRUTH)
    assert t.rms > 1
    assert t.rms_aligned == pytest.approx(0.0, abs=1e-12)


def test_one_landmark_leaves_alignment_open():
    t = evaluated(ONE, TWO, merge(MergedLandmark(0.0, 0.5, ("A0",), ())), TRUTH)
    assert t.rms == pytest.approx(0.5)
    assert t.rms_aligned is None
    assert t.displacement is None


def test_nothing_merged_has_no_rms_and_is_not_wrong():
    made = Merge("ambiguous", Transform(1.0, 0.0, 0.0), (("A1", "B0"),))
    e = as_evaluation(made)
    assert e.truth.rms is e.truth.displacement is e.truth.eliminated is None
    assert e.best_is_right is True
    assert e.merged_wrongly is False


def test_right_matches_but_landmarks_far_off_are_a_wrong_merge():
    made = merge(MergedLandmark(4.0, 3.5, ("A1",), ("B0",)), matches=(("A1", "B0"),))
    assert as_evaluation(made).merged_wrongly is True


def test_a_map_that_the_truth_doesn_t_know_is_a_key_error():
    stranger = points("C", (0.0, 0.0))
    with pytest.raises(KeyError):
        evaluated(ONE, stranger, merge(), TRUTH)
