"""Files that are broken or mean harm: one clear error, in bounded memory, and nothing in them is executed."""

import gzip
import io
import re
import struct
import tracemalloc
import zlib

import numpy as np
import pytest

from mapfuse.datasets.errors import FileFormatError, InputError, MapfuseError
from mapfuse.datasets.formats import formats, read_all, read_any, safeyaml, write_any
from mapfuse.datasets.formats.registry import named
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link

FILES = {
    "map": "a.map.json",
    "gis": "a.gis.geojson",
    "nav2": "a.geojson",
    "tmap2": "a.tmap2.yaml",
    "g2o": "a.g2o",
    "objects": "a.csv",
    "parquet": "a.parquet",
}
READ_ONLY = {
    "rmf": (
        "a.building.yaml",
        b"name: a\nlevels:\n  L1:\n    vertices:\n    - [1, 2, 0, k\xc3\xbcche]\n    - [9, 2, 0, b]\n    walls: []\n"
        b"    doors: []\n    lanes: [[0, 1, {}]]\n    measurements: [[0, 1, {distance: [3, 4.0]}]]\n",
    ),
    "isam": ("a.txt", b"LANDMARK 0 1 2.0 3.0 0.1 0 0.1\nLANDMARK 0 2 2.0 3.0 0.1 0 0.1\n"),
    "plan": (
        "a.geojson",
        b'{"type": "FeatureCollection", "units": "m", "name": "k\xc3\xbcche", "features": [{"type": "Feature", '
        b'"properties": {"type": "corridor"}, "geometry": {"type": "LineString", '
        b'"coordinates": [[0.5, 1.5], [20.5, 1.5]]}}]}',
    ),
}
#: What a picture is that has nothing in it: 20 by 20 cells.
BLANK = b"P5\n20 20\n255\n" + bytes([254]) * 400


@pytest.fixture
def sample(tmp_path, bag, graphnav):
    """Makes a valid file of a format: what a reader is given, and which file of it is to be broken."""

    def make(name):
        if name in READ_ONLY:
            path = tmp_path / READ_ONLY[name][0]
            path.write_bytes(READ_ONLY[name][1])
            return path, path
        if name in ("ros_map", "ros_map picture"):
            yaml, picture = tmp_path / "a.yaml", tmp_path / "küche.pgm"
            text = "image: küche.pgm\nresolution: 0.1\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
            yaml.write_text(text + "occupied_thresh: 0.65\nfree_thresh: 0.196\n", encoding="utf-8")
            picture.write_bytes(BLANK)
            return yaml, picture if name.endswith("picture") else yaml
        if name == "mrclam":
            (tmp_path / "Barcodes.dat").write_text("1 5\n6 72\n")
            odometry = tmp_path / "Robot1_Odometry.dat"
            rows = "".join(f"{100 + k / 10} 0.5 0.0\n" for k in range(21))
            odometry.write_text(f"# küche\n{rows}", encoding="utf-8")
            (tmp_path / "Robot1_Measurement.dat").write_text("100.5 72 2.7 0.0\n")
            return tmp_path, odometry
        if name == "rosbag":
            (path,) = bag(tmp_path / "drive").glob("*.mcap")
            return path, path
        if name == "graphnav":
            return tmp_path, graphnav(tmp_path) / "graph"
        if name == "mat":
            from scipy.io import savemat

            path = tmp_path / "a.mat"
            state = np.array([[1, 1.0], [1, 2.0]])
            savemat(path, {"localmap_st": state, "localmap_P": np.eye(2)}, do_compression=True)
            return path, path
        landmarks = (
            Landmark("küche", "tree", 1.0, 2.0, links=(Link(connected_to_id="b"),), covariance=np.eye(2)),
            Landmark("b", "door", 4.0, 2.0, links=(Link(connected_to_id="küche"),), covariance=np.eye(2)),
        )
        path = tmp_path / FILES[name]
        write_any(LandmarkMap("a", landmarks), path, format=name)
        return path, path

    return make


def fault(path, name):
    """What a reader says against a file, empty where it reads it; any other error is a test's failure."""
    try:
        read_all(path, format=name.removesuffix(" picture"))
    except MapfuseError as error:
        return str(error)
    return ""


ALL = [*FILES, *READ_ONLY, "mat", "ros_map", "ros_map picture", "mrclam", "rosbag", "graphnav"]
BINARY = {"parquet", "mat", "ros_map picture", "rosbag", "graphnav"}
TEXT = [name for name in ALL if name not in BINARY]


def test_every_reader_is_tried():
    assert {one.name for one in formats() if one.reads} == {*ALL} - {"ros_map picture"}


@pytest.mark.parametrize("name", ALL)
def test_cut_off_anywhere_it_is_refused_or_still_a_map(sample, name):
    """A file cut off gives one error, or a map of what is left where the rest happens to be whole: never a crash."""
    path, broken = sample(name)
    assert fault(path, name) == ""
    data = broken.read_bytes()
    said = []
    for end in np.linspace(0, len(data) - 2, 25).astype(int):
        broken.write_bytes(data[:end])
        said.append(fault(path, name))
    assert sum(map(bool, said)) >= 5
    assert all(str(path.parent) in text for text in said if text)


@pytest.mark.parametrize("name", ALL)
def test_bytes_turned_at_random_never_crash_a_reader(sample, name):
    path, target = sample(name)
    data = np.frombuffer(target.read_bytes(), dtype=np.uint8)
    rng = np.random.default_rng(7)
    for _ in range(10 if "picture" in name or name == "rosbag" else 25):
        broken = data.copy()
        at = rng.integers(0, len(data), rng.integers(1, 6))
        broken[at] = rng.integers(0, 256, len(at))
        target.write_bytes(broken.tobytes())
        assert len(fault(path, name)) < 20_000


@pytest.mark.parametrize("name", TEXT)
def test_a_wrong_encoding_is_said(sample, name):
    path, target = sample(name)
    text = target.read_bytes().decode()
    latin = text.encode("latin-1")
    target.write_bytes(latin + b"# \xe9\n" if text.isascii() else latin)
    with pytest.raises(FileFormatError, match=r"UTF-8|byte 0x"):
        read_all(path, format=name)


@pytest.mark.parametrize("huge", ["1e400", "-1e300", "9" * 400, "1" + "0" * 5000])
@pytest.mark.parametrize("name", TEXT)
def test_huge_numbers_are_refused_or_leave_a_map_of_finite_places(sample, name, huge):
    """Each number of a file in turn; where it means nothing (a version, a count) the rest may be read."""
    path, target = sample(name)
    text = target.read_bytes().decode()
    numbers = list(re.finditer(r"(?<![\w.])-?\d+(\.\d+)?(?![\w.])", text))
    assert len(numbers) >= 2
    said = []
    for found in numbers[:20]:
        target.write_text(text[: found.start()] + huge + text[found.end() :], encoding="utf-8")
        said.append(fault(path, name))
        if not said[-1]:
            reading, _ = read_all(path, format=name)
            # mapfuse's own rules let a place be anywhere; what lies too far away is refused when maps are fused
            farthest = 1e300 if name in ("map", "gis") else 1e10
            assert all((abs(map_.positions) <= farthest).all() for map_ in reading.maps)
    assert any(said)


@pytest.fixture(scope="module")
def bomb():
    """300 MiB of zeros, packed."""
    packer = zlib.compressobj(1, wbits=31)
    return b"".join(packer.compress(bytes(2**20)) for _ in range(300)) + packer.flush()


@pytest.mark.parametrize("name", [*FILES, *READ_ONLY, "mat", "ros_map"])
def test_a_bomb_of_zeros_is_not_unpacked(tmp_path, bomb, name):
    path = tmp_path / f"a{named(name).suffixes[0]}.gz"
    path.write_bytes(bomb)
    # what isn't read packed is refused for what it is
    whole = name in ("map", "plan", "parquet", "ros_map")
    tracemalloc.start()
    try:
        with pytest.raises(MapfuseError, match=r"a\..*gz" if whole else "unpacks to more than"):
            read_all(path, format=name)
        assert tracemalloc.get_traced_memory()[1] < 300 * 2**20
    finally:
        tracemalloc.stop()


def test_broken_packing_is_said(tmp_path):
    path = tmp_path / "a.csv.gz"
    packed = gzip.compress(b"x,y\n1,2\n" * 100)
    path.write_bytes(packed[:-6])
    with pytest.raises(FileFormatError, match="ends too early"):
        read_any(path)
    path.write_bytes(packed[:12] + b"\xff\xff\xff" + packed[15:])
    with pytest.raises(FileFormatError, match="broken compressed data"):
        read_any(path)


def test_a_bomb_within_a_matlab_file_is_not_unpacked(tmp_path):
    packer = zlib.compressobj(1)
    packed = b"".join(packer.compress(bytes(2**20)) for _ in range(200)) + packer.flush()
    header = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path = tmp_path / "a.mat"
    path.write_bytes(header + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(FileFormatError, match="unpacks to more than"):
        read_any(path)


LAUGHS = "x0: &x0 [a, b, c, d, e, f, g, h, i, j]\n" + "".join(
    f"x{k}: &x{k} [{', '.join([f'*x{k - 1}'] * 10)}]\n" for k in range(1, 12)
)

YAML = [
    (LAUGHS, "holds more than 500,000 values where its aliases are expanded"),
    ("a: &a [*a]\n", "has an alias for something that it stands in itself"),
    ("a: &a {b: *a}\n", "has an alias for something that it stands in itself"),
    ("[" * 5000, "is nested more than 64 levels deep"),
    (
        "a: !!python/object/apply:os.system [touch pwned]\n",
        "has the tag 'tag:yaml.org,2002:python/object/apply:os.system'",
    ),
    ("a: !include /etc/passwd\n", "has the tag '!include'"),
    ("a: 1\na: 2\n", "has the key 'a' twice"),
    ("? [a, b]\n: c\n", "has a key that is no plain value"),
    ("a: " + "9" * 10_000 + "\n", "holds a value that can't be read"),
    ("a: !!bool maybe\n", "holds a value that can't be read"),
    ("a: [1, 2\n", "is no YAML that can be read"),
    ("a: 1\n---\nb: 2\n", "is no YAML that can be read"),
    ("", "is empty"),
    ("a: \x07\n", "is no YAML"),
]


@pytest.mark.parametrize(("text", "message"), YAML, ids=[message[:30] for _, message in YAML])
@pytest.mark.parametrize("name", ["tmap2", "rmf", "ros_map"])
def test_yaml_that_means_harm_is_refused(tmp_path, monkeypatch, name, text, message):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.yaml"
    path.write_text(text)
    tracemalloc.start()
    try:
        with pytest.raises(FileFormatError, match=message.replace("(", r"\(")):
            read_all(path, format=name)
        assert tracemalloc.get_traced_memory()[1] < 50 * 2**20
    finally:
        tracemalloc.stop()
    assert not (tmp_path / "pwned").exists()


def test_aliases_as_programs_write_them_are_read(tmp_path):
    text = "a: &id001 {x: 1}\nb: *id001\nc: 2020-01-01\nd: yes\n<<: {e: 1.5}\n7: {no: x}\n"
    told = safeyaml.loads(text, tmp_path / "a.yaml")
    assert told == {"a": {"x": 1}, "b": {"x": 1}, "c": "2020-01-01", "d": True, "<<": {"e": 1.5}, "7": {"no": "x"}}


@pytest.mark.parametrize("number", ["1e400", "-1e300", "NaN", "9" * 400])
def test_huge_numbers_are_refused_by_their_place(tmp_path, number):
    head = '{"type":"FeatureCollection","features":[{"type":"Feature","properties":{"id":0},"geometry":'
    path = tmp_path / "a.geojson"
    path.write_text(head + '{"type":"Point","coordinates":[' + number + ",0]}}]}")
    with pytest.raises(FileFormatError, match=r"features\[0\].geometry.coordinates\[0\]"):
        read_all(path, format="nav2")


def test_objects_of_python_in_a_matlab_file_are_not_made(tmp_path):
    from scipy.io import savemat

    target = io.BytesIO()
    savemat(target, {"localmap_st": np.array([["a", 1.0]], dtype=object), "localmap_P": {"a": 1}})
    (tmp_path / "a.mat").write_bytes(target.getvalue())
    with pytest.raises(FileFormatError, match="must be a matrix of numbers"):
        read_any(tmp_path / "a.mat")


def test_graphnav_that_is_none(tmp_path):
    pytest.importorskip("bosdyn.api.graph_nav.map_pb2")
    (tmp_path / "waypoint_snapshots").mkdir()
    (tmp_path / "graph").write_bytes(b"\xff\xfe no protobuf")
    with pytest.raises(FileFormatError, match="is no GraphNav graph"):
        read_any(tmp_path)
    (tmp_path / "graph").write_bytes(b"")
    with pytest.raises(InputError, match="without waypoints"):
        read_any(tmp_path)


def test_a_graph_of_a_million_ways_to_nowhere_is_said_shortly(tmp_path):
    lines = ["x,y,colour"] + [f"{k},0,red" for k in range(3000)]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\nx,y,z\n" * 50)
    with pytest.raises(FileFormatError) as caught:
        read_any(tmp_path / "a.csv")
    assert len(str(caught.value).splitlines()) < 30
