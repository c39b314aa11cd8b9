"""The core, on pairs of simulated maps: merged where they overlap, never wrongly, with covariances that hold.

Test seeds only; every parameter was chosen on `TUNING_SEEDS`. The simulator shares no code with the factors, and
associations are not given. ``benchmarks/consistency.py`` does the same for many blocks of 200 pairs, and its committed
table shows how the means of blocks scatter: this is the second block.
"""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets.simulation.pairs import TEST_SEEDS, simulated_pair
from mapfuse.fusion import fuse
from mapfuse.fusion.score import PairScore, score_pair

PAIRS = 200
SEEDS = TEST_SEEDS[PAIRS : 2 * PAIRS]

pytestmark = pytest.mark.statistics


@pytest.fixture(scope="module")
def scores() -> dict[int, PairScore]:
    found = {}
    for seed in SEEDS:
        map1, map2, truth = simulated_pair(seed, min_common=8)
        found[seed] = score_pair(fuse([map1, map2]), truth)
    return found


def in_band(values: list[float], dof: int) -> bool:
    """Whether the mean of n chi-square values lies in its 95 % band, by the normal approximation of the mean."""
    half = 1.96 * np.sqrt(2 * dof / len(values))
    return bool(dof - half < np.mean(values) < dof + half)


@pytest.mark.xdist_group("same floor")
def test_maps_of_one_floor_merge(scores: dict[int, PairScore]) -> None:
    assert sum(score.decision == "merged" for score in scores.values()) >= 0.95 * PAIRS


@pytest.mark.xdist_group("same floor")
def test_no_merge_is_wrong(scores: dict[int, PairScore]) -> None:
    assert {seed: score for seed, score in scores.items() if score.merged_wrongly} == {}


@pytest.mark.xdist_group("same floor")
def test_covariance_of_T12_holds(scores: dict[int, PairScore]) -> None:
    assert in_band([score.nees_T12 for score in scores.values() if score.decision == "merged"], 3)


@pytest.mark.xdist_group("same floor")
def test_covariance_of_landmarks_holds(scores: dict[int, PairScore]) -> None:
    # one landmark a pair, drawn by the pair's seed: those of one map share their errors
    merged = {seed: score for seed, score in scores.items() if score.decision == "merged"}
    assert in_band([np.random.default_rng(seed).choice(s.nees_landmarks) for seed, s in merged.items()], 2)


@pytest.mark.xdist_group("different floors")
def test_maps_of_different_floors_do_not_merge() -> None:
    decisions = [fuse(simulated_pair(seed, same=False)[:2]).decision for seed in SEEDS]
    assert sum(decision == "merged" for decision in decisions) <= 1
