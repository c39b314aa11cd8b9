"""Landmarks over the hypotheses of an undecided pair, against sums by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import read_map, recordings, se2
from mapfuse.datasets.errors import ConfigError, MapfuseError
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.factors import LandmarkKey, pair_problem
from mapfuse.fusion import fuse, read_fused, write_fused
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.far import shifted
from mapfuse.fusion.mixture import landmark_mixture
from mapfuse.fusion.pairresult import mixture as mixture_of_transforms
from mapfuse.fusion.solve import solve


@pytest.fixture(scope="module")
def undecided():
    """A simulated symmetric floor without compass, which lies on itself in two ways."""
    map1, map2, _ = simulated_pair(9, "symmetric")
    fused = fuse([map1, map2])
    assert fused.decision == "ambiguous"
    return map1, map2, fused


def of_two(fused):
    """The result with its two rivals only, without what else is possible in one case of a million."""
    pair = fused.pairs[0]
    return replace(fused, pairs=(replace(pair, hypotheses=pair.hypotheses[:2]),))


def graphs(map1, map2, pair):
    """The rivals worth a graph, solved here, and their share of the probability."""
    kept = pair.hypotheses[:2]
    total = sum(h.probability for h in kept)
    assert total > 0.999
    solutions = [solve(pair_problem(map1, map2, h.T12, h.correspondences), SolvingConfig()) for h in kept]
    assert not any(solution.rejected for solution in solutions)
    return [(h.probability / total, h, solution) for h, solution in zip(kept, solutions, strict=True)]


def by_hand(solved, names):
    """Mean (2k,) and covariance (2k, 2k) of k landmarks' positions, by second moments less the square of the first."""
    mean, second = 0.0, 0.0
    for w, h, s in solved:
        other = {("A", a): ("B", b) for a, b in h.correspondences} | {("B", b): ("A", a) for a, b in h.correspondences}
        places = [[name] + ([other[name]] if name in other else []) for name in names]
        keys = [[LandmarkKey("AB".index(m), i) for m, i in place] for place in places]
        at = np.concatenate([np.mean([s.poses[key][:2] for key in place], axis=0) for place in keys])
        blocks = [
            [np.mean([[s.covariance(k, l) for k in p] for l in q], axis=(0, 1))[:2, :2] for q in keys] for p in keys
        ]
        own = np.block(blocks)
        for k, p in enumerate(places):
            for l, q in enumerate(places):  # row 10: what each robot means by a landmark, shared where both are one
                shared = len(set(p) & set(q)) / len(p) / len(q)
                own[2 * k : 2 * k + 2, 2 * l : 2 * l + 2] += shared * 0.05**2 / 2 * np.eye(2)
        mean += w * at
        second += w * (own + np.outer(at, at))
    return mean, second - np.outer(mean, mean)


def test_every_landmark_equals_the_sum_by_hand(undecided):
    map1, map2, fused = undecided
    found, solved = landmark_mixture(of_two(fused)), graphs(map1, map2, fused.pairs[0])
    spreads = {"A": [], "B": []}
    for name in found.landmarks:
        mean, covariance = by_hand(solved, [name])
        estimate = found[name]
        assert (estimate.x, estimate.y) == pytest.approx(tuple(mean), abs=1e-4)
        assert np.allclose(estimate.covariance[:2, :2], covariance, rtol=1e-4, atol=1e-5)
        spreads[name[0]].append(np.sqrt(np.trace(estimate.between[:2, :2])))
    # map 1 stays where it is; map 2 is at one end of the floor or at the other
    assert max(spreads["A"]) < 0.5
    assert min(spreads["B"]) > 1.0
    assert max(spreads["B"]) > 10.0


def test_transform_over_the_placements_is_that_of_the_pair(undecided):
    _, _, fused = undecided
    found, pair = landmark_mixture(fused), fused.pairs[0]
    assert found.weights.sum() == pytest.approx(1)
    again = mixture_of_transforms([p.T12 for p in found.placements], found.weights)
    assert np.allclose(again, pair.mixture_covariance, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (-500_000.0, 4_000_000.0)])
def test_where_one_hypothesis_has_all_the_weight_it_is_the_merged_map(offset):
    map1, map2 = (read_map(recordings.path(name)) for name in recordings.SCENES["ground-floor"])
    fused = fuse([shifted(map1, np.array(offset)), map2])
    assert fused.decision == "merged"
    found = fused.landmark_mixture()
    # the others have a weight of next to nothing, and lie some ten metres away
    others = (1 - found.weights.max()) * 100.0**2
    assert others < 0.01
    for landmark in fused.landmarks:
        for name, ids in landmark.sources.items():
            for identifier in ids:
                estimate = found[name, identifier]
                n = min(len(landmark.covariance), len(estimate.covariance))
                assert (estimate.x, estimate.y) == pytest.approx((landmark.x, landmark.y), abs=1e-4)
                assert np.allclose(
                    estimate.covariance[:n, :n], landmark.covariance[:n, :n], rtol=1e-3, atol=1e-4 + others
                )


def test_joint_covariance_equals_the_sum_by_hand(undecided):
    map1, map2, fused = undecided
    found = landmark_mixture(of_two(fused))
    names = [name for name, headed in zip(found.landmarks, found.headed, strict=True) if headed]
    joint = found.joint_covariance(names)
    blocks = np.array([joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(names))])
    assert np.allclose(blocks, [found[name].covariance for name in names], rtol=1e-6, atol=1e-8)
    assert np.linalg.eigvalsh(joint).min() > 0
    some = [names[0], names[len(names) // 2], names[-1]]
    positions = [3 * names.index(name) + axis for name in some for axis in (0, 1)]
    expected = by_hand(graphs(map1, map2, fused.pairs[0]), some)[1]
    assert np.allclose(joint[np.ix_(positions, positions)], expected, rtol=1e-4, atol=1e-4)


def test_without_a_graph_the_map_is_laid_as_it_is(undecided):
    _, map2, fused = undecided
    pair = fused.pairs[0]
    untold = replace(
        pair, hypotheses=tuple(replace(h, correspondences=()) for h in pair.hypotheses), correspondences=()
    )
    found = landmark_mixture(replace(fused, pairs=(untold,)))
    (first, *_) = found.placements
    assert first.solution is None
    rng = np.random.default_rng(5)
    name = map2.ids[3]
    own = first.prepared[1].solution
    key = LandmarkKey(0, name)
    draws = rng.multivariate_normal(own.poses[key], own.covariance(key), 20_000)
    T = rng.multivariate_normal(pair.T12.array, pair.T12.covariance, 20_000)
    laid = se2.compose(T, draws)[:, :2]
    k = found.landmarks.index(("B", name))
    assert np.allclose(first.covariances[k][:2, :2] - 0.05**2 / 2 * np.eye(2), np.cov(laid.T), rtol=0.06, atol=0.01)
    joint = first.joint_covariance([k, 0])
    assert np.allclose(joint[:3, :3], first.covariances[k])
    assert np.allclose(joint[3:, 3:], first.covariances[0])


def test_from_the_other_map_and_from_a_file(undecided, tmp_path):
    map1, map2, fused = undecided
    found = landmark_mixture(fused)
    write_fused(fused, tmp_path / "result.fused.json")
    read = landmark_mixture(read_fused(tmp_path / "result.fused.json"))
    # of two opposite placements the mean heading is what the first one is counted from; positions are not concerned
    swapped, directly = landmark_mixture(fused, ("B", "A")), landmark_mixture(fuse([map2, map1]))
    for name in [("A", map1.ids[0]), ("B", map2.ids[0]), ("B", map2.ids[-1])]:
        one, other = swapped[name], directly[name]
        assert (one.x, one.y) == pytest.approx((other.x, other.y), abs=1e-3)
        assert np.allclose(one.covariance[:2, :2], other.covariance[:2, :2], rtol=1e-3, atol=1e-3)
        assert (read[name].x, read[name].y) == pytest.approx((found[name].x, found[name].y), abs=1e-6)
        assert np.allclose(read[name].covariance, found[name].covariance, rtol=1e-6)


def test_what_it_cannot_be_asked(undecided):
    _, _, fused = undecided
    with pytest.raises(ConfigError, match="the pair A and X in this result; its maps are A, B"):
        landmark_mixture(fused, ("A", "X"))
    with pytest.raises(MapfuseError, match="A isn't embedded"):
        landmark_mixture(replace(fused, sources={}))
    nothing = replace(fused.pairs[0], hypotheses=(), correspondences=())
    with pytest.raises(MapfuseError, match="no hypothesis lays B on A"):
        landmark_mixture(replace(fused, pairs=(nothing,)))
    with pytest.raises(KeyError):
        landmark_mixture(fused)["A", "nowhere"]
