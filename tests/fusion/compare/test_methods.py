"""Every method on maps without errors, on odd maps, and where its library isn't there."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import ConfigError, TooLargeError
from mapfuse.datasets.maps import Landmark, LandmarkMap, Noise
from mapfuse.fusion.compare import METHODS, compare, compare_pair, methods
from mapfuse.fusion.compare.kalman import MOST_LANDMARKS, merge_by_kalman
from mapfuse.fusion.compare.method import Method
from mapfuse.fusion.compare.optimised import merge_optimised
from mapfuse.fusion.compare.rigid import merged_rigidly
from mapfuse.fusion.config import FuseConfig


def able(name):
    (method,) = methods([name])
    if method.missing:
        pytest.skip(method.missing)
    if name in ("ransac", "icp"):
        try:
            import open3d  # noqa: F401
        except (ImportError, OSError) as error:
            pytest.skip(f"Open3D can't be loaded: {error}")
    return method


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", METHODS)
def test_maps_without_errors_are_laid_on_each_other_exactly(name, pair):
    one, two, truth = pair
    (e,) = compare_pair(one, two, [able(name)], truth)
    assert e.error == ""
    assert e.decision == "merged"
    assert e.correctness == 1.0
    assert e.count == e.truth.common == 8
    assert e.truth.error_m < 1e-3
    assert e.truth.error_rad < 1e-4
    assert e.truth.rms < 1e-3
    assert e.candidates == len(one) * len(two)
    assert (e.gained, e.lost) == (0, 0)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", METHODS)
def test_every_recorded_landmark_is_in_the_merged_map_once(name, pair):
    one, two, _ = pair
    merge = able(name).run(one, two)
    assert sorted(i for l in merge.landmarks for i in l.ids1) == sorted(one.ids)
    assert sorted(i for l in merge.landmarks for i in l.ids2) == sorted(two.ids)


@pytest.mark.parametrize("name", ["heuristic", "kalman", "optimised"])
def test_a_door_that_isn_t_there_is_not_kept(name, pair):
    one, two, truth = pair
    (e,) = compare_pair(one, two, [able(name)], truth)
    assert e.truth.false_alarms == 1
    assert e.truth.passed_alarms == e.truth.eliminated == 1
    assert e.eliminated_share == 1.0


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", METHODS)
def test_empty_maps_share_nothing(name, pair):
    one, *_ = pair
    empty = LandmarkMap("empty", ())
    for maps in ((one, empty), (empty, one), (empty, LandmarkMap("other", ()))):
        merge = able(name).run(*maps)
        assert merge.decision == "no_overlap"
        assert merge.landmarks == ()


def test_without_open3d_its_methods_say_what_to_install(monkeypatch, pair):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        "mapfuse.fusion.compare.clouds.find_spec", lambda name: None if name == "open3d" else found(name)
    )
    ransac, heuristic = methods(["ransac", "heuristic"])
    assert "mapfuse[open3d]" in ransac.missing
    one, two, truth = pair
    left_out, done = compare_pair(one, two, [ransac, heuristic], truth)
    assert left_out.error == ransac.missing
    assert left_out.merge is left_out.decision is left_out.count is left_out.truth is None
    assert done.decision == "merged"
    assert done.gained is done.lost is None  # nothing to count them against


def test_a_pair_that_a_method_can_t_do_leaves_the_others_alone(pair):
    one, two, truth = pair

    def fails(map1, map2):
        raise TooLargeError("too many landmarks")

    found = compare({m.name: m for m in (one, two)}, None, [Method("big", "big", fails), able("heuristic")], truth)
    assert [(e.method, e.error) for e in found] == [("big", "too many landmarks"), ("heuristic", "")]


def test_a_bug_is_no_answer(pair):
    one, two, _ = pair

    def broken(map1, map2):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        compare_pair(one, two, [Method("broken", "broken", broken)])


def test_unknown_methods_are_named():
    with pytest.raises(ConfigError, match=r"no method 'icq'; there are heuristic, .* optimised"):
        methods(["icq"])


def test_gained_and_lost_are_against_the_first_method(pair):
    one, two, truth = pair

    def with_matches(*pairs):
        def run(map1, map2):
            merge = able("heuristic").run(map1, map2)
            return type(merge)("merged", merge.T12, pairs, merge.landmarks)

        return run

    a, b, c = (("one-a", "two-a"), ("one-b", "two-b"), ("one-c", "two-c"))
    found = compare_pair(one, two, [Method("x", "x", with_matches(a, b)), Method("y", "y", with_matches(b, c))], truth)
    assert [(e.gained, e.lost) for e in found] == [(0, 0), (1, 1)]


# ------------------------------------------------------------------------------------------------ the Kalman filter
def noisy_points(seed, n=12, sigma=0.05):
    """Two maps of the same trees, seen from two frames not far from each other."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-6, 6, (n, 2))
    T12 = np.array([1.0, -0.5, 0.3])
    maps = []
    for name, T in (("one", np.zeros(3)), ("two", se2.inverse(T12))):
        at = se2.transform(T, xy) + rng.normal(0, sigma, (n, 2))
        marks = tuple(
            Landmark(f"{name}{k}", "tree", *at[k].tolist(), covariance=sigma**2 * np.eye(2)) for k in range(n)
        )
        maps.append(LandmarkMap(name, marks, noise=Noise(position_sigma=sigma)))
    return *maps, T12


@pytest.mark.parametrize("seed", range(4))
def test_kalman_on_points_is_the_optimum_of_the_graph(seed, monkeypatch):
    """With the right matches and small angles one linearisation is as good as many: T12 and its covariance agree."""
    from mapfuse.datasets.transform import Transform
    from mapfuse.fusion.compare import kalman
    from mapfuse.fusion.compare.method import Merge

    one, two, T12 = noisy_points(seed)
    matches = tuple(zip(one.ids, two.ids, strict=True))
    start = Merge("merged", Transform(T12[0] + 0.2, T12[1] - 0.1, T12[2] + 0.05), matches)
    monkeypatch.setattr(kalman, "merge_by_heuristic", lambda *_: start)
    filtered = merge_by_kalman(one, two)
    optimum = merge_optimised(one, two, FuseConfig())
    assert set(optimum.correspondences) == set(filtered.correspondences) == set(matches)
    C = optimum.T12.covariance
    off = filtered.T12.array - optimum.T12.array
    assert off @ np.linalg.solve(C, off) < 0.05  # a tenth of a sigma in each of three directions
    assert filtered.T12.covariance == pytest.approx(C, rel=0.1, abs=0.02 * np.abs(C).max())


def test_kalman_gates_a_wrong_match(monkeypatch):
    from mapfuse.datasets.transform import Transform
    from mapfuse.fusion.compare import kalman
    from mapfuse.fusion.compare.method import Merge

    one, two, T12 = noisy_points(7)
    matches = [*zip(one.ids[:-2], two.ids[:-2], strict=True), (one.ids[-1], two.ids[-2])]
    start = Merge("merged", Transform(*T12.tolist()), tuple(matches))
    monkeypatch.setattr(kalman, "merge_by_heuristic", lambda *_: start)
    assert set(merge_by_kalman(one, two).correspondences) == set(matches[:-1])


def test_kalman_refuses_more_than_it_can_hold():
    many = tuple(Landmark(f"p{k}", "tree", float(k), 0.0) for k in range(MOST_LANDMARKS))
    with pytest.raises(TooLargeError, match=str(MOST_LANDMARKS)):
        merge_by_kalman(LandmarkMap("one", many), LandmarkMap("two", many[:1]))


# ------------------------------------------------------------------------------------------------- the rigid merge
def test_what_the_other_robot_did_not_pass_stays(pair):
    one, two, truth = pair
    merged = merged_rigidly(one, two, truth.T12("one", "two"), truth.true_pairs("one", "two"))
    gone = {i for l in merged if not l.kept for i in (*l.ids1, *l.ids2)}
    # map 2 drove past the false door and, on a-j-d, map 1 drove past the door that it lacks; nobody else drove the spur
    assert gone == {"one-x"}
