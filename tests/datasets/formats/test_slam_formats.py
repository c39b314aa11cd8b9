"""g2o, text of GTSAM and iSAM, MATLAB submaps: optima by hand, by another method, and by GTSAM."""

import io
import math
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from mapfuse.datasets import se2
from mapfuse.datasets.errors import FileFormatError, MapfuseError
from mapfuse.datasets.formats import g2o, read_all, read_any
from mapfuse.datasets.formats.slamgraph import Measurements, solved_map
from mapfuse.datasets.formats.slamlines import read_lines, squared, toro, triangle
from mapfuse.datasets.landmark_slam import Drive, solve_drive


def read(tmp_path, text, name="it.g2o", **options):
    path = tmp_path / name
    path.write_text(text)
    return read_all(path, **options)[0]


def test_a_landmark_seen_twice_is_at_the_weighed_mean(tmp_path):
    # The pose is known (it is the gauge). Two sightings of x with information 1 and 3: (1 * 2 + 3 * 6) / 4 = 5,
    # variance 1 / 4; of y with 4 and 4: 1, variance 1 / 8.
    text = "VERTEX_SE2 0 0 0 0\nEDGE_SE2_XY 0 9 2 1 1 0 4\nEDGE_SE2_XY 0 9 6 1 3 0 4\n"
    (map_,) = read(tmp_path, text).maps
    np.testing.assert_allclose(map_.positions, [[5.0, 1.0]])
    np.testing.assert_allclose(map_["9"].covariance, np.diag([1 / 4, 1 / 8]))
    assert map_.joint_covariance is None


def test_uncertainty_of_the_way_is_in_the_joint_covariance(tmp_path):
    # One step of (4, 0, 0) with variances (0.1, 0.2, 0.01), then two landmarks at (2, 0) and (0, 3) from there, of
    # variance 0.5 each. To first order landmark 1 has in y 0.2 + 2^2 * 0.01 + 0.5, landmark 2 in x 0.1 + 3^2 * 0.01 +
    # 0.5; they share the step's x (0.1, and nothing of the turn, since landmark 1 has no y) and y (0.2 + 2 * 0 * 0.01).
    text = "EDGE_SE2 0 1 4 0 0 10 0 0 5 0 100\nEDGE_SE2_XY 1 7 2 0 2 0 2\nEDGE_SE2_XY 1 8 0 3 2 0 2\n"
    (map_,) = read(tmp_path, text).maps
    np.testing.assert_allclose(map_.positions, [[6, 0], [4, 3]], atol=1e-9)
    expected = np.array(
        [
            [0.1 + 0.5, 0, 0.1, 0],
            [0, 0.2 + 0.04 + 0.5, -2 * 3 * 0.01, 0.2],
            [0.1, -2 * 3 * 0.01, 0.1 + 0.09 + 0.5, 0],
            [0, 0.2, 0, 0.2 + 0.5],
        ]
    )
    assert map_.joint_covariance.order == ("7", "8")
    np.testing.assert_allclose(map_.joint_covariance.matrix, expected, atol=1e-9)
    np.testing.assert_allclose(map_.path, [[0, 0, 0, 0], [1, 4, 0, 0]], atol=1e-9)


def random_drive(rng, poses=60, trees=8):
    motions = np.column_stack([np.full(poses - 1, 1.0), np.zeros(poses - 1), rng.normal(0, 0.3, poses - 1)])
    path = np.zeros((poses, 3))
    for k, motion in enumerate(motions):
        path[k + 1] = se2.compose(path[k], motion)
    places = path[rng.integers(0, poses, trees), :2] + rng.normal(0, 2, (trees, 2))
    seen_from = np.concatenate([np.argmin(np.hypot(*(path[:, :2] - p).T))[None] for p in places] * 3)
    seen = np.tile(np.arange(trees), 3)
    sightings = se2.transform(se2.inverse(path[seen_from]), places[seen]) + rng.normal(0, 0.1, (3 * trees, 2))
    noisy = motions + rng.normal(0, [0.02, 0.02, 0.01], motions.shape)
    sigmas = np.full(motions.shape, [0.02, 0.02, 0.01])
    return Drive(noisy, sigmas, seen_from, seen, sightings, np.full(sightings.shape, 0.1))


def measured(drive, extra=()):
    motions = [
        (k, k + 1, motion, np.diag(1 / sigma**2))
        for k, (motion, sigma) in enumerate(zip(drive.motions, drive.motion_sigmas, strict=True))
    ]
    sightings = [
        (int(p), 100 + int(t), xy, np.diag(1 / sigma**2))
        for p, t, xy, sigma in zip(drive.seen_from, drive.seen, drive.sightings, drive.sighting_sigmas, strict=True)
    ]
    return Measurements((*motions, *extra), tuple(sightings), {}, {})


def test_a_drive_is_solved_as_by_the_other_solver():
    rng = np.random.default_rng(1)
    drive = random_drive(rng)
    other = solve_drive(drive, rng)
    (map_,) = solved_map("it", measured(drive), "tree", {}, {}).maps
    np.testing.assert_allclose(map_.positions, other.landmarks, atol=1e-7)
    np.testing.assert_allclose(map_.joint_covariance.matrix, other.covariance, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(map_.path[:, 1:], other.poses, atol=1e-7)


def by_gtsam(gtsam, found, map_):
    """Positions (n, 2) and standard deviations (n, 2) of a map's landmarks by GTSAM, from the same measurements."""
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    X, L = gtsam.symbol("x", 0), gtsam.symbol("l", 0)
    graph.add(gtsam.NonlinearEqualityPose2(X, gtsam.Pose2(0, 0, 0)))
    for a, b, motion, information in found.motions:
        noise = gtsam.noiseModel.Gaussian.Information(information)
        graph.add(gtsam.BetweenFactorPose2(X + a, X + b, gtsam.Pose2(*motion), noise))
    for p, t, xy, information in found.sightings:
        turned, noise = gtsam.Rot2(math.atan2(xy[1], xy[0])), _polar(gtsam, xy, information)
        graph.add(gtsam.BearingRangeFactor2D(X + p, L + t, turned, float(np.hypot(*xy)), noise))
    for number, *pose in map_.path:
        initial.insert(X + int(number), gtsam.Pose2(*pose))
    for landmark in map_.landmarks:
        initial.insert(L + int(landmark.id), gtsam.Point2(landmark.x, landmark.y))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize()
    marginals = gtsam.Marginals(graph, solved)
    places = np.array([solved.atPoint2(L + int(i)) for i in map_.ids])
    return places, np.sqrt([np.diag(marginals.marginalCovariance(L + int(i))) for i in map_.ids])


def test_loops_and_full_matrices_are_solved_as_by_gtsam(tmp_path):
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(2)
    drive = random_drive(rng)
    information = np.array([[50.0, 10.0, -5.0], [10.0, 800.0, 3.0], [-5.0, 3.0, 200.0]])
    loop = np.add(se2.between(*solve_drive(drive, rng).poses[[5, 50]]), [0.05, -0.05, 0.01])
    found = measured(drive, [(5, 50, loop, information)])
    lines = [
        f"EDGE_SE2 {a} {b} {' '.join(map(repr, [*z.tolist(), *matrix[np.triu_indices(3)].tolist()]))}"
        for a, b, z, matrix in found.motions
    ]
    lines += [
        f"EDGE_SE2_XY {a} {b} {' '.join(map(repr, [*z.tolist(), *matrix[np.triu_indices(2)].tolist()]))}"
        for a, b, z, matrix in found.sightings
    ]
    (map_,) = read(tmp_path, "\n".join(lines)).maps
    places, sigmas = by_gtsam(gtsam, found, map_)
    ours = np.sqrt(np.diag(map_.joint_covariance.matrix)).reshape(-1, 2)
    # sightings as bearing and range, errors in the tangent: one optimum but for terms of second order
    assert np.all(np.abs(places - map_.positions) < 0.2 * ours)
    np.testing.assert_allclose(ours, sigmas, rtol=0.05)


def _polar(gtsam, xy, information):
    bearing, distance = math.atan2(xy[1], xy[0]), float(np.hypot(*xy))
    c, s = math.cos(bearing), math.sin(bearing)
    jacobian = np.array([[-s / distance, c / distance], [c, s]])
    return gtsam.noiseModel.Gaussian.Covariance(jacobian @ np.linalg.inv(information) @ jacobian.T)


def test_the_first_pose_stays_where_its_vertex_is(tmp_path):
    text = "VERTEX_SE2 0 10 5 1.5707963267948966\nEDGE_SE2_XY 0 1 2 0 1 0 1\n"
    (map_,) = read(tmp_path, text).maps
    np.testing.assert_allclose(map_.positions, [[10, 7]], atol=1e-12)


def test_what_hangs_on_nothing_is_left_out_and_said(tmp_path):
    text = (
        "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 5 6 1 0 0 1 0 0 1 0 1\n"
        "EDGE_SE2_XY 1 7 1 0 1 0 1\nEDGE_SE2_XY 6 8 1 0 1 0 1\nVERTEX_XY 9 3 4\n"
    )
    reading = read(tmp_path, text)
    (map_,) = reading.maps
    assert map_.ids == ("7", "9")
    assert map_["9"].covariance is None
    assert reading.remarks == (
        "poses that nothing joins to the first one (5, 6): left out",
        "landmarks seen from such poses only (8): left out",
        "landmarks that no edge leads to (9): taken from their vertices, without covariance",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n", "line 1: EDGE_SE2: needs 11 numbers, not 10"),
        ("EDGE_SE2 0 1 1 0 x 1 0 0 1 0 1\n", "line 1: EDGE_SE2: not all of it are numbers"),
        ("EDGE_SE2 0 1 nan 0 0 1 0 0 1 0 1\n", "line 1: EDGE_SE2: not all numbers are finite"),
        ("EDGE_SE2 0 1 1e300 0 0 1 0 0 1 0 1\n", "line 1: EDGE_SE2: not all numbers are finite and within bounds"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1\n", "line 1: EDGE_SE2: its matrix isn't positive definite"),
        ("EDGE_SE2 0 1 1 0 0 1e300 0 0 1 0 1\n", "line 1: EDGE_SE2: its matrix is out of bounds"),
        ("EDGE_SE2 0 0 1 0 0 1 0 0 1 0 1\n", "line 1: EDGE_SE2: is a motion from a pose to itself"),
        ("VERTEX_XY 1 0 0\nVERTEX_XY 1 0 0\n", "line 2: VERTEX_XY: the vertex 1 stands already further up"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", "is a graph in space, and mapfuse's maps are of the plane"),
        ("WHAT 1 2\n", "line 1: 'WHAT' is no word of this format"),
        (f"VERTEX_XY {10**30} 0 0\n", "has a number of a vertex out of bounds"),
        (f"VERTEX_XY {'9' * 5000} 0 0\n", "not all of it are numbers"),
    ],
)
def test_broken_lines_are_refused_with_their_number(tmp_path, text, message):
    with pytest.raises(FileFormatError, match=message):
        read(tmp_path, text)


def test_what_is_not_positive_definite_is_said(tmp_path):
    found = Measurements((), ((0, 5, np.array([1.0, 0.0]), np.diag([1.0, -1.0])),), {}, {})
    with pytest.raises(MapfuseError, match="isn't positive definite"):
        solved_map("it", found, "tree", {}, {})


def test_axes_of_a_motion_are_those_of_its_end(tmp_path):
    # A step of 4 m and a left turn by a quarter: the end's x is the start's y. Variance 0.1 along the end's x, 0.2
    # along its y, 0.01 of the turn; the landmark is where the end is (seen with next to no error).
    text = f"EDGE_SE2 0 1 4 0 {math.pi / 2!r} 10 0 0 5 0 100\nEDGE_SE2_XY 1 7 0 0 1e9 0 1e9\n"
    (map_,) = read(tmp_path, text).maps
    covariance = map_["7"].covariance
    np.testing.assert_allclose(covariance, np.diag([0.2, 0.1]), atol=1e-6)


def test_matrices_of_each_layout():
    assert triangle([1, 2, 3, 4, 5, 6]).tolist() == [[1, 2, 3], [2, 4, 5], [3, 5, 6]]
    assert toro([1, 2, 4, 6, 3, 5]).tolist() == [[1, 2, 3], [2, 4, 5], [3, 5, 6]]
    root = np.array([[2.0, 1.0], [0.0, 3.0]])
    assert squared([2, 1, 3]).tolist() == (root.T @ root).tolist()


@pytest.mark.parametrize(("matrix", "variance"), [("covariance", 0.25), ("information", 4.0), ("root", 16.0)])
def test_isam_text_says_its_matrix_by_option(tmp_path, matrix, variance):
    text = "LANDMARK 0 1 2.0 3.0 0.25 0 0.25\n"
    reading = read(tmp_path, text, "it.txt", matrix=matrix)
    np.testing.assert_allclose(reading.maps[0]["1"].covariance, np.eye(2) * variance)
    assert reading.remarks == ()
    assert "matrices taken for covariances" in read(tmp_path, text, "it.txt").remarks[0]


def test_bearing_and_range(tmp_path):
    (map_,) = read(tmp_path, "BR 0 1 1.5707963267948966 2.0 0.1 0.3\n", "it.graph").maps
    np.testing.assert_allclose(map_.positions, [[0, 2]], atol=1e-12)
    np.testing.assert_allclose(map_["1"].covariance, np.diag([0.04, 0.09]), atol=1e-12)


def gtsam_data(name):
    spec = find_spec("gtsam")
    path = Path(spec.submodule_search_locations[0]) / "Data" / name if spec else Path("none")
    if not path.is_file():
        pytest.skip("the gtsam package has no such example")
    return path


def test_a_simulated_graph_of_gtsam_is_read_as_gtsam_would():
    """City trees: odometry without vertices, from gtsam's own examples, simulated."""
    gtsam = pytest.importorskip("gtsam")
    path = gtsam_data("cityTrees_reduced_1k.g2o")
    map_, found = read_any(path, type="tree")
    assert found.name == "g2o"
    assert len(map_.path) == 1000
    places, sigmas = by_gtsam(gtsam, read_lines(path, g2o.TAGS)[0], map_)
    ours = np.sqrt(np.diag(map_.joint_covariance.matrix)).reshape(-1, 2)
    assert len(ours) == 66
    assert np.all(np.abs(places - map_.positions) < 0.2 * ours)
    np.testing.assert_allclose(ours, sigmas, rtol=0.1)


def submap(path, state, covariance):
    target = io.BytesIO()
    savemat(target, {"localmap_st": state, "localmap_P": covariance}, do_compression=True)
    path.write_bytes(target.getvalue())
    return path


def test_a_submap_of_matlab(tmp_path):
    state = np.array([[0, 5.0], [0, 1.0], [0, 0.5], [12, 2.0], [12, 3.0], [7, -1.0], [7, 4.0]])
    root = np.random.default_rng(3).normal(size=(7, 7))
    map_, found = read_any(submap(tmp_path / "m1.mat", state, root @ root.T), type="tree")
    assert (found.name, map_.name, map_.ids) == ("mat", "m1", ("12", "7"))
    assert map_.positions.tolist() == [[2, 3], [-1, 4]]
    np.testing.assert_allclose(map_.joint_covariance.matrix, (root @ root.T)[3:, 3:])
    assert map_.path.tolist() == [[0, 0, 0, 0], [1, 5.0, 1.0, 0.5]]


@pytest.mark.parametrize(
    ("state", "size", "message"),
    [
        ([[0, 1.0], [0, 2.0], [1, 1.0], [1, 1.0]], 4, "three rows of number 0"),
        ([[1, 1.0], [2, 1.0]], 2, "two of each landmark"),
        ([[1, 1.0], [1, 1.0]], 3, "localmap_P: must have 2 rows and columns"),
        ([[1, np.inf], [1, 1.0]], 2, "localmap_st: holds numbers that aren't finite"),
        ([[1, 1.0], [1, 1.0], [1, 1.0], [1, 1.0]], 4, "has a landmark twice"),
        ([[1, 1.0, 2.0]], 1, "has 3 columns"),
    ],
)
def test_broken_submaps_are_refused(tmp_path, state, size, message):
    with pytest.raises(FileFormatError, match=message):
        read_any(submap(tmp_path / "m1.mat", np.array(state), np.eye(size)))


def test_real_submaps_follow_each_other(shared_data):
    """The end of submap i is the start of submap i + 1: trees that both have lie at the same places."""
    folder = shared_data / "vicpark_local_maps"
    maps = [read_any(folder / f"localmap_{k}.mat")[0] for k in (1, 2)]
    both = sorted(set(maps[0].ids) & set(maps[1].ids))
    assert len(both) >= 3
    there = se2.transform(maps[0].path[-1, 1:], np.array([[maps[1][i].x, maps[1][i].y] for i in both]))
    here = np.array([[maps[0][i].x, maps[0][i].y] for i in both])
    assert np.median(np.hypot(*(there - here).T)) < 1.0
