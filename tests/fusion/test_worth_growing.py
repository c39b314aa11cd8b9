"""Which proposals are grown, and from what: those that are not hopelessly behind, from all matches where one fails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.datasets.transform import Transform
from mapfuse.fusion import fuse
from mapfuse.fusion.config import FuseConfig
from mapfuse.fusion.elastic import Joined
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


@pytest.mark.parametrize(("seed", "kind"), [(41, "irregular"), (42, "symmetric"), (43, "alike")])
def test_growing_all_at_once_is_growing_one_after_the_other(seed, kind):
    map1, map2, _ = simulated_pair(seed, kind)
    m1, m2 = prepare(map1, CONFIG.solving), prepare(map2, CONFIG.solving)
    # each proposal twice, the second time the other way about: the same answer, unless it is turned
    proposed = []
    for hypothesis in propose(m1.straightened, m2.straightened):
        turned = replace(hypothesis.T12, theta=float(se2.wrap(hypothesis.T12.theta + np.pi)))
        proposed += [hypothesis, hypothesis, replace(hypothesis, T12=turned)]

    def places(pairs):
        return tuple((m1.map.index_from_id[a], m2.map.index_from_id[b]) for a, b in pairs)

    expected, explained = [], []
    for h in proposed:
        seed_pairs, turn = set(places(h.seed)), h.T12.theta
        if not all(m1.headed[i] and m2.headed[j] for i, j in seed_pairs):
            seed_pairs = set(places(h.correspondences))
        if any(seed_pairs <= pairs and abs(se2.wrap(turn - other)) < 0.5 for pairs, other in explained):
            continue
        grown = [grow(m1, m2, h.T12.array, tuple(seed_pairs), CONFIG.solving)]
        if len(grown[0].pairs) < h.count and h.count >= 4:
            grown.append(grow(m1, m2, h.T12.array, places(h.correspondences), CONFIG.solving))
        explained += [(growth.pairs | seed_pairs, growth.joined.T12[2]) for growth in grown]
        expected += grown
    expected = [growth for growth in expected if growth.places_map2]
    found = grow_all(m1, m2, proposed, CONFIG.solving)
    assert [(g.pairs, g.rounds) for g in found] == [(g.pairs, g.rounds) for g in expected]
    assert 10 < len(found) < len(proposed)
    for one, other in zip(found, expected, strict=True):
        # what was worked out together with all others is what each gives alone, worked out anew
        anew = Joined(m1, m2, one.joined.T0, one.i, one.j)
        for joined in (other.joined, anew):
            np.testing.assert_allclose(one.joined.T12, joined.T12, rtol=0, atol=1e-10)
            np.testing.assert_allclose(one.joined.T12_covariance, joined.T12_covariance, rtol=0, atol=1e-10)
            np.testing.assert_allclose(one.joined.covariance, joined.covariance, rtol=1e-10, atol=1e-9)
            np.testing.assert_allclose(one.joined.r, joined.r, rtol=0, atol=1e-9)
            for at, there in zip(one.joined.corrected(), joined.corrected(), strict=True):
                np.testing.assert_allclose(at, there, rtol=0, atol=1e-9)
            for name in ("coincide", "contradict", "shift", "variance"):
                np.testing.assert_allclose(
                    getattr(one.joined.arms, name), getattr(joined.arms, name), rtol=0, atol=1e-9
                )
