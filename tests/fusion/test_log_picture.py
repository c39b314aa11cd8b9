"""Pictures of logs and of drives through a building: what is drawn is where it truly is."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.text import Text

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Detection, LogHeader, LogTruth, Odometry, Scan
from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.datasets.simulation import build, salvatori_like
from mapfuse.datasets.truth import Truth
from mapfuse.fusion.show import draw_building, draw_log
from mapfuse.fusion.show.journey import MAX_POSES, journey, poses_at
from mapfuse.fusion.show.log_page import Drive, position_errors

#: Straight ahead for two metres in the world, begun at START; odometry is too long by a tenth and begins elsewhere.
START = np.array([5.0, 9.0, np.pi / 2])
EVENTS = [
    Odometry(0.0, 3.0, 3.0, np.pi),
    Scan(0.0, -np.pi / 2, np.pi, (1.0, None)),
    Detection(0.0, "door", 1.0, np.pi / 2),
    Odometry(1.0, 1.9, 3.0, np.pi),
    Odometry(2.0, 0.8, 3.0, -np.pi),
    Detection(2.0, "corner", 1.0, 0.0),
]
TRUE_PATH = np.array([[0.0, *START], [2.0, 5.0, 11.0, np.pi / 2]])
TRUTH = LogTruth("drive", TRUE_PATH, ("d0", None), {"d0": np.array([4.0, 9.0])}, {"d0": "door"})
MAP = LandmarkMap("drive", (Landmark("a", "door", 0.1, 1.0), Landmark("b", "corner", 3.0, 0.0)))
MAP_TRUTH = Truth({"drive": START}, {"drive": {"a": "d0", "b": None}}, {"d0": np.array([4.0, 9.0])})


def line(axes: Axes, gid: str) -> np.ndarray:
    (found,) = [artist for artist in axes.lines if artist.get_gid() == gid]
    return np.asarray(found.get_xydata())


def dots(axes: Axes, gid: str) -> np.ndarray:
    (found,) = [artist for artist in axes.collections if artist.get_gid() == gid]
    assert isinstance(found, PathCollection)
    return np.asarray(found.get_offsets())


def test_a_journey_begins_at_the_origin_and_counts_turns_on() -> None:
    drive = journey(EVENTS)
    assert drive.odometry == pytest.approx(np.array([[0, 0, 0, 0], [1, 1.1, 0, 0], [2, 2.2, 0, 0]]))
    assert (drive.events, drive.length, drive.duration) == (6, pytest.approx(2.2), 2.0)
    assert drive.detections == pytest.approx(np.array([[0, 1, np.pi / 2], [2, 1, 0]]))
    assert drive.points == pytest.approx(np.array([[0, 1, -np.pi / 2]]))


def test_a_long_drive_is_thinned_evenly_and_keeps_its_ends() -> None:
    count = 10 * MAX_POSES + 3
    drive = journey(Odometry(k / 10, k / 100, 0.0, k / 50) for k in range(count))
    assert len(drive.odometry) <= MAX_POSES + 1
    assert drive.odometry[0, 0] == 0.0
    assert drive.odometry[-1, 0] == (count - 1) / 10
    assert np.ptp(np.diff(drive.odometry[:-1, 0])) < 1e-6
    assert drive.odometry[-1, 3] == pytest.approx((count - 1) / 50)


def test_poses_between_turn_the_short_way() -> None:
    path = np.array([[0.0, 0.0, 0.0, np.pi - 0.1], [1.0, 0.0, 0.0, -np.pi + 0.1]])
    assert se2.wrap(poses_at(path, np.array([0.25]))[0, 2]) == pytest.approx(np.pi - 0.05)


def test_with_a_truth_everything_lies_in_the_world() -> None:
    (axes,) = draw_log(LogHeader("drive"), Drive("drive", journey(EVENTS), TRUTH, MAP)).axes
    assert line(axes, "true path") == pytest.approx(TRUE_PATH[:, 1:3])
    assert line(axes, "odometry")[-1] == pytest.approx([5.0, 11.2])
    assert dots(axes, "detections") == pytest.approx(np.array([[4.0, 9.0]]))
    assert dots(axes, "false alarms") == pytest.approx(np.array([[5.0, 12.0]]))
    assert dots(axes, "scan points") == pytest.approx(np.array([[6.0, 9.0]]))
    drawn = np.concatenate([np.asarray(a.get_offsets()) for a in axes.collections if a.get_gid() == "landmarks"])
    assert sorted(drawn.round(9).tolist()) == [[4.0, 9.1], [5.0, 12.0]]


def test_without_a_truth_it_lies_where_odometry_has_it() -> None:
    (axes,) = draw_log(LogHeader("drive"), Drive("drive", journey(EVENTS))).axes
    assert line(axes, "odometry")[-1] == pytest.approx([2.2, 0.0])
    assert dots(axes, "detections") == pytest.approx(np.array([[0.0, 1.0], [3.2, 0.0]]))


def test_a_path_of_the_map_places_the_detections() -> None:
    path = np.array([[0.0, 0.0, 0.0, 0.0], [2.0, 2.0, 0.0, 0.0]])
    (axes,) = draw_log(LogHeader("drive"), Drive("drive", journey(EVENTS), None, MAP.replace(path=path))).axes
    assert dots(axes, "detections") == pytest.approx(np.array([[0.0, 1.0], [3.0, 0.0]]))
    # from each pose of the map's path on, odometry says how the robot went
    assert line(axes, "mapped path") == pytest.approx(np.array([[0.0, 0.0], [1.1, 0.0], [2.0, 0.0]]))


def test_errors_leave_out_false_alarms() -> None:
    assert position_errors(MAP, MAP_TRUTH) == pytest.approx([0.1])


def test_drives_through_a_building_have_a_panel_each_with_its_true_walls() -> None:
    building = build(salvatori_like())
    drives = [Drive(f"d{k}", journey(EVENTS), TRUTH, MAP.replace(name="drive")) for k in range(8)]
    figure = draw_building(building, drives, truth=MAP_TRUTH)
    assert len(figure.axes) == 6
    text = " ".join(part.get_text() for part in figure.findobj(Text)).replace("\n", " ")
    assert "salvatori-like, simulated: 8 drives" in text
    assert "and 2 drives more" in text
    assert "0.10 m (median) from the true places; 1 not there" in text
    assert "scan point" not in text
    for axes in figure.axes:
        assert not axes.texts
        (walls,) = [a for a in axes.collections if a.get_gid() == "building"]
        assert isinstance(walls, LineCollection)
        assert len(walls.get_segments()) == len(building.walls)
        low, high = building.bounds[:2], building.bounds[2:]
        assert axes.get_xlim()[0] < low[0]
        assert axes.get_ylim()[0] < low[1]
        assert axes.get_xlim()[1] > high[0]
        assert axes.get_ylim()[1] > high[1]


@pytest.mark.parametrize("events", [[], EVENTS[1:2], EVENTS[2:3]], ids=["empty", "scan", "detection"])
def test_a_log_with_next_to_nothing_in_it(events: list[object]) -> None:
    figure = draw_log(LogHeader("nothing"), Drive("nothing", journey(events)))  # type: ignore[arg-type]
    assert figure.get_suptitle() == "nothing: log, no odometry"


def test_a_simulated_log_and_map_say_so() -> None:
    figure = draw_log(LogHeader("drive", "milka"), Drive("drive", journey(EVENTS)), simulated=True)
    assert figure.get_suptitle() == "drive: simulated log by milka, 2 m in 2 s"


def test_matplotlib_is_not_loaded_by_reading_a_journey() -> None:
    code = "import sys; import mapfuse.fusion.show.journey; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
