"""MRCLAM folders as logs: velocities put together to poses, barcodes to tubes, and nothing of the truth in a log."""

import numpy as np
import pytest

from mapfuse.datasets import mrclam, se2
from mapfuse.datasets.errors import FileFormatError, InputError, MapfuseError
from mapfuse.datasets.logfile import read_log, write_log
from mapfuse.datasets.logreport import LogReport
from mapfuse.datasets.logs import Detection, Odometry
from mapfuse.datasets.mrclam import SENSORS, read_mrclam_log, read_mrclam_truth

START = 1248275403.0


@pytest.fixture
def folder(tmp_path):
    """A folder as published, of one robot: a quarter circle of radius 1 m to the left, then 2 m ahead, then a stop."""
    quarter = np.pi / 2
    files = {
        "Barcodes": "# Subject #    Barcode #\n 1 5\n 6 14\n 7 41\n",
        "Landmark_Groundtruth": "# head\n 6 1.0 2.0 0.0001 0.001\n 7 3.0 4.0 0.0001 0.001\n",
        "Robot1_Odometry": "# head\n"
        f"{START + 1.25:.3f} 2.0 0.0\n"
        f"{START + 0.25:.3f} {quarter!r} {quarter!r}\n"
        f"{START + 2.25:.3f} 0.0 0.0\n"
        f"{START + 2.25:.3f} 0.0 0.0\n"
        f"{START + 9.25:.3f} 1.0 0.0\n",
        "Robot1_Measurement": "# head\n"
        f"{START + 2.25:.3f} 14 1.5 0.25\n"
        f"{START + 0.5:.3f} 41 2.5 -0.25\n"
        f"{START + 0.6:.3f} 5 1.0 0.0\n"
        f"{START + 0.7:.3f} 99 1.0 0.0\n",
    }
    for name, text in files.items():
        (tmp_path / f"{name}.dat").write_text(text)
    return tmp_path


@pytest.fixture
def _perfect_wheels(monkeypatch):
    for name, value in (("DISTANCE", 1.0), ("TURN", 1.0), ("CURVE", 0.0)):
        monkeypatch.setattr(mrclam, name, value)


@pytest.mark.usefixtures("_perfect_wheels")
def test_velocities_become_the_poses_of_arcs_and_lines(folder):
    moves = [e for e in read_mrclam_log(folder, 1).events if isinstance(e, Odometry)]
    assert [m.t for m in moves] == [0.25, 1.25, 2.25, 9.25]
    poses = np.array([(m.x, m.y, m.theta) for m in moves])
    # a quarter circle of radius 1 to the left ends at (1, 1) facing left
    quarter = np.pi / 2
    np.testing.assert_allclose(poses[0], 0)
    np.testing.assert_allclose(poses[1], [1, 1, quarter], atol=1e-9)
    np.testing.assert_allclose(poses[2:], [[1, 3, quarter]] * 2, atol=1e-9)


@pytest.mark.usefixtures("_perfect_wheels")
def test_a_velocity_is_held_for_a_second_at_most(folder):
    file = folder / "Robot1_Odometry.dat"
    file.write_text(f"{START:.3f} 0.5 0.0\n{START + 20:.3f} 0.0 0.0\n")
    *_, last = [e for e in read_mrclam_log(folder, 1).events if isinstance(e, Odometry)]
    assert (last.t, last.x) == (20.0, 0.5)


def test_what_the_wheels_are_known_to_do_is_taken_off(folder):
    # a metre ahead while the wheels say 1 / 0.937 of it: the robot bends to the right by 0.035 rad of each of these
    stated = 1 / mrclam.DISTANCE
    file = folder / "Robot1_Odometry.dat"
    file.write_text(f"{START:.3f} {stated!r} 0.0\n{START + 1:.3f} 0.0 1.0\n{START + 2:.3f} 0.0 0.0\n")
    _, ahead, turned = [e for e in read_mrclam_log(folder, 1).events if isinstance(e, Odometry)]
    assert np.hypot(ahead.x, ahead.y) == pytest.approx(1, abs=1e-3)
    assert ahead.theta == pytest.approx(-0.035 * stated)
    assert turned.theta - ahead.theta == pytest.approx(0.912)


def test_tubes_are_detections_and_robots_and_misread_barcodes_are_left_out(folder):
    seen = [e for e in read_mrclam_log(folder, 1).events if isinstance(e, Detection)]
    assert seen == [Detection(0.5, "tube", 2.5, -0.25, id="7"), Detection(2.25, "tube", 1.5, 0.25, id="6")]
    dropped = [e for e in read_mrclam_log(folder, 1, barcodes=False).events if isinstance(e, Detection)]
    assert dropped == [Detection(0.5, "tube", 2.5, -0.25), Detection(2.25, "tube", 1.5, 0.25)]


def test_events_are_in_order_and_odometry_comes_before_what_is_seen_from_it(folder):
    events = list(read_mrclam_log(folder, 1).events)
    assert [e.t for e in events] == sorted(e.t for e in events)
    assert [type(e) for e in events if e.t == 2.25] == [Odometry, Detection]


def test_the_header_says_whose_log_it_is_and_when_it_began(folder):
    header = read_mrclam_log(folder, 1).header
    assert header.name == f"{folder.name}-robot1"
    assert header.robot == "robot1"
    assert header.recorded_at == "2009-07-22T15:10:03Z"
    assert header.sensors == SENSORS


def test_truth_names_the_tube_of_each_detection_and_where_it_is(folder):
    truth = read_mrclam_truth(folder, 1)
    assert truth.detections == ("7", "6")
    assert {k: xy.tolist() for k, xy in truth.places.items()} == {"6": [1, 2], "7": [3, 4]}
    assert truth.types == {"6": "tube", "7": "tube"}
    assert truth.path.shape == (0, 4)


def test_true_poses_begin_where_the_odometry_does(folder):
    rows = [(START, 0, 0, 3.0), (START + 0.5, 1, 2, -3.0), (START + 1, 2, 4, -2.5)]
    (folder / "Robot1_Groundtruth.dat").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    path = read_mrclam_truth(folder, 1).path
    np.testing.assert_allclose(path[:, 0], [0.25, 0.5, 1.0])
    # half way between both, and the turn goes the short way through pi
    np.testing.assert_allclose(path[0, 1:3], [0.5, 1])
    np.testing.assert_allclose(np.diff(path[:, 3]), [np.pi - 3, 0.5])


def test_all_broken_lines_of_a_file_are_named(folder):
    file = folder / "Robot1_Measurement.dat"
    file.write_text("# head\n1 2 3 4\n1 2 3\n1 2 3 nan\n1 two 3 4\n")
    with pytest.raises(FileFormatError, match=r"Robot1_Measurement\.dat: 3 problems") as caught:
        read_mrclam_log(folder, 1)
    assert [problem.place for problem in caught.value.problems] == ["line 3", "line 4", "line 5"]


def test_what_is_missing_is_one_clear_error(folder):
    with pytest.raises(MapfuseError, match="no robot 6"):
        read_mrclam_log(folder, 6)
    with pytest.raises(InputError, match=r"Robot2_Odometry\.dat: there is no such file"):
        read_mrclam_log(folder, 2)
    (folder / "Robot1_Odometry.dat").write_text("# head\n")
    with pytest.raises(FileFormatError, match="holds no velocities"):
        read_mrclam_log(folder, 1)


def test_a_recorded_robot_is_read_whole_and_fits_its_truth(shared_data, tmp_path):
    folder = shared_data / "mrclam" / "MRCLAM_Dataset6"
    log, truth = read_mrclam_log(folder, 4), read_mrclam_truth(folder, 4)
    seen = [e for e in log.events if isinstance(e, Detection)]
    # each line of the files is there: odometry, and what isn't a robot, unknown or a double
    lines = sum(not line.startswith("#") for line in (folder / "Robot4_Odometry.dat").read_text().splitlines())
    assert 0 <= lines - (len(log.events) - len(seen)) < 20
    assert tuple(e.id for e in seen) == truth.detections
    # from the true poses, the detections point at their tubes
    t = np.array([e.t for e in seen])
    poses = np.column_stack([np.interp(t, truth.path[:, 0], truth.path[:, k]) for k in (1, 2, 3)])
    local = se2.transform(se2.inverse(poses), np.array([truth.places[i] for i in truth.detections]))
    bearing = se2.wrap(np.arctan2(local[:, 1], local[:, 0]) - [e.bearing for e in seen])
    range_ = np.hypot(*local.T) - [e.range for e in seen]
    assert np.median(np.abs(bearing)) < 0.03
    assert np.median(np.abs(range_)) < 0.15
    # and the log is a valid one, in order
    write_log(log, tmp_path / "a.log.jsonl.gz")
    report = LogReport()
    back = read_log(tmp_path / "a.log.jsonl.gz", strict=True, report=report)
    assert list(back.events) == log.events
