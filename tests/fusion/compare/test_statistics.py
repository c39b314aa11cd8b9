"""Intervals and paired tests: hand-made cases, coverage by simulation, and the same seed, the same digits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.fusion.compare.evaluation import AgainstTruth, Evaluation
from mapfuse.fusion.compare.method import Merge
from mapfuse.fusion.compare.statistics import interval, paired, summaries


def test_interval_of_a_mean_covers_it_as_often_as_it_says():
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(200):
        found = interval(rng.normal(3.0, 1.0, 40).tolist())
        inside += found.low <= 3.0 <= found.high
    # of 200 at 95 %, less 1 or 2 % that the percentile bootstrap lacks at 40: 5 sigma below 0.93 is 0.84
    assert 0.84 * 200 <= inside <= 199


def test_the_same_seed_gives_the_same_interval_and_another_seed_hardly_another():
    values = np.random.default_rng(0).exponential(1.0, 60).tolist()
    one, again, other = (interval(values, np.median, seed) for seed in (5, 5, 6))
    assert one == again
    assert one.value == other.value
    assert (one.low, one.high) == pytest.approx((other.low, other.high), rel=0.2)


def test_what_is_not_known_is_left_out():
    assert interval([None, None]) is None
    assert interval([None, 2.0]) == interval([2.0])
    assert interval([2.0]).low == interval([2.0]).high == 2.0


def evaluation(k, method, rms, decision="merged", right=10):
    truth = AgainstTruth(right, 10, rms, 0.0, rms, rms, rms, 0.0, 0, 0, 0, 0) if decision == "merged" else (
        AgainstTruth(right, 10, 1.0, 0.0, None, None, None, None, 0, 0, None, None))  # fmt: skip
    matches = tuple((f"a{n}", f"b{n}") for n in range(10))
    return Evaluation(("A", f"B{k}"), method, 1, 1, Merge(decision, None, matches), 0, 0, 0.1, truth)


def test_ratio_is_the_median_over_pairs_and_p_small_where_all_differ_alike():
    found = [evaluation(k, m, f * (k + 1)) for k in range(12) for m, f in (("x", 0.1), ("y", 0.05))]
    by_metric = {t.metric: t for t in paired(found, "x", "y")}
    assert by_metric["rms"].ratio.value == pytest.approx(0.5)
    assert by_metric["rms"].n == 12
    assert by_metric["rms"].p == pytest.approx(2 / 2**12)  # all twelve signs alike, both sides
    back = {t.metric: t for t in paired(found, "y", "x")}
    assert back["rms"].ratio.value == pytest.approx(2.0)


def test_equal_methods_have_no_p():
    found = [evaluation(k, m, 0.1) for k in range(5) for m in ("x", "y")]
    assert all(t.p is None for t in paired(found, "x", "y"))


def test_pairs_that_one_method_did_not_merge_are_in_no_ratio_but_in_the_sign_test():
    found = [evaluation(k, "x", 0.2) for k in range(8)]
    found += [evaluation(k, "y", 0.1, "merged" if k < 2 else "ambiguous") for k in range(8)]
    by_metric = {t.metric: t for t in paired(found, "x", "y")}
    assert by_metric["rms"].n == 2
    assert by_metric["merged rightly"].n == 8
    assert by_metric["merged rightly"].p == pytest.approx(2 * 0.5**6)


def test_summary_counts_failures_merges_and_wrong_ones():
    found = [evaluation(0, "x", 0.2), evaluation(1, "x", 0.4), evaluation(2, "x", 0.1, right=3)]
    failed = replace(evaluation(3, "x", 0.1), merge=None, truth=None, error="why")
    (s,) = summaries([*found, failed])
    assert (s.pairs, s.failed, s.merged, s.wrong) == (3, 1, 3, 1)
    assert s.correctness.value == pytest.approx((1 + 1 + 0.3) / 3)
    assert s.rms.value == pytest.approx(0.2)
