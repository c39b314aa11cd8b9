"""Object lists, MRCLAM folders and bags."""

import math
import shutil

import numpy as np
import pytest

from mapfuse.datasets.errors import ConfigError, FileFormatError, InputError
from mapfuse.datasets.formats import read_all, read_any, rosbag


def read(tmp_path, text, name="it.csv", **options):
    path = tmp_path / name
    path.write_text(text)
    return read_any(path, **options)[0]


def test_titles_in_any_order_and_by_other_names(tmp_path):
    text = "n_obs;Y_m;colour;label;true_id;x_m\n3;2.5;red;chair;c7;1.0\n1;0;;table;;-4\n"
    map_ = read(tmp_path, text)
    first, second = map_.landmarks
    assert (first.id, first.type, first.x, first.y, first.detection_counter) == ("c7", "chair", 1.0, 2.5, 3)
    assert first.extra == {"colour": "red"}
    assert (second.id, second.type, second.x, second.extra) == ("2", "table", -4.0, {})


def test_rows_without_titles(tmp_path):
    text = "# class x y z cxx cxy cyy\n3 1.0 2.0 0.5 0.1 0.02 0.2\n1 4 5 0 0.1 0 0.2\n"
    map_ = read(tmp_path, text, "robot.txt")
    assert map_.name == "robot"
    assert map_.types == ("class-3", "class-1")
    np.testing.assert_allclose(map_["1"].covariance, [[0.1, 0.02], [0.02, 0.2]])
    assert map_["1"].extra == {"z": 0.5}
    assert read(tmp_path, "tree, 1, 2\n", "a.txt").types == ("tree",)
    assert read(tmp_path, "1 2\n3 4\n", "a.txt", type="tree").types == ("tree", "tree")


def test_angles_are_wrapped_and_ids_are_made_unique(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("id,x,y,theta\na,0,0,7.0\na,1,1,\n")
    reading = read_all(path)[0]
    assert reading.maps[0].ids == ("a", "a#2")
    assert reading.maps[0]["a"].heading == pytest.approx(7.0 - 2 * math.pi)
    assert reading.remarks == ("ids that stand more than once (a#2): numbered",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "line 1: has neither titles with x and y nor rows"),
        ("x,y\n1\n", "line 2: has 1 values for 2 columns"),
        ("x,y\n1,two\n", "line 2: y is 'two', which is no number within bounds"),
        ("x,y\n1,1e400\n", "line 2: y is '1e400', which is no number within bounds"),
        ("x,y\n1,inf\n", "line 2: y is 'inf'"),
        ("x,y\n,1\n", "line 2: has no x"),
        ("x,y,x_m\n1,2,3\n", "has two columns for x"),
        ("x,y,cov_xx\n1,2,3\n", "line 2: must have all of cov_xx, cov_xy, cov_yy or none"),
        ("x,y,cov_xx,cov_xy,cov_yy\n1,2,1,5,1\n", "line 2: its covariance "),
        ("x,y,n_obs\n1,2,-3\n", "line 2: detection_counter is -3.0; it must be a count"),
        ("x,y,existence\n1,2,3\n", "line 2: existence is 3.0; it must be a probability"),
        ('x,y\n1,"2\n', "is no CSV"),
        ("3 1.0 2.0 0.5\n3 1.0\n", "line 2: has 2 values for 4 columns"),
    ],
)
def test_broken_lists_are_refused_with_place_and_reason(tmp_path, text, message):
    path = tmp_path / "it.csv"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_any(path)


def test_real_object_lists(shared_data):
    map_, found = read_any(shared_data / "slideslam" / "robot0Map_indoor.txt")
    assert (found.name, len(map_), map_["1"].type) == ("objects", 32, "class-3")
    assert (map_["1"].x, map_["1"].y) == (6.41903, -0.346591)
    tubes, found = read_any(shared_data / "mrclam" / "derived" / "mrclam_ds4_r1.csv", type="tube")
    assert (found.name, len(tubes), tubes["6"].detection_counter) == ("objects", 15, 82)
    assert set(tubes.types) == {"tube"}


def mrclam(folder, every=0.5):
    """Two robots that drive 1 m in 2 s past a tube, of barcode 72 and number 6, 3 m ahead; one of them is a robot."""
    folder.mkdir()
    (folder / "Barcodes.dat").write_text("1 5\n6 72\n")
    for robot, bearing in ((1, 0.0), (3, 0.5)):
        odometry = "".join(f"{100 + k / 10} 0.5 0.0\n" for k in range(21))
        times = 100.5 + np.arange(0.0, 1.01, every)
        seen = "".join(f"{t:.1f} 72 {2.7 - (t - 100.5) / 2:.3f} {bearing}\n" for t in times)
        (folder / f"Robot{robot}_Odometry.dat").write_text(odometry)
        (folder / f"Robot{robot}_Measurement.dat").write_text(seen + "101.0 5 1.0 0.0\n")
    return folder


def test_an_mrclam_folder_is_a_map_of_each_robot(tmp_path):
    folder = mrclam(tmp_path / "set")
    reading, found = read_all(folder)
    assert (found.name, reading.parts) == ("mrclam", ("robot1", "robot3"))
    assert [map_.name for map_ in reading.maps] == ["set-robot1", "set-robot3"]
    assert [map_.types for map_ in reading.maps] == [("tube",), ("tube",)]
    (map_,) = read_all(f"{folder}#robot3")[0].maps
    assert map_ == reading.maps[1]
    with pytest.raises(InputError, match="has no part 'robot2'; there are robot1, robot3"):
        read_all(f"{folder}#robot2")
    with pytest.raises(ConfigError, match="barcodes is 'maybe'; it must be yes or no"):
        read_all(folder, barcodes="maybe")


def test_without_barcodes_tubes_of_mrclam_are_told_apart_by_particles(tmp_path):
    folder = mrclam(tmp_path / "set", every=0.1)
    (known,) = read_all(f"{folder}#robot1")[0].maps
    (map_,) = read_all(f"{folder}#robot1", barcodes="no")[0].maps
    assert (known.ids, map_.ids) == (("6",), ("tube.1",))
    assert map_.positions == pytest.approx(known.positions, abs=0.05)


TUBES = np.array([[3.0, 1.0], [6.0, -1.0], [9.0, 1.5]])


@pytest.mark.parametrize(
    ("kind", "frame", "storage"),
    [("PoseArray", "base_link", "MCAP"), ("PoseArray", "odom", "SQLITE3"), ("MarkerArray", "base_link", "MCAP")],
)
def test_a_bag_becomes_the_map_that_its_messages_say(tmp_path, kind, frame, storage, bag):
    map_, found = read_any(bag(tmp_path / "drive", kind, frame, storage), type="tube")
    assert (found.name, map_.name, map_.types) == ("rosbag", "drive", ("tube",) * 3)
    np.testing.assert_allclose(map_.positions[np.argsort(map_.positions[:, 0])], TUBES, atol=0.05)
    assert map_.joint_covariance is not None


def test_a_bare_mcap_file_is_a_bag_too(tmp_path, bag):
    (file,) = bag(tmp_path / "drive").glob("*.mcap")
    shutil.copy(file, tmp_path / "alone.mcap")
    map_, found = read_any(tmp_path / "alone.mcap", landmarks="/seen", odometry="/odom")
    assert (found.name, map_.name, len(map_)) == ("rosbag", "alone", 3)


def test_topics_and_frames_are_asked_for_by_name(tmp_path, bag):
    path = bag(tmp_path / "drive", second=True)
    with pytest.raises(ConfigError, match=r"option landmarks: several topics could be it \(/other, /seen\): name one"):
        read_any(path)
    with pytest.raises(ConfigError, match="no such topic '/what'; there are /other, /seen"):
        read_any(path, landmarks="/what")
    with pytest.raises(ConfigError, match="range_sigma must be a number above 0, not '-1'"):
        read_any(path, landmarks="/seen", range_sigma="-1")
    with pytest.raises(FileFormatError, match="are in the frame 'camera', which is neither the robot's"):
        read_any(bag(tmp_path / "camera", frame="camera"))


def test_broken_bags_are_refused(tmp_path, bag):
    (file,) = bag(tmp_path / "drive").glob("*.mcap")
    whole = file.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[:3000])
    with pytest.raises(FileFormatError, match="is no bag that can be read"):
        read_any(tmp_path / "cut.mcap")
    (tmp_path / "turned.mcap").write_bytes(whole[:400] + whole[400:][::-1][:-8] + whole[-8:])
    with pytest.raises(FileFormatError, match="is no bag that can be read"):
        read_any(tmp_path / "turned.mcap")


def test_a_chunk_that_unpacks_beyond_bounds_is_refused(tmp_path, monkeypatch, bag):
    path = bag(tmp_path / "drive", packed=True)
    assert len(read_any(path)[0]) == 3
    monkeypatch.setattr(rosbag, "MAX_CHUNK_BYTES", 1000)
    with pytest.raises(FileFormatError, match="a chunk unpacks to more than 1,000 bytes"):
        read_any(path)


def test_bags_packed_as_a_whole_are_refused(tmp_path, bag):
    path = bag(tmp_path / "drive")
    metadata = path / "metadata.yaml"
    text = metadata.read_text()
    assert "compression_mode: ''" in text
    metadata.write_text(text.replace("compression_mode: ''", "compression_mode: FILE"))
    with pytest.raises(FileFormatError, match="is compressed by file or by message"):
        read_any(path)


def test_metadata_do_not_lead_out_of_the_folder(tmp_path, bag):
    path = bag(tmp_path / "drive")
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("drive.mcap", "../../elsewhere.mcap"))
    with pytest.raises(FileFormatError, match="leads out of the folder"):
        read_any(path)
