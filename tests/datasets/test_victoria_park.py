"""Victoria Park in two halves: read as recorded, solved to the optimum, anonymous, and honest about its covariance."""

import subprocess
import sys

import gtsam
import numpy as np
import pytest

from mapfuse.datasets import se2, victoria_park
from mapfuse.datasets.errors import ConfigError, FileFormatError, InputError, MapfuseError
from mapfuse.datasets.landmark_slam import dead_reckoning, solve_drive
from mapfuse.datasets.victoria_park import (
    COVARIANCE_SCALE,
    MAXIMUM_PATH,
    MINIMUM_SIGHTINGS,
    read_recording,
    victoria_park_halves,
    victoria_park_path,
)

O = "ODOMETRY {} {} 1 0 0.1 0.01 0 0 0.01 0 0.01\n"
L = "LANDMARK {} {} {:.4f} {:.4f} 0.4 0 0.4\n"
TREES = {100: (4.0, 1.0), 101: (2.0, 8.0)}


@pytest.fixture(scope="module")
def recording():
    return read_recording(victoria_park_path())


def part_of(recording, first, last):
    return victoria_park._part(recording, first, last)


def matched(map1, map2, truth):
    """Positions of the common trees, (n, 2) in each map, and their rows in it."""
    pairs = truth.true_pairs(map1.name, map2.name)
    rows1 = np.array([map1.index_from_id[a] for a, _ in pairs])
    rows2 = np.array([map2.index_from_id[b] for _, b in pairs])
    return map1.positions[rows1], map2.positions[rows2], rows1, rows2


def test_the_whole_recording_is_read(recording):
    assert recording.drive.pose_count == 6969
    assert len(recording.drive.seen) == 3640
    assert len(recording.trees) == recording.drive.landmark_count == 151
    np.testing.assert_allclose(recording.drive.sightings[0], [11.5387, -3.2007])
    np.testing.assert_allclose(recording.drive.sighting_sigmas, np.sqrt(0.4))
    np.testing.assert_allclose(recording.drive.motion_sigmas[0], [0.01, 0.002, 0.002])


def test_gtsam_is_not_imported_to_find_it():
    code = "import sys; from mapfuse.datasets import victoria_park as v; v.victoria_park_path(); print([*sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "'mapfuse.datasets.victoria_park'" in done.stdout
    assert "'gtsam'" not in done.stdout


def test_where_gtsam_is_absent_the_error_says_so(monkeypatch):
    monkeypatch.setattr(victoria_park, "find_spec", lambda name: None)
    with pytest.raises(MapfuseError, match="gtsam isn't installed"):
        victoria_park_halves()


def gtsam_optimum(drive, poses, landmarks):
    """Error and landmarks by GTSAM's Levenberg-Marquardt; poses are 0.., landmarks 1000000.. in its keys."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.NonlinearEqualityPose2(0, gtsam.Pose2(0, 0, 0)))
    for k, (motion, sigmas) in enumerate(zip(drive.motions, drive.motion_sigmas, strict=True)):
        graph.add(gtsam.BetweenFactorPose2(k, k + 1, gtsam.Pose2(*motion), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    noise = gtsam.noiseModel.Isotropic.Sigma(2, drive.sighting_sigmas[0, 0])
    for pose, landmark, seen in zip(drive.seen_from.tolist(), drive.seen.tolist(), drive.sightings, strict=True):

        def error(factor, at, jacobians, seen=seen):
            here, there = (factor.keys()[k] for k in (0, 1))
            by_pose, by_point = np.zeros((2, 3), order="F"), np.zeros((2, 2), order="F")
            local = at.atPose2(here).transformTo(at.atPoint2(there), by_pose, by_point)
            if jacobians is not None:
                jacobians[0], jacobians[1] = by_pose, by_point
            return local - seen

        graph.add(gtsam.CustomFactor(noise, [pose, 1000000 + landmark], error))
    for k, pose in enumerate(poses):
        values.insert(k, gtsam.Pose2(*pose))
    for k, point in enumerate(landmarks):
        values.insert(1000000 + k, point)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-10)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    found = np.array([result.atPoint2(1000000 + k) for k in range(len(landmarks))])
    marginals = gtsam.Marginals(graph, result)
    return graph.error(result), found, [marginals.marginalCovariance(1000000 + k) for k in range(len(landmarks))]


def test_gtsam_finds_no_better_optimum_and_the_same_covariance(recording):
    # two thirds of the first half, whose descent stops early from plain dead reckoning; GTSAM's residual of a motion
    # stands in the axes of its end, ours in those of its beginning, hence not the same to the last digit
    part = part_of(recording, 0, 2000)
    solution = solve_drive(part.drive, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    start = solution.poses + rng.normal(0, [0.3, 0.3, 0.02], solution.poses.shape)
    start[0] = 0
    error, landmarks, covariances = gtsam_optimum(part.drive, start, solution.landmarks + rng.normal(0, 1, (1, 2)))
    assert solution.error == pytest.approx(error, rel=5e-4)
    np.testing.assert_allclose(solution.landmarks, landmarks, atol=0.01)
    for k, covariance in enumerate(covariances):
        mine = solution.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        np.testing.assert_allclose(mine, covariance, rtol=0.02, atol=0.01 * np.trace(covariance))


def test_halves_have_trees_in_common_that_nearly_fit(victoria_park):
    map1, map2, truth = victoria_park
    p1, p2, *_ = matched(map1, map2, truth)
    assert (len(map1), len(map2), len(p1)) == (72, 112, 62)
    apart = np.linalg.norm(se2.align(p1, p2).residuals, axis=1)
    # bent: a rigid fit leaves much, but no tree is another one
    assert 0.5 < np.median(apart) < 1.2
    assert apart.max() < 3


def test_common_trees_differ_by_what_the_covariances_say(victoria_park):
    map1, map2, truth = victoria_park
    p1, p2, rows1, rows2 = matched(map1, map2, truth)
    P1, P2 = (
        m.joint_covariance.matrix[np.ix_(r, r)]
        for m, r in ((map1, (2 * rows1[:, None] + [0, 1]).ravel()), (map2, (2 * rows2[:, None] + [0, 1]).ravel()))
    )
    T12 = se2.align(p1, p2).T12
    for _ in range(10):
        turn = np.kron(np.eye(len(p1)), se2.rotation(T12[2]))
        V = P1 + turn @ P2 @ turn.T
        residual = (p1 - se2.transform(T12, p2)).ravel()
        J = se2.transform_jacobians(T12, p2)[0].reshape(-1, 3)
        WJ = np.linalg.solve(V, J)
        T12 = T12 + np.linalg.solve(J.T @ WJ, WJ.T @ residual)
    chi2 = residual @ np.linalg.solve(V, residual)
    assert 0.4 < chi2 / (len(residual) - 3) < 1.0
    assert chi2 * COVARIANCE_SCALE / (len(residual) - 3) > 1.1


def test_a_map_says_what_it_is_and_is_well_formed(victoria_park):
    map1, map2, _ = victoria_park
    for map_ in (map1, map2):
        assert set(map_.types) == {"tree"}
        assert "cut from one recorded drive" in map_.extra["source"]
        assert min(l.detection_counter for l in map_.landmarks) == MINIMUM_SIGHTINGS
        assert map_.joint_covariance.order == map_.ids
        assert map_.joint_covariance.rows == 2
        assert np.linalg.eigvalsh(map_.joint_covariance.matrix)[0] > 0
        assert map_.path.shape == (MAXIMUM_PATH, 4)
        np.testing.assert_array_equal(map_.path[0], 0)
        assert np.all(np.diff(map_.path[:, 0]) > 0)
    assert map1.path[-1, 0] + map2.path[-1, 0] == 6969 - 2


def test_ids_and_order_give_nothing_away(victoria_park):
    map1, map2, truth = victoria_park
    pairs = truth.true_pairs(map1.name, map2.name)
    assert sum(a == b for a, b in pairs) <= 5
    _, _, rows1, rows2 = matched(map1, map2, truth)
    assert abs(np.corrcoef(rows1, rows2)[0, 1]) < 0.35


def test_truth_frames_are_those_of_the_whole_drive(victoria_park):
    map1, map2, truth = victoria_park
    assert set(truth.landmarks[map1.name]) == set(map1.ids)
    for map_ in (map1, map2):
        places = np.array([truth.places[truth.landmarks[map_.name][i]] for i in map_.ids])
        assert np.median(np.linalg.norm(se2.align(places, map_.positions).residuals, axis=1)) < 2
    np.testing.assert_array_equal(truth.frames[map1.name], 0)
    # half 2 starts near the last pose of half 1, within the drift between
    assert np.linalg.norm(truth.frames[map2.name][:2] - map1.path[-1, 1:3]) < 2


def small_drive(tmp_path, extra=""):
    """Ten poses on an arc that see two trees each time, to the centimetre; nodes 0..9."""
    poses = dead_reckoning(np.tile([1.0, 0.0, 0.1], (9, 1)))
    lines = [O.format(k, k + 1) for k in range(9)]
    for k, pose in enumerate(poses):
        lines += [L.format(k, tree, *se2.transform(se2.inverse(pose), xy)) for tree, xy in TREES.items()]
    path = tmp_path / "drive.txt"
    path.write_text("".join(lines) + extra)
    return path


def test_same_seed_same_halves_other_seed_other_names(tmp_path):
    path = small_drive(tmp_path)
    one, two, other = (victoria_park_halves(np.random.default_rng(seed), path=path) for seed in (1, 1, 2))
    assert one[0] == two[0]
    assert one[1] == two[1]
    assert one[2] == two[2]
    assert [m.ids for m in one[:2]] == [("t1", "t2")] * 2
    places, other_places = ({t.landmarks[m.name][l.id]: (l.x, l.y) for l in m.landmarks} for m, _, t in (one, other))
    assert places == {place: pytest.approx(xy, abs=1e-5) for place, xy in other_places.items()}


@pytest.mark.parametrize("cut", [0.0, 1.0, -3.0, np.nan, 0.1])
def test_a_cut_without_a_half_is_refused(tmp_path, cut):
    with pytest.raises(ConfigError, match="cut is"):
        victoria_park_halves(cut=cut, path=small_drive(tmp_path))


def test_a_half_without_trees_is_refused(tmp_path):
    path = tmp_path / "bare.txt"
    path.write_text("".join(O.format(k, k + 1) for k in range(9)) + L.format(0, 100, 3, 1) * 2)
    with pytest.raises(ConfigError, match="without trees"):
        victoria_park_halves(path=path)


@pytest.mark.parametrize(
    ("extra", "match"),
    [
        ("VERTEX 3 1\n", "line 30: 'VERTEX' is neither"),
        ("ODOMETRY 9 10 1 0\n", "line 30: ODOMETRY needs 11 numbers, not 4"),
        ("LANDMARK 9 100 nan 0 0.4 0 0.4\n", "line 30: not all numbers are finite"),
        ("LANDMARK 9 100 x 0 0.4 0 0.4\n", "line 30: could not convert"),
        ("LANDMARK 9 100 1 0 0.4 0.1 0.4\n", "line 30: the covariance must be diagonal"),
        ("LANDMARK 9 100 1 0 -0.4 0 0.4\n", "line 30: the covariance must be diagonal"),
        ("LANDMARK 77 100 1 0 0.4 0 0.4\n", "unknown poses"),
        ("ODOMETRY 12 13 1 0 0.1 0.01 0 0 0.01 0 0.01\n", "one chain of poses"),
    ],
)
def test_a_broken_recording_is_refused_with_its_place(tmp_path, extra, match):
    with pytest.raises(FileFormatError, match=match):
        read_recording(small_drive(tmp_path, extra))


def test_all_broken_lines_are_listed(tmp_path):
    with pytest.raises(FileFormatError) as caught:
        read_recording(small_drive(tmp_path, "A\nB\n"))
    assert [problem.place for problem in caught.value.problems] == ["line 30", "line 31"]


def test_empty_binary_and_missing_recordings_are_refused(tmp_path):
    (tmp_path / "empty").write_text("")
    (tmp_path / "binary").write_bytes(bytes(range(256)) * 10)
    for name in ("empty", "binary"):
        with pytest.raises(FileFormatError):
            read_recording(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        read_recording(tmp_path / "missing")
