"""Formats are found out by what a file holds, and asked through one interface."""

import gzip
import subprocess
import sys

import pytest

from mapfuse.datasets.errors import ConfigError, FileFormatError, InputError, MapfuseError, OutputError
from mapfuse.datasets.formats import contents, format_of, formats, read_all, read_any, without, write_any
from mapfuse.datasets.formats.contents import SORTS
from mapfuse.datasets.formats.registry import split_part, writer_of
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link

SAMPLES = {
    "map": ("a.json", '{"format": "mapfuse.map/1", "name": "a", "landmarks": []}'),
    "gis": ("a.geojson", '{"type": "FeatureCollection", "mapfuse": "gis/1", "features": []}'),
    "nav2": (
        "a.geojson",
        '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"id": 7}, '
        '"geometry": {"type": "Point", "coordinates": [1, 2]}}]}',
    ),
    "rmf": ("a.yaml", "levels:\n  L1:\n    vertices: []\n"),
    "tmap2": (
        "a.yaml",
        "nodes:\n- node:\n    edges: []\n    name: a\n    pose: {position: {x: 1, y: 2}, orientation: {}}",
    ),
    "g2o": ("a.txt", "VERTEX_SE2 0 0 0 0\n"),
    "isam": ("a.txt", "LANDMARK 0 1 2.0 3.0 0.1 0 0.1\n"),
    "objects": ("a.txt", "# a list\n3 1.0 2.0 0.5\n"),
}


@pytest.mark.parametrize(
    # mapfuse's own maps aren't packed
    ("name", "packed"),
    [(name, packed) for name in SAMPLES for packed in (False, True) if not (packed and name == "map")],
)
def test_a_file_is_taken_for_what_it_holds(tmp_path, name, packed):
    file_name, text = SAMPLES[name]
    path = tmp_path / (file_name + ".gz" * packed)
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    found = format_of(path)
    assert found.name == name
    map_ = read_any(path)[0]
    assert map_.name == ("a-L1" if name == "rmf" else "a")
    assert len(map_) == {"nav2": 1, "tmap2": 1, "isam": 1, "objects": 1}.get(name, 0) or not len(map_)


def test_every_reader_is_in_the_samples_or_has_tests_of_its_own():
    assert {one.name for one in formats() if one.reads} - SAMPLES.keys() == {
        "graphnav",
        "mat",
        "mrclam",
        "parquet",
        "plan",
        "ros_map",
        "rosbag",
    }


def test_listing_formats_imports_none_of_their_libraries():
    code = "from mapfuse.datasets.formats import formats; formats(); import sys; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    loaded = {name.partition(".")[0] for name in run.stdout.split()}
    assert not loaded & {"yaml", "pyarrow", "rosbags", "bosdyn", "google", "pandas", "gtsam", "matplotlib"}
    assert "scipy.io" not in run.stdout.split()


def test_names_and_losses_are_well_formed():
    names = [one.name for one in formats()]
    assert len(set(names)) == len(names)
    for one in formats():
        assert set(one.lost) <= set(SORTS)
        assert one.reads or one.writes
        assert one.suffixes


def test_a_file_of_no_format_and_none_at_all_are_refused(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"\x00\x01")
    with pytest.raises(FileFormatError, match=r"a\.bin: is in no format that mapfuse reads"):
        read_any(tmp_path / "a.bin")
    with pytest.raises(FileFormatError, match="is a folder in no format"):
        read_any(tmp_path)
    with pytest.raises(InputError, match="there is no such file"):
        read_any(tmp_path / "b.csv")
    with pytest.raises(ConfigError, match="there is no format 'nonsense'"):
        read_any(tmp_path / "a.bin", format="nonsense")
    with pytest.raises(OutputError, match="no format is written to such a name"):
        writer_of("a.xyz")
    with pytest.raises(ConfigError, match="rmf is only read"):
        write_any(LandmarkMap("a"), tmp_path / "a.building.yaml", format="rmf")


def test_what_a_file_does_not_say_can_be_told(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("x,y\n1,2\n")
    map_ = read_any(path, type="tree", detection_rate="0.5", position_sigma=0.25)[0]
    assert map_.landmarks[0].type == "tree"
    assert (map_.noise.detection_rate, map_.noise.position_sigma) == (0.5, 0.25)
    with pytest.raises(ConfigError, match="no option 'colour'; it has type, distance_sigma_per_metre"):
        read_any(path, colour="red")
    with pytest.raises(ConfigError, match="detection_rate must be a number, not 'high'"):
        read_any(path, detection_rate="high")
    with pytest.raises(ConfigError, match="option detection_rate: must be a probability between 0 and 1, not 2"):
        read_any(path, detection_rate="2")


def test_own_maps_state_their_noise_themselves(tmp_path):
    write_any(LandmarkMap("a"), tmp_path / "a.map.json")
    with pytest.raises(ConfigError, match="states its own detection_rate"):
        read_any(tmp_path / "a.map.json", detection_rate=0.5)


TWO_LEVELS = """
name: house
levels:
  ground:
    vertices: [[0, 0, 0, hall], [100, 0, 0, ""]]
    measurements: [[0, 1, {distance: [3, 5.0]}]]
  top:
    vertices: [[0, 0, 0, attic], [100, 0, 0, ""]]
    measurements: [[0, 1, {distance: [3, 5.0]}]]
"""


def test_one_of_several_maps_is_named_with_a_hash(tmp_path):
    path = tmp_path / "a.building.yaml"
    path.write_text(TWO_LEVELS)
    assert [map_.name for map_ in read_all(path)[0].maps] == ["house-ground", "house-top"]
    assert read_any(f"{path}#top")[0].ids == ("attic",)
    with pytest.raises(InputError, match=r"holds 2 maps \(ground, top\); name one as .*#ground"):
        read_any(path)
    with pytest.raises(InputError, match="has no level 'cellar'; there are ground, top"):
        read_any(f"{path}#cellar")
    (tmp_path / "b.csv").write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match="is one map and has no part 'top'"):
        read_any(f"{tmp_path / 'b.csv'}#top")


def test_a_hash_in_a_name_that_is_there_belongs_to_the_name(tmp_path):
    path = tmp_path / "a#b.csv"
    path.write_text("x,y\n1,2\n")
    assert split_part(path) == (path, None)
    assert len(read_any(path)[0]) == 1


def test_the_longest_ending_says_what_is_written():
    assert writer_of("a.gis.geojson").name == "gis"
    assert writer_of("a.GEOJSON").name == "nav2"
    assert writer_of("a.map.json").name == "map"
    assert writer_of("a.tmap2.yaml").name == "tmap2"


def test_only_what_a_map_holds_is_said_to_be_lost(tmp_path):
    plain = LandmarkMap("a", (Landmark("1", "tree", 0.0, 0.0),))
    assert write_any(plain, tmp_path / "a.csv")[1] == ("name",)
    told = Landmark("1", "door", 0.0, 0.0, links=(Link("open", 0.0, compass=1.0),))
    assert write_any(LandmarkMap("a", (told,)), tmp_path / "a.csv")[1] == ("name", "arms", "compass")


def test_without_takes_away_every_sort_that_it_names():
    arm = Link("open", 0.0, 0.5, "b", 2.0, 3)
    map_ = LandmarkMap("a", (Landmark("a", "door", 0.0, 0.0, links=(arm,)), Landmark("b", "door", 2.0, 0.0)))
    for sort in contents(map_):
        if sort not in ("name", "ids", "types"):
            # arms are a heading too, and where they go alone it stays
            lost = [sort, "arms"] if sort == "heading" else [sort]
            assert sort not in contents(without(map_, lost))
    assert without(map_, ["arms"])["a"].heading == 0.0


@pytest.mark.parametrize(
    ("name", "library", "extra"),
    [
        ("parquet", "pyarrow", "parquet"),
        ("rosbag", "rosbags.rosbag2", "rosbag"),
        ("graphnav", "bosdyn.api.graph_nav", "graphnav"),
    ],
)
def test_a_missing_library_is_said_with_how_to_get_it(tmp_path, monkeypatch, name, library, extra):
    monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / "graph").write_bytes(b"x")
    assert next(one.extra for one in formats() if one.name == name) == extra
    with pytest.raises(MapfuseError, match=rf"pip install 'mapfuse\[{extra}\]'"):
        read_any(tmp_path / "graph", format=name)


def test_a_folder_that_is_no_set_of_mrclam_is_said(tmp_path):
    with pytest.raises(InputError, match="is no folder of MRCLAM"):
        read_any(tmp_path, format="mrclam")
