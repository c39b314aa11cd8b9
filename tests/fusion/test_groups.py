"""`fuse` of more than two maps: groups, cycles, order, and the joint graph against solving the maps one by one."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Noise
from mapfuse.datasets.simulation import (
    MILKA,
    VESPUCCI,
    explore,
    irregular_floor,
    record,
    simulated_pair,
    truth_of,
)
from mapfuse.factors import LandmarkKey, build_problem
from mapfuse.factors.correspondence import SAME_PLACE, Correspondence
from mapfuse.fusion import fuse, read_fused, write_fused

#: One worker fuses the maps that all of these look at.
pytestmark = pytest.mark.xdist_group("groups")


def recorded(seed, floors):
    """One map of each of ``floors`` (repeated for several maps), with the truth of all; tuning seeds."""
    rng = np.random.default_rng(seed)
    drawn = [irregular_floor(rng) for _ in range(max(floors) + 1)]
    drawn = [floor.moved((500.0 * k, 0.0, 0.0), f"b{k}-") for k, floor in enumerate(drawn)]
    robots = (VESPUCCI, MILKA)
    recordings = [
        record(drawn[f], explore(drawn[f], rng, 0.8), robots[k % 2], rng, f"M{k}") for k, f in enumerate(floors)
    ]
    return [r.map for r in recordings], truth_of(recordings, [drawn[f] for f in floors])


@pytest.fixture(scope="module")
def three_and_one():
    """Three maps of one floor, one of another, fused."""
    maps, truth = recorded(41, (0, 0, 1, 0))
    return maps, truth, fuse(maps)


def test_maps_of_one_floor_are_one_group_and_others_stay_alone(three_and_one):
    maps, truth, fused = three_and_one
    assert fused.decision == "partial"
    assert fused.groups == (("M0", "M1", "M3"), ("M2",))
    assert [fused.frames[m.name].group for m in maps] == [0, 0, 1, 0]
    assert [pair.maps for pair in fused.pairs] == list(combinations([m.name for m in maps], 2))
    assert 0.99 < fused.probability <= 1
    for name in ("M1", "M3"):
        T = fused.frames[name].T
        off = T.array - truth.T12("M0", name).array
        off[2] = se2.wrap(off[2])
        assert off @ np.linalg.solve(T.covariance, off) < 16.3  # chi-square, 3 degrees of freedom, 99.9 %


def test_every_recorded_landmark_is_in_one_place_and_each_map_at_most_once_in_it(three_and_one):
    maps, truth, fused = three_and_one
    listed = [(name, i) for landmark in fused.landmarks for name, ids in landmark.sources.items() for i in ids]
    assert sorted(listed) == sorted((m.name, i) for m in maps for i in m.ids)
    assert all(len(ids) == 1 for landmark in fused.landmarks for ids in landmark.sources.values())
    in_three = [l for l in fused.landmarks if len(l.sources) == 3]
    assert len(in_three) >= 5
    for landmark in in_three:
        assert len({truth.landmarks[name][i] for name, (i,) in landmark.sources.items()}) == 1
        assert landmark.existence > 0.99


def test_three_records_say_more_than_two(three_and_one):
    maps, _, fused = three_and_one
    two = fuse([maps[0], maps[1]])
    by_source = {l.sources["M0"]: l for l in two.landmarks if len(l.sources) == 2}
    shared = [l for l in fused.landmarks if len(l.sources) == 3 and l.sources["M0"] in by_source]
    assert len(shared) >= 5
    for landmark in shared:
        before = by_source[landmark.sources["M0"]].covariance[:2, :2]
        assert np.linalg.eigvalsh(before - landmark.covariance[:2, :2]).min() > 0


def test_the_order_of_the_maps_changes_nothing_but_the_reference(three_and_one):
    maps, _, fused = three_and_one
    other = fuse([maps[3], maps[2], maps[0], maps[1]])
    assert other.groups == (("M3", "M0", "M1"), ("M2",))
    assert other.probability == fused.probability
    sources = {tuple(sorted(l.sources.items())): l for l in other.landmarks}
    T = fused.frames["M3"].T
    for landmark in fused.landmarks:
        twin = sources[tuple(sorted(landmark.sources.items()))]
        assert twin.existence == pytest.approx(landmark.existence)
        if landmark.group == 0:
            # the weak prior that keeps a graph from floating is centred on another map then: some 1e-5 m
            np.testing.assert_allclose(T.apply([twin.x, twin.y]), [landmark.x, landmark.y], atol=1e-4)


def test_a_result_of_many_maps_survives_its_file(three_and_one, tmp_path):
    _, _, fused = three_and_one
    path = tmp_path / "many.fused.json"
    write_fused(fused, path)
    assert read_fused(path) == fused


def test_a_group_as_a_map_carries_all_its_maps(three_and_one):
    _, _, fused = three_and_one
    again = fused.to_map(0)
    assert len(again) == sum(l.group == 0 for l in fused.landmarks)
    assert again.joint_covariance is not None


def surveyed(name, at, sigma):
    """A map of trees, each position known to ``sigma`` [m] by itself."""
    trees = tuple(Landmark(f"t{k}", "tree", *xy, covariance=np.eye(2) * sigma**2) for k, xy in enumerate(at))
    return LandmarkMap(name, trees, noise=Noise(position_sigma=sigma))


def test_differences_of_n_robots_weigh_what_n_minus_one_of_them_do():
    """All pairs of n records against n ideas of one unknown place, each half of row 10 off: sum |r_k - mean|^2."""
    rng = np.random.default_rng(5)
    maps = [surveyed(name, [(0.0, 0.0)], 1.0) for name in "ABCD"]
    matches = [(LandmarkKey(a, "t0"), LandmarkKey(b, "t0")) for a, b in combinations(range(4), 2)]
    problem = build_problem(maps, [np.zeros(3)] * 4, matches)
    records = rng.normal(0, 0.1, (4, 2))
    poses = {**problem.initial} | {LandmarkKey(k, "t0"): np.array([*records[k], 0.0]) for k in range(4)}
    errors = sum(m.error(poses) for m in problem.of_kind(Correspondence))
    about_the_mean = np.sum((records - records.mean(axis=0)) ** 2) / (SAME_PLACE**2 / 2)
    assert errors == pytest.approx(about_the_mean / 2)


@pytest.mark.parametrize("seed", [235_060, 235_078, 235_271])
def test_two_maps_alone_are_merged_by_their_own_answer_only(seed):
    # tuning seeds of one pitch with 5 to 7 common landmarks: variants of one answer together would pass the threshold
    rng, common = np.random.default_rng([seed, 0]), 99
    while common > 7:
        map1, map2, truth = simulated_pair(rng, "alike", min_common=5, share=(0.2, 0.5), robots=(VESPUCCI, MILKA))
        common = len(truth.true_pairs("A", "B"))
    (pair,) = fuse([map1, map2]).pairs
    assert pair.decision == "ambiguous"
    assert 0.98 < pair.probability < 0.99
    assert "the maps around it" not in pair.reason
