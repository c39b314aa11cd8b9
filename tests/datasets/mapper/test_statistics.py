"""Statistics of the mapper on simulated explorations, associations not given: NEES, doubles, loops, lengths.

Seeds are tuning seeds; the table of test seeds is ``benchmarks/results/mapper-consistency.md``.
"""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

_PATH = Path(__file__).resolve().parents[3] / "benchmarks" / "mapper_consistency.py"
_SPEC = importlib.util.spec_from_file_location("mapper_consistency", _PATH)
bench = importlib.util.module_from_spec(_SPEC)


@pytest.fixture(scope="module", autouse=True)
def _loaded():
    import sys

    sys.modules["mapper_consistency"] = bench
    _SPEC.loader.exec_module(bench)


@pytest.fixture(scope="module")
def loops():
    """Thirty explorations of the loop of 80 m."""
    return [bench.explored("salvatori", 500 + seed) for seed in range(30)]


def test_covariances_are_neither_too_small_nor_too_large(loops):
    # each is a chi-square of about 34 degrees over its degrees, sd 0.24: the mean of 30 has 0.044, bounds 4 of these
    assert 0.8 < np.mean([s.landmarks for s in loops]) < 1.25
    # three degrees: sd 0.82, of the mean 0.15
    assert 0.55 < np.mean([s.pose for s in loops]) < 1.45


def test_what_was_detected_stands_in_the_map_once(loops):
    # 99 % are asked for; of 500 true places 5 would be the mean, 10 allow for chance
    assert sum(s.detected - s.once for s in loops) <= 10


def test_the_loop_closes_to_half_a_metre(loops):
    assert np.median([s.loop for s in loops]) < 0.5
    # where its ends lie on each other: nine in ten do; 21 of 30 allow for chance (0.1 %)
    ends = np.array([s.ends for s in loops])
    assert np.all(np.isfinite(ends))
    assert np.sum(ends <= 0.5) >= 21


def test_a_whole_floor_with_loops_is_mapped_once_and_consistently():
    scores = [bench.explored("irregular", 700 + seed) for seed in range(6)]
    assert sum(s.detected - s.once for s in scores) <= 4
    # about 60 degrees each: sd 0.18, of the mean of six 0.075
    assert 0.7 < np.mean([s.landmarks for s in scores]) < 1.35
