"""Which proposals are grown: those that are not hopelessly behind the best one."""

from __future__ import annotations

from dataclasses import replace

from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.transform import Transform
from mapfuse.fusion.config import FuseConfig
from mapfuse.fusion.pair import HOPELESS, _worth_growing
from mapfuse.fusion.prepared import prepare
from mapfuse.matching import MatchingConfig
from mapfuse.matching.hypothesis import Hypothesis

CONFIG = FuseConfig()
PROPOSED = [
    Hypothesis(Transform(float(k), 0.0, 0.0), 5, score=score)
    for k, score in enumerate((60.0, 20.0, 60 - HOPELESS, -70.0))
]


def one(*links):
    return prepare(LandmarkMap("m", (Landmark("c", "corner", 0.0, 0.0, links=links),)), CONFIG.solving)


def test_what_is_far_behind_the_best_is_not_grown():
    headed = one(Link("open", 0.0))
    assert _worth_growing(PROPOSED, headed, headed, CONFIG) == PROPOSED[:2]
    assert _worth_growing([], headed, headed, CONFIG) == []


def test_scores_that_are_no_nats_cut_nothing():
    headed, bare = one(Link("open", 0.0)), one()
    paper = replace(CONFIG, matching=MatchingConfig(mode="paper"))
    assert _worth_growing(PROPOSED, headed, headed, paper) == PROPOSED
    assert _worth_growing(PROPOSED, headed, bare, CONFIG) == PROPOSED
