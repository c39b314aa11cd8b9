"""`pair_result`: which hypotheses of a pair are told among many maps."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets.transform import Transform
from mapfuse.fusion.consistent import Choice
from mapfuse.fusion.evidence import Terms
from mapfuse.fusion.pairresult import NEGLIGIBLE, TOLD, pair_result
from mapfuse.fusion.pairwise import Candidate, Comparison

#: Probabilities of the hypotheses, best first: the fifth and sixth can't be right, and nor can the third.
PROBABILITIES = np.array([0.9, 0.0999, 1e-12, 1e-6, 1e-10, 1e-15])
IDS = (("a",), ("b",))


@pytest.fixture
def comparison():
    candidates = tuple(
        Candidate(Transform(10.0 * k, 0.0, 0.0, 0.01 * np.eye(3)), ((0, 0),), Terms(matches=5.0 - k))
        for k in range(len(PROBABILITIES))
    )
    none = 1 - float(PROBABILITIES.sum())
    rates = np.ones(1)
    weights = np.log(PROBABILITIES)
    return Comparison(("A", "B"), candidates, PROBABILITIES, weights, none, "ambiguous", ("why", "why"), rates, rates)


def test_what_cannot_be_right_is_left_out_among_many_maps_but_for_the_best_few(comparison):
    alone = Choice((("A",), ("B",)), {}, {}, {}, (1.0, 1.0))
    all_of_them = pair_result(comparison, alone, IDS, swapped=False)
    told = pair_result(comparison, alone, IDS, swapped=False, least=NEGLIGIBLE)
    assert [h.T12.x for h in all_of_them.hypotheses] == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]
    assert [h.T12.x for h in told.hypotheses] == [0.0, 10.0, 20.0, 30.0]
    assert TOLD == 3
    # the file's rule: probabilities sum to 1 within 1e-6, the same covariance over all of them
    assert told.no_overlap_probability + sum(h.probability for h in told.hypotheses) == pytest.approx(1.0, abs=1e-8)
    np.testing.assert_array_equal(told.mixture_covariance, all_of_them.mixture_covariance)


def test_the_one_that_the_group_chose_is_told_however_improbable_alone(comparison):
    together = Choice((("A", "B"),), {}, {("A", "B"): 5}, {("A", "B"): ("A", "C", "B")}, (0.999,))
    told = pair_result(comparison, together, IDS, swapped=True, least=NEGLIGIBLE)
    assert told.hypotheses[0].T12.x == pytest.approx(-50.0)
    assert (told.decision, told.probability) == ("merged", 0.999)
