"""The core, on pairs of simulated maps: merged where they overlap, never wrongly, with covariances that hold.

Test seeds only (`TEST_SEEDS`); every parameter was chosen on `TUNING_SEEDS`. The simulator shares no code with the
factors; associations are not given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from mapfuse.datasets import se2
from mapfuse.datasets.simulation.pairs import TEST_SEEDS, simulated_pair
from mapfuse.datasets.truth import Truth
from mapfuse.fusion import FusedMap, fuse

PAIRS = 200

pytestmark = pytest.mark.statistics


@dataclass(frozen=True)
class Case:
    """One pair of maps of the same floor, fused, and how far from the truth the answer is."""

    seed: int
    decision: str
    reported: int
    true_share: float
    displacement: float
    nees_T12: float
    nees_landmark: float


def errors(fused: FusedMap, truth: Truth) -> list[tuple[np.ndarray, np.ndarray, bool]]:
    """Per fused landmark that is one true place: error (2,) and covariance (2, 2) in frame A, and whether common."""
    to_A = se2.inverse(truth.frames["A"])
    found = []
    for landmark in fused.landmarks:
        places = {truth.landmarks[name][i] for name, ids in landmark.sources.items() for i in ids}
        if len(places) == 1 and (place := places.pop()) is not None:
            error = np.array([landmark.x, landmark.y]) - se2.transform(to_A, truth.places[place])
            found.append((error, landmark.covariance[:2, :2], len(landmark.sources) == 2))
    return found


def nees(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def same_floor(seed: int) -> Case:
    map1, map2, truth = simulated_pair(seed)
    fused = fuse([map1, map2])
    pair = fused.pairs[0]
    true_pairs = set(truth.true_pairs("A", "B"))
    share = len(true_pairs & set(pair.correspondences)) / max(len(pair.correspondences), 1)
    if fused.decision != "merged":
        return Case(seed, fused.decision, len(pair.correspondences), share, np.nan, np.nan, np.nan)
    landmarks = errors(fused, truth)
    # one landmark a pair, drawn by the pair's seed: those of one map share their errors
    one = landmarks[np.random.default_rng(seed).integers(len(landmarks))]
    displacement = float(np.mean([np.linalg.norm(error) for error, _, common in landmarks if common]))
    error_T12 = pair.T12.array - truth.T12("A", "B").array
    error_T12[2] = se2.wrap(error_T12[2])
    return Case(
        seed,
        fused.decision,
        len(pair.correspondences),
        share,
        displacement,
        nees(error_T12, pair.T12.covariance),
        nees(one[0], one[1]),
    )


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    return [same_floor(seed) for seed in TEST_SEEDS[:PAIRS]]


def in_band(values: list[float], dof: int) -> bool:
    """Whether the mean of n chi-square values lies in its 95 % band, normal approximation of the mean."""
    half = 1.96 * np.sqrt(2 * dof / len(values))
    return bool(dof - half < np.mean(values) < dof + half)


@pytest.mark.xdist_group("same floor")
def test_maps_of_one_floor_merge(cases: list[Case]) -> None:
    assert sum(case.decision == "merged" for case in cases) >= 0.95 * PAIRS


@pytest.mark.xdist_group("same floor")
def test_no_merge_is_wrong(cases: list[Case]) -> None:
    merged = [case for case in cases if case.decision == "merged"]
    assert [case for case in merged if case.true_share < 0.8 or case.displacement > 3.0] == []


@pytest.mark.xdist_group("same floor")
def test_covariance_of_T12_holds(cases: list[Case]) -> None:
    assert in_band([case.nees_T12 for case in cases if case.decision == "merged"], 3)


@pytest.mark.xdist_group("same floor")
def test_covariance_of_landmarks_holds(cases: list[Case]) -> None:
    assert in_band([case.nees_landmark for case in cases if case.decision == "merged"], 2)


@pytest.mark.xdist_group("different floors")
def test_maps_of_different_floors_do_not_merge() -> None:
    decisions = [fuse(simulated_pair(seed, same=False)[:2]).decision for seed in TEST_SEEDS[PAIRS : 2 * PAIRS]]
    assert sum(decision == "merged" for decision in decisions) <= 1
