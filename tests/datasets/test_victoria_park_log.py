"""Victoria Park's drive as a log: what the file says, event by event, and with nothing given away where ids go."""

import subprocess
import sys

import msgspec
import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.logfile import read_log, write_log
from mapfuse.datasets.logs import Detection, Odometry
from mapfuse.datasets.victoria_park import read_recording, victoria_park_path
from mapfuse.datasets.victoria_park_log import victoria_park_log, victoria_park_log_truth

O = "ODOMETRY {} {} 1 0 {} 0.01 0 0 0.01 0 0.01\n"
L = "LANDMARK {} {} {} {} 0.4 0 0.4\n"


@pytest.fixture(scope="module")
def recording():
    try:
        return read_recording(victoria_park_path())
    except MapfuseError as error:
        pytest.skip(str(error))


def test_motions_and_sightings_become_events(tmp_path):
    file = tmp_path / "drive.txt"
    quarter = np.pi / 2
    # the trees' numbers 8 and 9 share one numbering with the poses 0 to 3
    lines = [O.format(0, 1, quarter), O.format(1, 2, quarter), L.format(1, 9, 3, 4), L.format(1, 8, 0, -2)]
    file.write_text("".join([*lines, O.format(2, 3, quarter)]))
    log = victoria_park_log(file)
    expected = [(0, 0, 0, 0), (1, 1, 0, quarter), (2, 1, 1, 2 * quarter), (3, 0, 1, 3 * quarter)]
    moves = [(e.t, e.x, e.y, e.theta) for e in log.events if isinstance(e, Odometry)]
    np.testing.assert_allclose(moves, expected, atol=1e-12)
    assert [type(e) for e in log.events] == [Odometry, Odometry, Detection, Detection, Odometry, Odometry]
    first, second = log.events[2:4]
    assert (first.t, first.type, first.id, first.range) == (1.0, "tree", "9", 5.0)
    assert first.bearing == pytest.approx(np.arctan2(4, 3))
    assert (second.t, second.id, second.range, second.bearing) == (1.0, "8", 2.0, -quarter)
    bare = victoria_park_log(file, ids=False)
    assert list(bare.events) == [
        msgspec.structs.replace(e, id=None) if isinstance(e, Detection) else e for e in log.events
    ]


def test_the_drive_is_whole_and_a_valid_log(recording, tmp_path):
    log = victoria_park_log()
    seen = [e for e in log.events if isinstance(e, Detection)]
    moves = np.array([(e.x, e.y, e.theta) for e in log.events if isinstance(e, Odometry)])
    assert (len(moves), len(seen), len({e.id for e in seen})) == (6969, 3640, 151)
    np.testing.assert_allclose(se2.between(moves[:-1], moves[1:]), recording.drive.motions, atol=1e-9)
    assert np.abs(np.diff(moves[:, 2])).max() < 1, "theta counts on"
    write_log(log, tmp_path / "a.log.jsonl")
    assert tuple(read_log(tmp_path / "a.log.jsonl", strict=True).events) == log.events


def test_truth_is_of_the_same_drive(tmp_path):
    # a square of four sides driven twice, two trees; noise free, so that the solution is the drive itself
    file = tmp_path / "drive.txt"
    poses = se2.compose(np.zeros(3), np.zeros(3))[None]
    lines = []
    trees = {100: np.array([0.5, 0.5]), 101: np.array([3.0, -1.0])}
    for k in range(8):
        lines.append(O.format(k, k + 1, np.pi / 2))
        poses = np.concatenate([poses, se2.compose(poses[-1], [1, 0, np.pi / 2])[None]])
        for tree, xy in reversed(trees.items()):
            local = se2.transform(se2.inverse(poses[-1]), xy)
            lines.append(L.format(k + 1, tree, *local.tolist()))
    file.write_text("".join(lines))
    truth = victoria_park_log_truth(file)
    assert truth.detections == ("101", "100") * 8
    for tree, xy in trees.items():
        np.testing.assert_allclose(truth.places[str(tree)], xy, atol=1e-6)
    np.testing.assert_allclose(truth.path[:, 1:3], poses[:, :2], atol=1e-6)
    assert truth.path[:, 0].tolist() == list(range(9))


def test_gtsam_is_not_imported_for_it():
    code = (
        "import sys; from mapfuse.datasets import victoria_park_log as v; v.victoria_park_log(); print([*sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "'gtsam'" not in done.stdout
