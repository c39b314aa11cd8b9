"""map_server's files: what they mean, round trips, and files that are wrong or hostile."""

import io
import zlib

import numpy as np
import pytest
from PIL import Image

from mapfuse.datasets.errors import FileFormatError, InputError, MapfuseError, OutputError
from mapfuse.datasets.extract import FREE, OCCUPIED, UNKNOWN, Grid, read_grid, write_grid

YAML = "image: a.pgm\nresolution: 0.5\norigin: [1.0, 2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


def pgm(rows, comment=""):
    rows = np.asarray(rows, dtype=np.uint8)
    return f"P5\n{comment}{rows.shape[1]} {rows.shape[0]}\n255\n".encode() + rows.tobytes()


def png(rows, mode="L"):
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(rows), mode=None).convert(mode).save(buffer, "PNG")
    return buffer.getvalue()


def put(folder, text=YAML, image=None, name="a.pgm"):
    """A YAML file and its picture; returns the path of the first."""
    (folder / name).write_bytes(pgm([[0, 254, 205]]) if image is None else image)
    path = folder / "map.yaml"
    path.write_text(text)
    return path


def test_shades_become_cells_and_the_top_row_the_last_one(tmp_path):
    found = read_grid(put(tmp_path, image=pgm([[0, 254, 205], [254, 254, 0]])))
    assert found.grid.cells.tolist() == [[FREE, FREE, OCCUPIED], [OCCUPIED, FREE, UNKNOWN]]
    assert found.grid.name == "map"
    assert found.grid.resolution == 0.5
    assert found.grid.origin.tolist() == [1.0, 2.0, 0.0]
    assert found.remarks == ()


def test_negated_pictures_are_light_where_it_is_occupied(tmp_path):
    found = read_grid(put(tmp_path, YAML.replace("negate: 0", "negate: 1"), pgm([[255, 0, 128]])))
    assert found.grid.cells.tolist() == [[OCCUPIED, FREE, UNKNOWN]]


def test_shades_between_the_thresholds_lean_but_the_commonest_is_what_nobody_saw(tmp_path):
    # occupancy of 147 is 108 / 255 = 0.4235, half of the way from 0.196 to 0.65
    found = read_grid(put(tmp_path, image=pgm([[205, 205, 147, 254]])))
    assert found.grid.cells.tolist() == [[UNKNOWN, UNKNOWN, 50, FREE]]
    assert read_grid(put(tmp_path, YAML + "mode: scale\n", pgm([[147, 147, 254]]))).grid.cells.tolist() == [[50, 50, 0]]


def test_raw_shades_are_values(tmp_path):
    found = read_grid(put(tmp_path, YAML + "mode: raw\n", pgm([[0, 37, 100, 101, 255]])))
    assert found.grid.cells.tolist() == [[0, 37, 100, UNKNOWN, UNKNOWN]]


def test_a_png_with_transparent_cells(tmp_path):
    rows = np.zeros((1, 3, 4), dtype=np.uint8)
    rows[0, :, :3], rows[0, :, 3] = [[0] * 3, [254] * 3, [0] * 3], [255, 255, 0]
    buffer = io.BytesIO()
    Image.fromarray(rows).save(buffer, "PNG")
    found = read_grid(put(tmp_path, YAML.replace("a.pgm", "a.png"), buffer.getvalue(), "a.png"))
    assert found.grid.cells.tolist() == [[OCCUPIED, FREE, UNKNOWN]]


@pytest.mark.parametrize("seed", range(4))
def test_what_is_written_is_read_back(tmp_path, seed):
    rng = np.random.default_rng(seed)
    cells = rng.choice([UNKNOWN, UNKNOWN, FREE, OCCUPIED, 25, 50, 75], (17, 23))
    grid = Grid("it's", cells, float(rng.uniform(0.01, 1)), rng.uniform(-3, 3, 3))
    yaml, image = write_grid(grid, tmp_path / "it's.yaml")
    again = read_grid(yaml).grid
    assert (again.name, again.resolution) == (grid.name, grid.resolution)
    np.testing.assert_array_equal(again.origin, grid.origin)
    # leaning cells have 69 shades
    np.testing.assert_allclose(again.cells, grid.cells, atol=1)
    np.testing.assert_array_equal(again.cells < 0, grid.cells < 0)
    assert image.read_bytes().startswith(b"P5\n")


def test_what_is_written_has_map_savers_shades(tmp_path):
    _, image = write_grid(
        Grid("g", np.array([[UNKNOWN, FREE, OCCUPIED]], dtype=np.int8), 0.1, np.zeros(3)), tmp_path / "g.yaml"
    )
    assert image.read_bytes().split(b"\n255\n")[1] == bytes([205, 254, 0])


def test_a_grid_is_written_to_yaml_only(tmp_path):
    grid = Grid("g", np.zeros((1, 1), dtype=np.int8), 0.1, np.zeros(3))
    with pytest.raises(OutputError, match=r"name ends in \.yaml"):
        write_grid(grid, tmp_path / "g.png")
    with pytest.raises(OutputError, match="folder doesn't exist"):
        write_grid(grid, tmp_path / "none" / "g.yaml")


# Pictures that are elsewhere ------------------------------------------------------------------------------------------


def test_a_picture_outside_the_folder_is_never_read(tmp_path):
    (tmp_path / "secret.pgm").write_bytes(pgm([[0]]))
    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "link.pgm").symlink_to(tmp_path / "secret.pgm")
    for name in ("../secret.pgm", str(tmp_path / "secret.pgm"), "x/../../secret.pgm", "link.pgm"):
        (inner / "map.yaml").write_text(YAML.replace("a.pgm", name))
        with pytest.raises(FileFormatError, match=r"map.yaml: image: .*leads out of the file's folder"):
            read_grid(inner / "map.yaml")


def test_the_picture_of_the_same_name_is_taken_instead_and_said(tmp_path):
    path = put(tmp_path, YAML.replace("a.pgm", "/home/robot/maps/other.pgm"), pgm([[0, 254]]), "map.pgm")
    found = read_grid(path)
    assert found.grid.cells.tolist() == [[OCCUPIED, FREE]]
    assert "lies outside of the file's folder; map.pgm" in found.remarks[0]
    path.write_text(YAML.replace("a.pgm", "missing.pgm"))
    assert "doesn't exist; map.pgm" in read_grid(path).remarks[0]


def test_a_picture_below_the_folder_is_read(tmp_path):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "a.pgm").write_bytes(pgm([[0]]))
    (tmp_path / "map.yaml").write_text(YAML.replace("a.pgm", "pictures/a.pgm"))
    assert read_grid(tmp_path / "map.yaml").grid.cells.tolist() == [[OCCUPIED]]


def test_a_picture_alone_that_says_its_resolution(tmp_path):
    path = tmp_path / "alone.pgm"
    path.write_bytes(pgm([[0, 254]], "# CREATOR: map_saver.cpp 0.050 m/pix\n"))
    found = read_grid(path)
    assert found.grid.resolution == 0.05
    assert "there is no alone.yaml" in found.remarks[0]
    path.write_bytes(pgm([[0, 254]]))
    with pytest.raises(FileFormatError, match=r"no alone\.yaml beside it"):
        read_grid(path)


def test_a_picture_with_its_yaml_beside_it(tmp_path):
    put(tmp_path, YAML, pgm([[254]]), "map.pgm")
    assert read_grid(tmp_path / "map.pgm").grid.resolution == 0.5


# Wrong and hostile files ----------------------------------------------------------------------------------------------

WRONG = {
    "resolution: -1": r"resolution: must be a number from 0\.0001",
    "resolution: .nan": "resolution: must be a number",
    "resolution: true": "resolution: must be a number",
    "resolution: [1]": "resolution: must be a number",
    "resolution: 1.0e+300": "resolution: must be a number",
    "origin: [1, 2]": "origin: must be a list of three numbers",
    "origin: [1, 2, .inf]": "origin: must be a list of three numbers",
    "origin: here": "origin: must be a list of three numbers",
    "negate: 7": "negate: must be a number from 0 to 1",
    "occupied_thresh: 0.1": "free_thresh: must lie below occupied_thresh",
    "mode: best": "mode: must be trinary, scale or raw",
    "image: 3": "image: must be the name of the picture",
    "image: ''": "image: must be the name of the picture",
    'image: "a\\0b"': "image: ",
}


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_member_is_named(tmp_path, line):
    key = line.split(":")[0]
    text = "".join(kept + "\n" for kept in YAML.splitlines() if not kept.startswith(f"{key}:")) + line + "\n"
    with pytest.raises(FileFormatError, match=f"map.yaml: {WRONG[line]}"):
        read_grid(put(tmp_path, text))


def test_all_that_is_wrong_is_said_at_once(tmp_path):
    with pytest.raises(FileFormatError) as error:
        read_grid(put(tmp_path, "image: a.pgm\n"))
    assert [problem.place for problem in error.value.problems] == ["origin", "resolution"]


HOSTILE = {
    "tag": ("!!python/object/apply:os.system ['true']", "which is no plain value"),
    "cycle": ("&a [*a]", "YAML|itself|members"),
    "laughs": (
        "a: &a [x, x]\n"
        + "".join(f"{chr(98 + k)}: &{chr(98 + k)} [*{chr(97 + k)}, *{chr(97 + k)}]\n" for k in range(24)),
        "values|many|large",
    ),
    "deep": ("[" * 5000, "YAML|nested|deep"),
    "binary": ("\x00\x01", "YAML"),
    "list": ("[1, 2]", "holds no members"),
    "empty": ("", "YAML|empty"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_yaml_is_refused(tmp_path, case):
    text, reason = HOSTILE[case]
    with pytest.raises(FileFormatError, match=reason):
        read_grid(put(tmp_path, text))


def test_yaml_that_is_too_long_or_no_text(tmp_path):
    path = put(tmp_path, YAML + "#" * 2**17)
    with pytest.raises(InputError, match="larger than 65,536 bytes"):
        read_grid(path)
    path.write_bytes(b"image: \xff\xfe")
    with pytest.raises(FileFormatError, match="no text in UTF-8"):
        read_grid(path)


def bomb(columns, rows):
    """A PNG of zeros that says it is of that size."""

    def chunk(kind, data):
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    head = columns.to_bytes(4, "big") + rows.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(bytes(100_000)))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(9000, 9000), (12_000, 12_000), (60_000, 60_000)])
def test_a_picture_that_would_unpack_to_too_much_is_refused_unopened(tmp_path, size):
    with pytest.raises(InputError, match="67,108,864"):
        read_grid(put(tmp_path, image=bomb(*size)))


@pytest.mark.parametrize(
    "data", [b"", b"P5", b"P5\n3 3\n255\n\x00", b"P5\n-3 3\n255\n", b"GIF89a", b"\x89PNG\r\n\x1a\n", b"P5\n0 0\n255\n"]
)
def test_a_broken_picture_is_refused(tmp_path, data):
    with pytest.raises(MapfuseError, match=r"a\.pgm: "):
        read_grid(put(tmp_path, image=data))


def test_a_cut_off_png_is_refused(tmp_path):
    data = png(np.zeros((50, 50), dtype=np.uint8))
    with pytest.raises(FileFormatError, match="broken picture"):
        read_grid(put(tmp_path, image=data[: len(data) // 2]))


@pytest.mark.parametrize("seed", range(30))
def test_random_damage_is_read_or_refused(tmp_path, seed):
    rng = np.random.default_rng(seed)
    grid = Grid("g", rng.choice([UNKNOWN, FREE, OCCUPIED], (9, 9)), 0.1, np.zeros(3))
    path, image = write_grid(grid, tmp_path / "g.yaml")
    victim = path if seed % 2 else image
    data = bytearray(victim.read_bytes())
    for place in rng.integers(len(data), size=3):
        data[place] = rng.integers(256)
    victim.write_bytes(bytes(data))
    said = ""
    try:
        read_grid(path)
    except MapfuseError as error:
        said = str(error)
    assert not said or str(tmp_path) in said
