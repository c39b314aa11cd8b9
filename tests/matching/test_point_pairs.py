"""Landmarks without heading: known transformations are found, never a mirrored one, and odd maps get an answer."""

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Noise
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.point_pairs import PointPairConfig, match_point_pairs


def points_map(name, xy, types=None, sigma=0.2):
    types = ["tree"] * len(xy) if types is None else types
    marks = tuple(
        Landmark(f"{name}{k}", t, float(x), float(y)) for k, ((x, y), t) in enumerate(zip(xy, types, strict=True))
    )
    return LandmarkMap(name, marks, noise=Noise(position_sigma=sigma))


def two_maps(seed, n=40, common=0.6, sigma=0.2, labels=1):
    """Maps of n points, a share of them in common, shuffled; T12 and the true pairs of ids."""
    rng = np.random.default_rng(seed)
    extent = 6 * np.sqrt(n)
    n_common = round(n * common)
    T12 = rng.uniform([-50, -50, -np.pi], [50, 50, np.pi])
    shared, words = rng.uniform(0, extent, (n_common, 2)), np.array([f"kind {k}" for k in range(labels)])
    shared_types = words[rng.integers(labels, size=n_common)]
    maps, places = [], []
    for name, T in (("a", np.zeros(3)), ("b", T12)):
        own = rng.uniform(0, extent, (n - n_common, 2))
        xy = se2.transform(se2.inverse(T), np.vstack([shared, own])) + rng.normal(0, sigma, (n, 2))
        types = np.concatenate([shared_types, words[rng.integers(labels, size=n - n_common)]])
        order = rng.permutation(n)
        maps.append(points_map(name, xy[order], types[order].tolist(), sigma))
        places.append(np.argsort(order)[:n_common])
    return *maps, T12, {(f"a{i}", f"b{j}") for i, j in zip(*places, strict=True)}


def displacement(hypothesis, T12, map2):
    """Mean distance [m] between where the hypothesis and the truth take map 2's landmarks."""
    return float(np.hypot(*(hypothesis.T12.apply(map2.positions) - se2.transform(T12, map2.positions)).T).mean())


@pytest.mark.parametrize(
    ("n", "common", "labels"), [(8, 0.8, 1), (20, 0.6, 1), (40, 0.5, 1), (40, 0.3, 4), (150, 0.5, 1)]
)
def test_finds_the_truth_first(n, common, labels):
    for seed in range(4):
        map1, map2, T12, true_pairs = two_maps(seed, n, common, labels=labels)
        best = match_point_pairs(map1, map2)[0]
        assert displacement(best, T12, map2) < 0.5
        assert len(true_pairs & set(best.correspondences)) > 0.8 * len(true_pairs)


def test_unlabelled_points_of_three_hundred():
    map1, map2, T12, _ = two_maps(9, n=300, common=0.5, sigma=0.3)
    assert displacement(match_point_pairs(map1, map2)[0], T12, map2) < 0.5


def test_hypotheses_are_what_they_say():
    map1, map2, _, _ = two_maps(3)
    found = match_point_pairs(map1, map2, MatchingConfig(max_hypotheses=9))
    assert 1 < len(found) <= 9
    assert [h.score for h in found] == sorted((h.score for h in found), reverse=True)
    for h in found:
        assert h.count == len(h.correspondences) >= 2
        assert len({a for a, _ in h.correspondences}) == len({b for _, b in h.correspondences}) == h.count
        ((a, b),) = h.seed
        assert a in map1.index_from_id
        assert b in map2.index_from_id
        for a, b in h.correspondences:
            off = h.T12.apply(map2.positions[map2.index_from_id[b]]) - map1.positions[map1.index_from_id[a]]
            assert np.hypot(*off) < 2 * 3 * np.hypot(0.2, 0.2)


def test_modes_are_distinct():
    map1, map2, _, _ = two_maps(4)
    found = match_point_pairs(map1, map2)
    for k, h in enumerate(found):
        for other in found[:k]:
            apart = h.T12.apply(map2.positions) - other.T12.apply(map2.positions)
            assert np.sqrt(np.mean(np.sum(apart**2, axis=1))) > 0.5


@pytest.mark.parametrize("seed", range(3))
def test_a_mirrored_map_is_never_laid_over(seed):
    """A mirrored copy has all the distances, so that only proper rotations keep it from matching whole."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 30, (25, 2))
    one, mirrored = points_map("a", xy), points_map("b", xy * [1, -1])
    right = match_point_pairs(one, points_map("b", xy))[0]
    assert right.count == 25
    for h in match_point_pairs(one, mirrored):
        assert h.count < 15
        assert h.score < right.score / 3


def test_labels_count():
    """Two places of one shape; only the labels tell which is meant."""
    shape = np.array([[0, 0], [6, 1], [2, 7], [9, 5], [5, 12]], dtype=float)
    map1 = points_map(
        "a", np.vstack([shape, shape + np.array([40, 0])]), ["tree"] * 5 + ["tree", "lamp", "tree", "lamp", "lamp"]
    )
    map2 = points_map("b", shape, ["tree", "lamp", "tree", "lamp", "lamp"])
    best = match_point_pairs(map1, map2)[0]
    assert best.T12.array == pytest.approx([40, 0, 0], abs=0.1)
    assert best.correspondences == tuple((f"a{k + 5}", f"b{k}") for k in range(5))
    blind = match_point_pairs(map1, map2, MatchingConfig(use_h1=False))
    assert {round(h.T12.x / 40) for h in blind[:2]} == {0, 1}


def test_swapped_maps_give_the_inverse():
    map1, map2, _, _ = two_maps(5)
    there, back = match_point_pairs(map1, map2)[0], match_point_pairs(map2, map1)[0]
    assert back.T12.array == pytest.approx(there.T12.inverse().array, abs=0.05)
    assert {(b, a) for a, b in back.correspondences} == set(there.correspondences)
    assert back.score == pytest.approx(there.score, abs=1.0)


def test_frames_and_the_order_of_landmarks_change_nothing():
    map1, map2, _, _ = two_maps(6)
    rng = np.random.default_rng(0)
    M = np.array([13.0, -40.0, 2.1])
    moved = map2.replace(
        landmarks=tuple(
            Landmark(l.id, l.type, *se2.transform(M, [l.x, l.y]))
            for l in (map2.landmarks[k] for k in rng.permutation(40))
        )
    )
    first, second = match_point_pairs(map1, map2)[0], match_point_pairs(map1, moved)[0]
    assert se2.compose(second.T12.array, M) == pytest.approx(first.T12.array, abs=1e-6)
    assert set(first.correspondences) == set(second.correspondences)
    assert first.score == pytest.approx(second.score, abs=1e-6)


def test_same_input_same_output():
    map1, map2, _, _ = two_maps(7)
    assert match_point_pairs(map1, map2) == match_point_pairs(map1, map2)


def test_bent_map_is_found_with_most_of_its_landmarks():
    """A drive that turns too much by 3 degrees over the map, as a gyroscope's drift makes it."""
    map1, map2, T12, _ = two_maps(8, n=60, common=0.8)
    centre = map2.positions.mean(axis=0)
    off = map2.positions - centre
    bend = np.deg2rad(3) * off[:, 0] / np.abs(off[:, 0]).max()
    bent = centre + np.einsum("nij,nj->ni", se2.rotation(bend), off)
    best = match_point_pairs(map1, points_map("b", bent, map2.types))[0]
    assert displacement(best, T12, map2) < 1.0
    assert best.count > 35


def test_noise_stated_too_large_is_noticed():
    map1, map2, T12, true_pairs = two_maps(2, n=30, common=0.7, sigma=0.1)
    loose1, loose2 = (m.replace(noise=Noise(position_sigma=0.5)) for m in (map1, map2))
    best = match_point_pairs(loose1, loose2)[0]
    assert displacement(best, T12, map2) < 0.3
    assert true_pairs <= set(best.correspondences)


def test_covariances_of_landmarks_replace_the_stated_noise():
    """Both tell that positions are good to centimetres, so that landmarks half a metre off don't match."""
    map1, map2, _, _ = two_maps(1, n=12, common=1.0, sigma=0.01)
    strayed = map2.landmarks[0]
    marks = (Landmark(strayed.id, strayed.type, strayed.x + 0.5, strayed.y), *map2.landmarks[1:])
    stated = Noise(position_sigma=2.0)
    tight = [
        LandmarkMap(
            m.name,
            tuple(Landmark(l.id, l.type, l.x, l.y, covariance=1e-4 * np.eye(2)) for l in landmarks),
            noise=stated,
        )
        for m, landmarks in ((map1, map1.landmarks), (map2, marks))
    ]
    joint = [
        LandmarkMap(m.name, landmarks, noise=stated, joint_covariance=JointCovariance(m.ids, 2, 1e-4 * np.eye(24)))
        for m, landmarks in ((map1, map1.landmarks), (map2, marks))
    ]
    for one, two in (tight, joint):
        best = match_point_pairs(one, two)[0]
        assert best.count == 11
        assert strayed.id not in {b for _, b in best.correspondences}


# ---------------------------------------------------------------------------------------------- odd maps
def test_too_few_landmarks_have_no_answer():
    rich = points_map("a", np.random.default_rng(0).uniform(0, 20, (9, 2)))
    for poor in (points_map("b", np.zeros((0, 2))), points_map("b", np.zeros((1, 2)))):
        assert match_point_pairs(rich, poor) == []
        assert match_point_pairs(poor, rich) == []


def test_no_common_labels_have_no_answer():
    xy = np.random.default_rng(0).uniform(0, 20, (9, 2))
    assert match_point_pairs(points_map("a", xy), points_map("b", xy, ["lamp"] * 9)) == []


def test_all_at_one_spot_has_no_rotation():
    heap = points_map("a", np.full((6, 2), 3.0))
    assert match_point_pairs(heap, heap) == []


def test_duplicates_at_one_spot_are_matched_once_each():
    xy = np.random.default_rng(1).uniform(0, 25, (10, 2))
    doubled = points_map("a", np.vstack([xy, xy[:4]]))
    best = match_point_pairs(doubled, points_map("b", xy))[0]
    assert best.count == 10
    assert best.T12.array == pytest.approx([0, 0, 0], abs=1e-6)


def test_collinear_points_give_finite_answers_and_the_right_one():
    x = np.array([0.0, 4.0, 11.0, 13.5, 21.0, 30.0])
    line = np.stack([x, 0 * x], axis=1)
    found = match_point_pairs(points_map("a", line), points_map("b", line - [5.0, 0.0]))
    assert all(np.isfinite(h.T12.array).all() and np.isfinite(h.score) for h in found)
    assert found[0].T12.array == pytest.approx([5, 0, 0], abs=1e-6)
    assert found[0].count == 6


def test_regular_row_lists_its_shifts():
    """Ten trees 5 m apart, and the same row seen backwards: any shift of the row fits."""
    row = np.stack([5.0 * np.arange(10), np.zeros(10)], axis=1)
    found = match_point_pairs(points_map("a", row), points_map("b", row))
    assert found[0].count == 10
    shifts = {(round(h.T12.x / 5), round(abs(h.T12.theta) / np.pi)) for h in found if abs(h.T12.y) < 0.5}
    assert {(0, 0), (9, 1), (1, 0), (-1, 0)} <= shifts


def test_two_landmarks_each_have_two_answers():
    one, two = points_map("a", np.array([[0.0, 0], [8, 0]])), points_map("b", np.array([[0.0, 0], [0, 8]]))
    found = match_point_pairs(one, two)
    assert sorted(round(h.T12.theta, 6) for h in found) == pytest.approx([-np.pi / 2, np.pi / 2])


def test_thousand_landmarks_take_bounded_memory():
    map1, map2, T12, _ = two_maps(0, n=1000, common=0.7)
    assert displacement(match_point_pairs(map1, map2)[0], T12, map2) < 0.5


def test_parameters_must_be_positive():
    with pytest.raises(ConfigError, match=r"point_pairs\.seeds is 0"):
        PointPairConfig(seeds=0)
