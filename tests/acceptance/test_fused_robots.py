"""Maps of five real robots as one, against the survey of their arena: better than most robots alone.

The other sets, and what other methods make of the same pairs, are in ``benchmarks/compare_real.py``.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets.datum import in_own_datum

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
try:
    from compare_real import arena
finally:
    sys.path.pop(0)


@pytest.fixture(scope="module")
def set_6(shared_data):
    return arena(shared_data / "mrclam", 6)


def test_five_maps_as_one_are_nearer_to_the_survey_than_the_median_one(set_6):
    fused, rms, mixed = set_6.fused([in_own_datum(m) for m in set_6.maps])
    assert fused.decision == "merged"
    assert len(fused.landmarks) == 15
    assert mixed == 0
    assert rms <= 0.10
    assert rms < np.median(set_6.alone())


def test_names_and_order_give_nothing_away(set_6):
    for m in set_6.maps:
        tubes = [int(set_6.truth.landmarks[m.name][i]) for i in m.ids]
        assert sorted(tubes) == list(range(6, 21))
        assert tubes != sorted(tubes)
        assert set(m.types) == {"tube"}
        assert all(not landmark.links for landmark in m.landmarks)
