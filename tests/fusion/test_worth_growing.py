"""Which proposals are grown, and from what: those that are not hopelessly behind, from all matches where one fails."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.datasets.transform import Transform
from mapfuse.fusion import fuse
from mapfuse.fusion.config import FuseConfig
from mapfuse.fusion.growth import grow
from mapfuse.fusion.pair import HOPELESS, SPEAKS, _worth_growing, grow_all
from mapfuse.fusion.prepared import prepare
from mapfuse.matching import MatchingConfig, propose
from mapfuse.matching.hypothesis import Hypothesis

CONFIG = FuseConfig()
PROPOSED = [
    Hypothesis(Transform(float(k), 0.0, 0.0), 5, score=score)
    for k, score in enumerate((20.0, 21.0 - HOPELESS, 20.0 - HOPELESS, -70.0))
]


def one(*links):
    return prepare(LandmarkMap("m", (Landmark("c", "corner", 0.0, 0.0, links=links),)), CONFIG.solving)


def test_what_is_far_behind_the_best_is_not_grown():
    headed = one(Link("open", 0.0))
    assert _worth_growing(PROPOSED, headed, headed, CONFIG) == PROPOSED[:2]
    assert _worth_growing([], headed, headed, CONFIG) == []


def test_what_speaks_for_itself_is_grown_however_far_behind():
    # the image of a far better placement decides whether that can be told
    headed = one(Link("open", 0.0))
    scores = (100.0, 1.0 + SPEAKS, SPEAKS)
    proposed = [Hypothesis(Transform(float(k), 0.0, 0.0), 5, score=score) for k, score in enumerate(scores)]
    assert _worth_growing(proposed, headed, headed, CONFIG) == proposed[:2]


def test_an_image_of_the_best_far_behind_it_is_a_rival():
    # 5 matches against 13, 34 nats behind, but the building is the same from either end
    map1, map2, _ = simulated_pair(2, "symmetric")
    fused = fuse([map1, map2])
    assert fused.decision == "ambiguous"
    assert sorted(len(h.correspondences) for h in fused.pairs[0].hypotheses[:2]) == [5, 13]


def test_scores_that_are_no_nats_cut_nothing():
    headed, bare = one(Link("open", 0.0)), one()
    paper = replace(CONFIG, matching=MatchingConfig(mode="paper"))
    assert _worth_growing(PROPOSED, headed, headed, paper) == PROPOSED
    assert _worth_growing(PROPOSED, headed, bare, CONFIG) == PROPOSED


@pytest.mark.parametrize("seed", [31, 32, 33])
def test_a_seed_whose_heading_is_off_does_not_lose_the_place(seed):
    # what is proposed by a pair whose heading is 0.5 rad off grows from all that was proposed, where not from the pair
    map1, map2, _ = simulated_pair(seed)
    best = propose(map1, map2)[0]
    lost = 0
    for a, b in best.correspondences:
        links = tuple(replace(link, heading=float(se2.wrap(link.heading + 0.5))) for link in map2[b].links)
        bent = map2.replace(landmarks=tuple(replace(l, links=links) if l.id == b else l for l in map2.landmarks))
        m1, m2 = prepare(map1, CONFIG.solving), prepare(bent, CONFIG.solving)
        if not m2.headed[map2.index_from_id[b]] or not m1.headed[map1.index_from_id[a]]:
            continue
        hypothesis = replace(best, seed=((a, b),))
        pair = (map1.index_from_id[a], map2.index_from_id[b])
        lost += len(grow(m1, m2, best.T12.array, (pair,), CONFIG.solving).pairs) < best.count / 2
        assert max(len(g.pairs) for g in grow_all(m1, m2, [hypothesis], CONFIG.solving)) >= 0.7 * best.count
    assert lost
