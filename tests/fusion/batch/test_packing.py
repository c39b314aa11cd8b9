"""A comparison survives being packed, whole."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from mapfuse.datasets.simulation import simulated_pair
from mapfuse.fusion import FuseConfig
from mapfuse.fusion.batch.packing import comparison_bytes, comparison_from_bytes
from mapfuse.fusion.pairwise import Candidate, Comparison, compare
from mapfuse.fusion.prepared import prepare


def test_a_comparison_is_the_same_after_packing():
    config = FuseConfig()
    one, two = (prepare(m, config.solving) for m in simulated_pair(7)[:2])
    before = compare(one, two, config)
    after = comparison_from_bytes(comparison_bytes(before))
    assert any(any(c.through1) or any(c.through2) for c in before.candidates)
    for field in fields(Comparison):
        if field.name != "candidates":
            np.testing.assert_array_equal(getattr(after, field.name), getattr(before, field.name))
    for a, b in zip(after.candidates, before.candidates, strict=True):
        for field in fields(Candidate):
            assert getattr(a, field.name) == getattr(b, field.name), field.name
    assert comparison_bytes(after) == comparison_bytes(before)
