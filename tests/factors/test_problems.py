"""Maps to problems: truth has no error, nothing depends on frames, order or names, and bad input is refused."""

from __future__ import annotations

import copy
import pickle

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapError, MapfuseError, UndeterminedError
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.datasets.transform import Transform
from mapfuse.factors import (
    CompassKey,
    CompassReading,
    Correspondence,
    FrameAnchor,
    FrameKey,
    Gauge,
    JointMeasurement,
    KeyBook,
    LandmarkKey,
    LinkMeasurement,
    NorthKey,
    NorthOffset,
    TransformPrior,
    axes,
    build_problem,
    map_measurements,
    pair_problem,
    single_map_problem,
)

NORTH = 0.8
#: Places of a small floor with oblique corridors [m, world], and its corridors.
PLACES = {"a": (0.0, 0.0), "b": (8.0, 1.0), "c": (9.0, 9.0), "d": (1.0, 7.0), "e": (15.0, 4.0)}
WAYS = [("a", "b"), ("b", "c"), ("c", "d"), ("d", "a"), ("b", "e")]


def true_map(name, pose, ids=None, order=None, noise=None, jitter=0.0, rng=None):
    """The floor as a robot whose frame stands at ``pose`` records it, exactly or with ``jitter`` on every number."""
    rng = np.random.default_rng(0) if rng is None else rng

    def off():
        return float(rng.normal(0, jitter)) if jitter else 0.0

    ids = {place: place for place in PLACES} if ids is None else ids
    inverse = se2.inverse(np.array(pose, dtype=float))
    landmarks = []
    for place, xy in PLACES.items():
        links = []
        for a, b in [*WAYS, *((b, a) for a, b in WAYS)]:
            if a != place:
                continue
            step = np.subtract(PLACES[b], xy)
            direction = float(np.arctan2(step[1], step[0]))
            heading = float(se2.wrap(direction - pose[2])) + off()
            compass = float(se2.wrap(direction - NORTH)) + off()
            links.append(Link("open", heading, compass, ids[b], float(np.hypot(*step)) + off(), 1))
        x, y = se2.transform(inverse, np.array(xy))
        landmarks.append(Landmark(ids[place], "junction", float(x) + off(), float(y) + off(), links=tuple(links)))
    tree = se2.transform(inverse, np.array([4.0, 4.0]))
    landmarks.append(Landmark(ids.get("t", "t"), "tree", *tree.tolist()))
    start = np.array([[0.0, *se2.compose(inverse, np.zeros(3))]])
    landmarks = [landmarks[k] for k in (range(len(landmarks)) if order is None else order)]
    return LandmarkMap(name, tuple(landmarks), noise=noise or Noise(), path=start)


def optimum(problem):
    graph = problem.graph()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-14)
    values = gtsam.LevenbergMarquardtOptimizer(graph, problem.values(), parameters).optimize()
    return graph, values, problem.poses(values)


MATCHES = [(place, place) for place in [*PLACES, "t"]]


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (3.0, -7.0, 2.0), (100.0, 50.0, -3.1)])
def test_a_map_without_noise_has_no_error_at_the_truth(pose):
    problem = single_map_problem(true_map("m", pose))
    assert problem.error() == pytest.approx(0, abs=1e-18)
    assert problem.graph().error(problem.values()) == pytest.approx(0, abs=1e-18)
    # five corridors from either end, one anchor for them and one for the tree, a reading per arm
    assert len(problem.of_kind(LinkMeasurement)) == 10
    assert [m.b.id for m in problem.of_kind(FrameAnchor)] == ["a", "t"]
    assert len(problem.of_kind(CompassReading)) == 10
    _, values, poses = optimum(problem)
    for unknown in problem.keys:
        np.testing.assert_allclose(se2.between(problem.initial[unknown], poses[unknown]), 0, atol=1e-9)
    assert np.isfinite(gtsam.Marginals(problem.graph(), values).marginalCovariance(problem.keys.key(NorthKey()))).all()


def test_two_maps_without_noise_have_no_error_under_the_true_T12_and_much_under_another():
    pose1, pose2 = np.array([3.0, -7.0, 2.0]), np.array([-4.0, 2.0, -2.5])
    map1, map2 = true_map("m1", pose1), true_map("m2", pose2)
    T12 = se2.between(pose1, pose2)
    problem = pair_problem(map1, map2, Transform.from_array(T12), MATCHES)
    assert problem.error() == pytest.approx(0, abs=1e-16)
    assert [c.dof for c in problem.of_kind(Correspondence)] == [3, 3, 3, 3, 3, 2]
    assert len(problem.of_kind(Gauge)) == len(problem.of_kind(TransformPrior)) == 1
    wrong = pair_problem(map1, map2, T12 + np.array([1.0, 0.0, 0.0]), MATCHES, robust=False)
    assert wrong.error() > 1000
    _, _, poses = optimum(wrong)
    # the weak prior stands 1 m off with a sigma of 100 m: no pull that could be seen
    np.testing.assert_allclose(se2.between(T12, poses[FrameKey(1)]), 0, atol=2e-5)


def test_three_maps_in_one_problem_with_any_of_them_as_reference():
    poses = [np.array(p) for p in ((0.0, 0.0, 0.3), (3.0, -7.0, 2.0), (-4.0, 2.0, -2.5))]
    maps = [true_map(f"m{r}", pose) for r, pose in enumerate(poses)]
    matches = [(LandmarkKey(r, a), LandmarkKey(r + 1, b)) for r in (0, 1) for a, b in MATCHES]
    for reference in range(3):
        frames = [se2.between(poses[reference], pose) for pose in poses]
        problem = build_problem(maps, frames, matches, reference=reference)
        assert problem.error() == pytest.approx(0, abs=1e-16)
        assert [g.of for g in problem.of_kind(Gauge)] == [FrameKey(reference)]
        assert len(problem.of_kind(NorthOffset)) == 3


def noisy_pair(seed=3):
    pose1, pose2 = np.array([3.0, -7.0, 2.0]), np.array([-4.0, 2.0, -2.5])
    maps = [
        true_map(n, pose, jitter=0.05, rng=np.random.default_rng((seed, k)))
        for k, (n, pose) in enumerate(zip(("m1", "m2"), (pose1, pose2), strict=True))
    ]
    return maps[0], maps[1], se2.between(pose1, pose2)


def moved(recorded, G):
    """The same map in another coordinate system: ``G`` (3,) takes the old coordinates into the new ones."""
    landmarks = []
    for l in recorded.landmarks:
        links = tuple(
            Link(k.type, float(se2.wrap(k.heading + G[2])), k.compass, k.connected_to_id, k.distance, k.travel_counter)
            for k in l.links
        )
        x, y = se2.transform(G, np.array([l.x, l.y])).tolist()
        landmarks.append(Landmark(l.id, l.type, x, y, links=links))
    path = np.column_stack([recorded.path[:, 0], se2.compose(G, recorded.path[:, 1:])])
    return recorded.replace(landmarks=tuple(landmarks), path=path)


def landmarks_of(problem, values, poses, r):
    marginals = gtsam.Marginals(problem.graph(), values)
    keys = [LandmarkKey(r, name) for name in problem.maps[r].ids]
    return {
        key.id: (poses[key][:2], axes.pose_to_axes(poses[key][2], marginals.marginalCovariance(problem.keys.key(key))))
        for key in keys
    }


@pytest.mark.parametrize("G", [(10.0, -3.0, 1.0), (0.0, 0.0, np.pi), (-2000.0, 1000.0, -2.2)])
def test_moving_the_second_map_in_its_coordinates_moves_T12_and_nothing_else(G):
    map1, map2, T12 = noisy_pair()
    before = pair_problem(map1, map2, T12, MATCHES, robust=False)
    after = pair_problem(map1, moved(map2, np.array(G)), se2.compose(T12, se2.inverse(G)), MATCHES, robust=False)
    graph0, values0, poses0 = optimum(before)
    graph1, values1, poses1 = optimum(after)
    assert graph1.error(values1) == pytest.approx(graph0.error(values0), rel=1e-7)
    expected = se2.compose(poses0[FrameKey(1)], se2.inverse(G))
    np.testing.assert_allclose(se2.between(expected, poses1[FrameKey(1)]), 0, atol=1e-5)
    found0, found1 = (landmarks_of(p, v, x, 1) for p, v, x in ((before, values0, poses0), (after, values1, poses1)))
    for name, (xy, C) in found0.items():
        np.testing.assert_allclose(found1[name][0], xy, atol=1e-6)
        np.testing.assert_allclose(found1[name][1][:2, :2], C[:2, :2], rtol=1e-5, atol=1e-8)


def test_swapping_the_maps_inverts_T12():
    map1, map2, T12 = noisy_pair()
    forth = optimum(pair_problem(map1, map2, T12, MATCHES, robust=False))
    back = optimum(pair_problem(map2, map1, se2.inverse(T12), [(b, a) for a, b in MATCHES], robust=False))
    assert back[0].error(back[1]) == pytest.approx(forth[0].error(forth[1]), rel=1e-4)
    closed = se2.compose(forth[2][FrameKey(1)], back[2][FrameKey(1)])
    np.testing.assert_allclose(closed, 0, atol=2e-4)


def test_shuffled_landmarks_give_the_very_same_graph():
    map1, map2, T12 = noisy_pair()
    rng = np.random.default_rng(5)
    problem = pair_problem(map1, map2, T12, MATCHES, robust=False)
    graph, values, _ = optimum(problem)
    for _ in range(3):
        mixed = []
        for recorded in (map1, map2):
            landmarks = [recorded.landmarks[k] for k in rng.permutation(len(recorded))]
            mixed.append(recorded.replace(landmarks=tuple(landmarks)))
        shuffled = pair_problem(*mixed, T12, MATCHES, robust=False)
        assert shuffled.measurements == problem.measurements
        assert list(shuffled.keys) == list(problem.keys)
        assert all(np.array_equal(shuffled.initial[unknown], pose) for unknown, pose in problem.initial.items())
        links = [m.replace(landmarks=tuple(_mixed_links(l, rng) for l in m.landmarks)) for m in mixed]
        other = pair_problem(*links, T12, MATCHES, robust=False).graph()
        assert other.error(values) == pytest.approx(graph.error(values), rel=1e-12)


def _mixed_links(landmark, rng):
    links = tuple(landmark.links[k] for k in rng.permutation(len(landmark.links)))
    return Landmark(landmark.id, landmark.type, landmark.x, landmark.y, links=links)


def test_other_ids_give_the_same_answer():
    map1, _, T12 = noisy_pair()
    names = dict(zip([*PLACES, "t"], ["zz", "9", "Ä", "m", "B", "0"], strict=True))
    pose2 = np.array([-4.0, 2.0, -2.5])
    answers = []
    for ids in ({p: p for p in names}, names):
        map2 = true_map("m2", pose2, ids=ids, jitter=0.05, rng=np.random.default_rng(8))
        problem = pair_problem(map1, map2, T12, [(p, ids[p]) for p in names], robust=False)
        answers.append(optimum(problem)[2][FrameKey(1)])
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-7)


def test_keys_and_unknowns_are_each_others_inverse_and_unique_without_their_letter():
    map1, map2, _ = noisy_pair()
    book = KeyBook([map1, map2])
    assert len(book) == 2 + 12 + 2 + 1
    assert {FrameKey(1), CompassKey(0), NorthKey(), LandmarkKey(1, "t")} <= set(book)
    for unknown in book:
        assert book.unknown(book.key(unknown)) == unknown
    indices = [gtsam.Symbol(book.key(unknown)).index() for unknown in book]
    assert len(set(indices)) == len(book)
    assert book.landmarks(1) == tuple(LandmarkKey(1, name) for name in sorted(map2.ids))
    assert book.name(book.key(LandmarkKey(1, "t"))) == "landmark m2:t"
    assert book.name(book.key(CompassKey(0))) == "compass of m1"
    with pytest.raises(KeyError):
        book.key(LandmarkKey(2, "t"))
    with pytest.raises(KeyError):
        book.unknown(12345)
    assert book.unknown(pickle.loads(pickle.dumps(book)).key(NorthKey())) == NorthKey()


def test_the_landmark_that_gtsam_names_is_found_in_its_message():
    problem = single_map_problem(true_map("m", (0.0, 0.0, 0.0)))
    tree = LandmarkKey(0, "t")
    silent = problem.with_measurements(m for m in problem.measurements if tree not in m.unknowns)
    with pytest.raises(UndeterminedError, match="m:t") as named:
        silent.graph()
    assert named.value.landmarks == (("m", "t"),)
    floating = problem.with_measurements(
        m for m in problem.measurements if not (isinstance(m, FrameAnchor) and tree in m.unknowns)
    )
    with pytest.raises(RuntimeError) as caught:
        gtsam.Marginals(floating.graph(), floating.values())
    assert problem.keys.mentioned(str(caught.value)) == (LandmarkKey(0, "t"),)
    assert problem.keys.mentioned("Indeterminate linear system near 123456789") == ()


def test_better_starting_positions_are_used_and_change_no_measurement():
    map1, map2, T12 = noisy_pair()
    given = np.column_stack([map2.positions + 0.5, np.full(len(map2), 0.25)])
    plain = pair_problem(map1, map2, T12, MATCHES)
    problem = pair_problem(map1, map2, T12, MATCHES, starts=(None, given))
    start = problem.initial[LandmarkKey(1, "b")]
    np.testing.assert_allclose(start, se2.compose(T12, given[map2.index_from_id["b"]]), atol=1e-12)
    assert problem.initial[LandmarkKey(1, "t")][2] == pytest.approx(float(se2.wrap(T12[2])))
    assert problem.of_kind(LinkMeasurement) == plain.of_kind(LinkMeasurement)
    np.testing.assert_allclose(optimum(problem)[2][FrameKey(1)], optimum(plain)[2][FrameKey(1)], atol=1e-6)
    again = problem.starting_at(plain.initial)
    assert again.error() == pytest.approx(plain.error())


def test_a_joint_covariance_replaces_links_and_anchors_of_its_landmarks_only():
    recorded = true_map("m", (0.0, 0.0, 0.0))
    joint = JointCovariance(("b", "a"), 2, np.eye(4) * 0.01)
    problem = single_map_problem(recorded.replace(joint_covariance=joint))
    links = {frozenset((m.a.id, m.b.id)) for m in problem.of_kind(LinkMeasurement)}
    assert links == {frozenset(way) for way in WAYS} - {frozenset("ab")}
    assert [m.b.id for m in problem.of_kind(FrameAnchor)] == ["t"]
    assert problem.error() == pytest.approx(0, abs=1e-16)
    whole = JointCovariance(recorded.ids, 3, np.eye(18) * 0.01)
    problem = single_map_problem(recorded.replace(joint_covariance=whole))
    # the tree has no heading: its third row isn't measured
    assert len(problem.of_kind(JointMeasurement)[0].places) == 17
    assert problem.of_kind(LinkMeasurement) == problem.of_kind(FrameAnchor) == ()
    assert problem.error() == pytest.approx(0, abs=1e-16)


def test_maps_of_nothing_and_of_one_landmark_are_normal():
    empty = LandmarkMap("empty")
    assert single_map_problem(empty).graph().size() == 1
    one = LandmarkMap("one", (Landmark("a", "tree", 1.0, 2.0),))
    problem = pair_problem(empty, one, (1.0, 0.0, 0.0), [])
    _, values, poses = optimum(problem)
    np.testing.assert_allclose(poses[LandmarkKey(1, "a")], (2, 2, 0), atol=1e-9)
    gtsam.Marginals(problem.graph(), values)


def test_copies_and_pickles_of_measurements_are_equal_and_frozen():
    map1, map2, T12 = noisy_pair()
    whole = JointCovariance(map2.ids, 2, np.eye(12) * 0.01)
    problem = pair_problem(map1, map2.replace(joint_covariance=whole), T12, MATCHES)
    for other in (pickle.loads(pickle.dumps(problem)), copy.deepcopy(problem)):
        assert other.error() == problem.error()
        assert not other.of_kind(JointMeasurement)[0].sqrt_information.flags.writeable
        assert other.measurements == problem.measurements
        assert list(other.keys) == list(problem.keys)


def test_measurements_of_a_map_are_worked_out_once():
    recorded = true_map("m", (0.0, 0.0, 0.0))
    assert map_measurements(recorded, 0) is map_measurements(recorded, 0)
    assert map_measurements(recorded, 0) == map_measurements(recorded.replace(), 0)
    assert map_measurements(recorded, 1) != map_measurements(recorded, 0)


def with_landmark(**changes):
    fields = {"id": "x", "type": "chair", "x": 0.0, "y": 0.0} | changes
    return LandmarkMap("bad", (Landmark("ok", "chair", 1.0, 1.0), Landmark(**fields)))


@pytest.mark.parametrize(
    ("recorded", "where"),
    [
        (with_landmark(x=np.nan), r"landmarks\[1\]\.x"),
        (with_landmark(y=np.inf), r"landmarks\[1\]\.y"),
        (with_landmark(heading=np.nan), r"landmarks\[1\]\.heading"),
        (with_landmark(id="ok"), "same id"),
        (with_landmark(covariance=np.diag([1.0, -1.0])), r"landmarks\[1\]\.covariance.*indefinite"),
        (with_landmark(covariance=np.array([[1.0, 0.5], [0.0, 1.0]])), "symmetric"),
        (with_landmark(covariance=np.full((2, 2), np.nan)), "finite"),
        (with_landmark(covariance=np.eye(4)), "2x2 or 3x3"),
        (with_landmark(links=(Link("open", np.nan),)), r"landmarks\[1\]\.links\[0\]\.heading"),
        (with_landmark(links=(Link("open", 0.0, np.inf),)), r"landmarks\[1\]\.links\[0\]\.compass"),
        (with_landmark(links=(Link("open", 0.0, None, "ok", -1.0),)), r"links\[0\]\.distance: is negative"),
        (with_landmark(links=(Link("open", 0.0, None, "none", 1.0),)), "'none', which is not in the map"),
        (with_landmark().replace(noise=Noise(heading_sigma=-0.1)), "noise.heading_sigma"),
        (with_landmark().replace(noise=Noise(position_sigma=np.nan)), "noise.position_sigma"),
        (with_landmark().replace(noise=Noise(compass_offset_sigma=np.nan)), "noise.compass_offset_sigma"),
        (with_landmark().replace(joint_covariance=JointCovariance(("x", "y"), 2, np.eye(4))), "'y', which is not"),
        (with_landmark().replace(joint_covariance=JointCovariance(("x", "x"), 2, np.eye(4))), "twice"),
        (with_landmark().replace(joint_covariance=JointCovariance(("x",), 2, np.eye(3))), "2 rows for each"),
        (with_landmark().replace(joint_covariance=JointCovariance(("x",), 2, np.diag([1.0, -1]))), "indefinite"),
    ],
)
def test_a_broken_map_is_refused_with_the_place(recorded, where):
    with pytest.raises(MapError, match=where):
        single_map_problem(recorded)


@pytest.mark.parametrize(
    ("build", "why"),
    [
        (lambda a, b: pair_problem(a, b, (np.nan, 0.0, 0.0), []), "transformation of map 1 is not finite"),
        (lambda a, b: pair_problem(a, b, (0.0, 0.0), []), "shape"),
        (lambda a, b: pair_problem(a, b, np.zeros(3), [("a", "zz")]), "'zz', which map 1 doesn't have"),
        (lambda a, b: build_problem([a], [np.zeros(3)], [(LandmarkKey(0, "a"), LandmarkKey(0, "b"))]), "of one map"),
        (lambda a, b: build_problem([a, b], [np.zeros(3)]), "as many transformations"),
        (lambda a, b: build_problem([], []), "as many transformations"),
        (lambda a, b: build_problem([a], [np.zeros(3)], reference=1), "reference"),
        (lambda a, b: single_map_problem(a, np.zeros((2, 2))), "starting poses of map 'm1'"),
        (lambda a, b: single_map_problem(a, np.full((6, 2), np.nan)), "starting poses of map 'm1'"),
    ],
)
def test_what_makes_no_problem_is_refused(build, why):
    map1, map2, _ = noisy_pair()
    with pytest.raises(MapfuseError, match=why):
        build(map1, map2)


def test_a_starting_value_that_is_not_finite_never_reaches_gtsam():
    problem = single_map_problem(true_map("m", (0.0, 0.0, 0.0)))
    broken = problem.starting_at({LandmarkKey(0, "a"): np.array([0.0, np.nan, 0.0])})
    with pytest.raises(MapfuseError, match="landmark m:a"):
        broken.values()


def transform_error(seed, compass):
    """Squared Mahalanobis distance of the solved T12 from the true one, the true correspondences given."""
    map1, map2, truth = simulated_pair(seed, compass=compass)
    T12 = truth.T12("A", "B").array
    problem = pair_problem(map1, map2, T12, truth.true_pairs("A", "B"), robust=False)
    graph = problem.graph()
    values = gtsam.LevenbergMarquardtOptimizer(graph, problem.values()).optimize()
    pose = problem.poses(values)[FrameKey(1)]
    marginal = gtsam.Marginals(graph, values).marginalCovariance(problem.keys.key(FrameKey(1)))
    e = pose - T12
    e[2] = se2.wrap(e[2])
    return float(e @ np.linalg.solve(axes.pose_to_axes(pose[2], marginal), e))


@pytest.mark.parametrize("compass", [False, True])
def test_T12_of_simulated_pairs_is_as_far_off_as_its_covariance_says(compass):
    # 40 fixed pairs, the true correspondences given: inside the 99.8 % band, so that it fails for a wrong model only
    nees = np.array([transform_error(700 + k, compass) for k in range(40)])
    low, high = chi2.ppf([0.001, 0.999], 3 * len(nees)) / len(nees)
    assert low < nees.mean() < high


@pytest.mark.statistics
@pytest.mark.parametrize("compass", [False, True])
def test_nees_of_T12_over_hundreds_of_pairs_is_in_its_band(compass):
    nees = np.array([transform_error(20_000 + k, compass) for k in range(400)])
    low, high = chi2.ppf([0.025, 0.975], 3 * len(nees)) / len(nees)
    assert low < nees.mean() < high


@pytest.mark.parametrize("heading", [None, 0.7])
@pytest.mark.parametrize("position_sigma", [0.03, 0.3, 3.0])
@pytest.mark.parametrize("count", [1, 3, 40])
def test_a_map_that_nothing_ties_to_the_other_doesnt_float(heading, position_sigma, count):
    rng = np.random.default_rng(6)
    noise = Noise(position_sigma=position_sigma)
    xy = rng.normal(0, 10, (count, 2))
    landmarks = tuple(Landmark(f"p{k}", "tree", *p, heading=heading) for k, p in enumerate(xy))
    recorded = LandmarkMap("m", landmarks, noise=noise)
    problem = pair_problem(recorded, recorded.replace(name="n"), (1.0, 2.0, 3.0), [])
    marginals = gtsam.Marginals(problem.graph(), problem.values())
    C = marginals.marginalCovariance(problem.keys.key(FrameKey(1)))
    x, y = xy.mean(axis=0)
    of_centre = np.array([[1, 0, -y], [0, 1, x], [0, 0, 1]])
    np.testing.assert_allclose(np.sqrt(np.diag(of_centre @ C @ of_centre.T)), (100, 100, 10), rtol=1e-3)
