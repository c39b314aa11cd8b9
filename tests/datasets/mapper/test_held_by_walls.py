"""Walls that hold a robot's map straight: lines by hand, pieces followed and seen again, drives against their truth.

Drives are simulated; nothing was tuned on their seeds.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Sensors
from mapfuse.datasets.mapper import WITH_KEYFRAMES, Mapper, MapperConfig
from mapfuse.datasets.mapper.linear import linearise
from mapfuse.datasets.mapper.memory import Keyframe, Memory, Piece
from mapfuse.datasets.mapper.odometry import Motion
from mapfuse.datasets.mapper.walljoins import Join, joined, seen_again, without_rivals
from mapfuse.datasets.mapper.walllines import WallPoints
from mapfuse.datasets.mapper.walltracks import Seen, Walls, followed, followed_walls, numbered, on_lines, seen_walls
from mapfuse.datasets.simulation import MILKA, make_building, simulate_log
from mapfuse.datasets.simulation.simulated_log import Stop

SEEDS = (2_400_000, 2_400_001, 2_400_002, 2_400_003)


def points_of(poses, line, places, sigma=0.02):
    """Places (m, 2) of the map, each seen from one of the poses in turn, on that one line."""
    k = np.arange(len(places)) % len(poses)
    points = se2.transform(se2.inverse(poses[k]), places)
    return WallPoints(k, np.zeros(len(k), dtype=int), points, np.full(len(k), sigma), np.asarray([line], dtype=float))


def test_points_on_the_wall_have_no_residual_and_one_beside_it_has_its_offset_in_sigmas():
    poses = np.array([[0.0, 0.0, 0.3], [4.0, 1.0, 2.0]])
    # the wall y = 2, seen from below: its normal points down
    walls = points_of(poses, [1.0, 2.0], np.array([[0.0, 2.0], [5.0, 2.0], [3.0, 1.9]]))
    r, _, _ = walls.residuals(poses, np.array([[-np.pi / 2, 0.0]]))
    assert r == pytest.approx([0.0, 0.0, 5.0], abs=1e-9)


def test_derivatives_are_those_of_differences():
    rng = np.random.default_rng(0)
    poses, lines = rng.normal(0, 2, (3, 3)), np.array([[0.7, -0.3]])
    walls = points_of(poses, [1.0, 2.0], rng.normal(0, 3, (9, 2)))
    r, by_pose, by_line = walls.residuals(poses, lines)
    h = 1e-6
    for c in range(3):
        step = h * np.eye(3)[c]
        assert by_pose[:, c] == pytest.approx((walls.residuals(poses + step, lines)[0] - r) / h, abs=1e-3)
    for c in range(2):
        step = h * np.eye(2)[c]
        assert by_line[:, c] == pytest.approx((walls.residuals(poses, lines + step)[0] - r) / h, abs=1e-3)


def test_the_best_line_of_moved_poses_is_the_moved_line_and_its_normal_keeps_its_side():
    poses = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [8.0, 0.0, 0.0]])
    walls = points_of(poses, [4.0, 2.0], np.array([[0.0, 2.0], [4.0, 2.0], [8.0, 2.0]]))
    T = np.array([0.5, -1.0, 0.2])
    found = walls.through(np.asarray(se2.compose(T, poses)), np.array([[-np.pi / 2, 0.0]]))
    assert found[0, 0] == pytest.approx(-np.pi / 2 + 0.2, abs=1e-9)
    n = np.array([np.cos(found[0, 0]), np.sin(found[0, 0])])
    assert found[0, 1] == pytest.approx(n @ (se2.transform(T, [4.0, 2.0]) - [4.0, 2.0]), abs=1e-9)


def still(count):
    """Keyframes a metre apart."""
    nothing = Motion((1.0, 0.0, 0.0), (0.0,) * 4, (0.0,) * 9, (1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4), 1.0)
    return [Keyframe(float(k), float(k), nothing) for k in range(count)]


def test_two_points_know_of_a_piece_what_all_its_readings_know():
    """n readings with sigma s along a piece of length 2 a: its middle is known to s / sqrt(n), its slope to s / rms."""
    n, a, s = 400, 1.5, 0.05
    memory = Memory(keyframes=still(1), pieces=[Piece(0, -a, 1.0, a, 1.0, n, True)])
    seen = seen_walls(memory, Sensors(scan_sigma=s), MapperConfig())
    walls, _ = on_lines(seen, np.zeros(1, dtype=int), np.zeros((1, 3)))
    information = walls.sigma**-2.0
    # what is added to the readings' own is half a centimetre per point
    own = 1 / (walls.sigma**2 - 0.005**2)
    t = np.linspace(-a, a, n)
    assert own.sum() == pytest.approx(n / s**2, rel=1e-9)
    assert own @ walls.points[:, 0] ** 2 == pytest.approx((t**2).sum() / s**2, rel=0.01)
    assert (information < own).all()


def corridor(poses, offset=1.0):
    """Both walls of a corridor along x, two metres of each seen from every pose, and the way."""
    memory = Memory(keyframes=still(len(poses)))
    for k, pose in enumerate(poses):
        for y in (offset, -offset):
            ends = se2.transform(se2.inverse(pose), np.array([[pose[0] - 1, y], [pose[0] + 1, y]]))
            memory.pieces.append(Piece(k, *ends.ravel().tolist(), 20, True))
    return seen_walls(memory, Sensors(), MapperConfig()), [frame.way for frame in memory.keyframes]


def test_both_walls_of_a_corridor_are_followed_although_the_map_is_bent():
    true = np.column_stack([np.arange(20.0), np.zeros(20), np.zeros(20)])
    seen, way = corridor(true)
    bent = true.copy()
    bent[:, 2] = 0.03 * np.arange(20)  # half a radian at the end
    bent[1:, :2] = np.cumsum(np.column_stack([np.cos(bent[:-1, 2]), np.sin(bent[:-1, 2])]), axis=0)
    of = followed(seen, bent, way)
    assert len(set(of.tolist())) == 2
    assert (of[0::2] == of[0]).all()
    assert (of[1::2] == of[1]).all()


def test_a_thin_wall_that_was_seen_from_both_sides_is_two():
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 2.0, np.pi], [1.0, 2.0, np.pi]])
    seen, way = corridor(poses)
    wall = np.flatnonzero(np.abs(seen.placed(poses)[..., 1] - 1.0).max(axis=1) < 1e-9)
    of = followed(seen, poses, way)[wall]
    assert len(wall) == 4
    assert of[0] == of[1] != of[2] == of[3]


def test_walls_seen_once_say_nothing_and_those_with_the_most_pieces_come_first():
    assert numbered(np.array([5, 7, 7, 7, 9, 9, -1])).tolist() == [-1, 0, 0, 0, 1, 1, -1]
    assert numbered(np.zeros(0, dtype=int)).tolist() == []


def test_a_line_that_may_be_either_of_two_walls_is_left():
    clear, one, other = Join(0, 1, 1.0, 0.1), Join(2, 3, 1.0, 0.1), Join(2, 4, 1.0, 0.1)
    assert without_rivals([clear, one, other]) == [clear]
    # three pieces of one wall, each two of which may be one, are no rivals
    assert len(without_rivals([one, other, Join(3, 4, 1.0, 0.1)])) == 3
    assert joined(np.array([0, 1, 2, 3, 4, -1]), [one, Join(3, 4, 1.0, 0.1)]).tolist() == [0, 1, 2, 2, 2, -1]


def driven(seed):
    """A laser's drive of 150 m and its mapper."""
    building = make_building(("irregular", "oblique")[seed % 2], seed)
    header, events, truth = simulate_log(
        building, MILKA, np.random.default_rng([seed, 1]), name="milka", stop=Stop(distance=150.0)
    )
    mapper = Mapper(header, WITH_KEYFRAMES)
    for event in events:
        mapper.update(event)
    return mapper, truth


@pytest.fixture(scope="module")
def drives():
    return [driven(seed) for seed in SEEDS]


def errors(finished, truth):
    """Of the keyframes' poses (K, 3) from the true ones, in the map's frame."""
    t = np.array([frame.t for frame in finished.memory.keyframes])
    x, y = (np.interp(t, truth.path[:, 0], truth.path[:, c]) for c in (1, 2))
    theta = np.interp(t, truth.path[:, 0], np.unwrap(truth.path[:, 3]))
    true = se2.between(truth.path[0, 1:4], np.column_stack([x, y, theta]))
    e = finished.smoothed.estimate.poses - true
    e[:, 2] = se2.wrap(e[:, 2])
    return e


def test_walls_hold_a_map_straight_and_its_covariance_holds(drives):
    off, nees, dof = [], 0.0, 0
    for mapper, truth in drives:
        with_walls, without = mapper._finished(True), mapper._finished(False)
        found = [errors(finished, truth) for finished in (without, with_walls)]
        off.append([np.mean(e**2, axis=0) for e in found])
        # far enough from each other that neighbours don't share all of their errors
        which = np.linspace(10, len(found[1]) - 1, 5).astype(int)
        C, _ = with_walls.smoothed.keyframe_covariance(which)
        e = found[1][which].ravel()
        nees += float(e @ np.linalg.solve(C, e))
        dof += len(e)
    rms = np.sqrt(np.mean(off, axis=0))
    assert np.hypot(*rms[1, :2]) < 0.5 * np.hypot(*rms[0, :2])
    assert rms[1, 2] < 0.5 * rms[0, 2]
    # pieces are taken to be a little rougher than they are simulated, so that covariances are rather too large
    low, high = chi2.ppf([0.0005, 0.995], dof)
    assert low / 2 < nees < high


def test_the_optimum_is_the_same_from_a_map_that_is_askew(drives):
    """From the drifted poses and from the true ones; between them lie degrees, and walls are known to a centimetre."""
    mapper, truth = drives[0]
    before = mapper._finished(False)
    found = followed_walls(before.memory, before.smoothed.estimate.poses, mapper.sensors, mapper.config)
    one = mapper.smoothed(before.landmarks, before.memory, found)
    true = before.smoothed.estimate.poses - errors(before, truth)
    points, lines = on_lines(found.seen, found.of, true)
    points = replace(points, anchors=found.points.anchors)
    lines = points.through(true, lines)
    other = mapper.smoothed(before.landmarks, before.memory, replace(found, poses=true, points=points, lines=lines))
    assert (one.converged, other.converged) == (True, True)
    assert one.error == pytest.approx(other.error, abs=1e-3)
    assert one.estimate.poses == pytest.approx(other.estimate.poses, abs=2e-3)


def test_the_gradient_with_walls_is_that_of_differences_of_the_error(drives):
    mapper, _ = drives[1]
    before = mapper._finished(False)
    found = followed_walls(before.memory, before.smoothed.estimate.poses, mapper.sensors, mapper.config)
    solved = mapper.smoothed(before.landmarks, before.memory, found)
    rng = np.random.default_rng(1)
    e = replace(solved.estimate, lines=solved.estimate.lines + rng.normal(0, 0.01, found.lines.shape))
    drive = replace(before_drive(mapper, before), walls=found.points)
    at = linearise(drive, e, np.inf)
    rows = len(at.gradient_border) - e.lines.size
    for k in (0, 1, 6, e.lines.size - 1):
        sides = []
        for d in (1e-6, -1e-6):
            lines = e.lines.copy()
            lines.ravel()[k] += d
            sides.append(linearise(drive, replace(e, lines=lines), np.inf, at.node_information).error)
        assert at.gradient_border[rows + k] == pytest.approx((sides[0] - sides[1]) / 2e-6, rel=1e-4, abs=1e-2)


def before_drive(mapper, finished):
    from mapfuse.datasets.mapper.smooth import drive_of

    s = mapper.sensors
    sigma = np.array([s.odometry_scale_sigma, s.odometry_turn_scale_sigma, s.odometry_curve_sigma, s.gyro_bias_sigma])
    bend = (s.compass_bend_sigma, s.compass_bend_length)
    return drive_of(finished.memory, list(finished.landmarks.values()), sigma, s.arm_sigma, bend)


def test_walls_that_moved_between_two_visits_do_not_pull_the_map_along(drives):
    """Each wall seems a metre further away in the second half of the drive."""
    mapper, _ = drives[2]
    before = mapper._finished(False)
    found = followed_walls(before.memory, before.smoothed.estimate.poses, mapper.sensors, mapper.config)
    straight = mapper.smoothed(before.landmarks, before.memory, found)
    found = found.at(straight.estimate)

    def solve(walls: Walls):
        return mapper.smoothed(before.landmarks, before.memory, walls)

    again, _ = seen_again(found, straight, solve)
    assert len(again.lines) < len(found.lines)
    late = found.seen.keyframe > found.seen.keyframe.max() / 2
    ends = found.seen.ends.copy()
    along = np.diff(ends, axis=1)[:, 0]
    left = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
    ends[late] -= left[late, None]
    moved = Walls.numbered(
        Seen(found.seen.keyframe, ends, found.seen.sigma),
        np.where(late, found.of + found.of.max() + 1, found.of),
        straight.estimate.poses,
    )
    wrong = solve(moved)
    _, after = seen_again(moved.at(wrong.estimate), wrong, solve)
    assert after.converged
    apart = after.estimate.poses - straight.estimate.poses
    assert np.hypot(*apart[:, :2].T).max() < 0.5
