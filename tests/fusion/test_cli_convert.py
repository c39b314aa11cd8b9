"""mapfuse convert and formats, and the other commands on maps of any format."""

import json

import numpy as np
import pytest

from mapfuse.datasets import Landmark, LandmarkMap, Link, read_map, recordings
from mapfuse.datasets.formats import formats, read_any, write_any

LIST = "label,x,y\n" + "".join(
    f"{label},{x},{y}\n"
    for label, x, y in (
        ("tree", 0, 0),
        ("tree", 7, 2),
        ("post", 3, 9),
        ("tree", -6, 4),
        ("post", -2, -8),
        ("tree", 9, -7),
    )
)


@pytest.fixture
def lists(tmp_path):
    """Two lists of the same objects, the second one turned by a quarter and shifted."""
    rows = [line.split(",") for line in LIST.splitlines()[1:]]
    turned = "label,x,y\n" + "".join(f"{label},{5 - float(y)},{float(x) + 2}\n" for label, x, y in rows)
    (tmp_path / "a.csv").write_text(LIST)
    (tmp_path / "b.csv").write_text(turned)
    return tmp_path


def test_formats_are_listed_with_what_they_lose(command, capsys):
    assert command("formats") == 0
    said = capsys.readouterr().out
    for one in formats():
        assert f"{one.name}: {one.title}" in said
    assert "lost in writing: robot" in said
    assert "FILE#PART" in said


@pytest.mark.parametrize("name", [one.name for one in formats() if one.writes])
def test_a_recorded_map_is_converted_to_every_format(command, tmp_path, capsys, name):
    ending = next(one.suffixes[0] for one in formats() if one.name == name)
    source = tmp_path / "m.map.json"
    map_ = read_map(recordings.path("ground-floor-milka"))
    write_any(map_.replace(path=np.array([[0.0, 0, 0, 0], [1.0, 2, 0, 0]])), source)
    target = tmp_path / f"out{ending}"
    assert command("convert", str(source), str(target)) == 0
    said = capsys.readouterr()
    assert f"wrote {target} as " in said.out
    assert f"({name})" in said.out
    assert ("lost: " in said.out) == (name != "map")
    if name in {one.name for one in formats() if one.reads}:
        assert len(read_any(target)[0]) == len(map_)
    assert target.stat().st_size > 50


def test_fuse_takes_any_format_and_says_what_for(command, lists, capsys):
    output = lists / "it.fused.json"
    arguments = ["fuse", str(lists / "a.csv"), str(lists / "b.csv"), "-o", str(output), "--set", "position_sigma=0.05"]
    assert command(*arguments) == 0
    said = capsys.readouterr()
    assert f"{lists / 'a.csv'}: taken for: object list (CSV or text) (objects), 6 landmarks" in said.err
    document = json.loads(output.read_text())
    assert document["maps"] == ["a", "b"]
    assert document["sources"]["a"]["noise"]["position_sigma"] == 0.05


def test_show_takes_any_format(command, lists, capsys):
    assert command("show", str(lists / "a.csv"), "-o", str(lists / "a.png")) == 0
    said = capsys.readouterr()
    assert "taken for: object list" in said.err
    assert (lists / "a.png").read_bytes().startswith(b"\x89PNG")


def test_oddities_are_said_on_standard_error(command, lists, capsys):
    (lists / "c.csv").write_text("id,x,y\na,0,0\na,1,1\n")
    assert command("convert", str(lists / "c.csv"), str(lists / "c.map.json")) == 0
    assert "warning: " in (said := capsys.readouterr().err)
    assert "ids that stand more than once (a#2): numbered" in said


def test_options_and_formats_by_name(command, lists, capsys):
    arguments = ["--set", "type=chair", "--from", "objects", "--to", "nav2"]
    (lists / "plain.list").write_text("x,y\n1,2\n")
    assert command("convert", str(lists / "plain.list"), str(lists / "out.txt"), *arguments) == 0
    assert read_any(lists / "out.txt", format="nav2")[0].types == ("chair",)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.csv", "out.xyz"], "no format is written to such a name"),
        (["a.csv", "a.csv"], "is an input, which would be overwritten"),
        (["missing.csv", "out.map.json"], "missing.csv: there is no such file"),
        (["a.csv", "out.map.json", "--set", "colour"], "--set colour: must be KEY=VALUE"),
        (["a.csv", "out.map.json", "--set", "colour=red"], "has no option 'colour'"),
        (["a.csv", "out.map.json", "--from", "what"], "there is no format 'what'"),
        (["a.csv", "out.map.json", "--to", "rmf"], "rmf is only read"),
        (["a.csv", "out.tum"], "has no path"),
        (["a.csv#level", "out.map.json"], "is one map and has no part 'level'"),
    ],
)
def test_wrong_use_is_one_message_and_no_file(command, lists, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(lists)
    before = sorted(path.name for path in lists.iterdir())
    assert command("convert", *arguments) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert "Traceback" not in said.err
    assert sorted(path.name for path in lists.iterdir()) == before


@pytest.fixture(scope="module")
def fused_file(tmp_path_factory):
    """Two maps of waypoints with more ways than a landmark has links, fused."""
    from mapfuse.fusion import fuse, write_fused

    xy = np.array([(0, 0), (7, 2), (3, 9), (-6, 4), (-2, -8), (9, -7), (14, 3), (-11, -5)], dtype=float)
    folder = tmp_path_factory.mktemp("fused")
    maps = []
    for name, turned in (("a", xy), ("b", np.column_stack([-xy[:, 1] + 5, xy[:, 0] + 2]))):
        ends = {0: (1, 2, 3, 4), 1: (0,), 2: (0,), 3: (0,), 4: (0,)}
        landmarks = tuple(
            Landmark(
                f"{name}{k}",
                "waypoint",
                *at,
                links=tuple(Link(connected_to_id=f"{name}{end}") for end in ends.get(k, ())),
                extra={"ways": [{"to": f"{name}5"}, {"to": f"{name}6"}]} if k == 0 else {},
            )
            for k, at in enumerate(turned.tolist())
        )
        maps.append(LandmarkMap(name, landmarks))
    fused = fuse(maps)
    assert fused.decision == "merged"
    write_fused(fused, folder / "it.fused.json")
    return folder / "it.fused.json"


def test_a_result_becomes_a_graph_that_a_robot_drives_on(command, fused_file, tmp_path, capsys):
    assert command("convert", str(fused_file), str(tmp_path / "it.geojson")) == 0
    assert "lost: " in capsys.readouterr().out
    map_, found = read_any(tmp_path / "it.geojson")
    assert found.name == "nav2"
    assert len(map_) == 8
    document = json.loads((tmp_path / "it.geojson").read_text())
    number = {f["properties"]["metadata"]["mapfuse_id"]: f["properties"]["id"] for f in document["features"][:8]}
    edges = {(f["properties"]["startid"], f["properties"]["endid"]) for f in document["features"][8:]}
    fused = json.loads(fused_file.read_text())
    of = {landmark["sources"]["a"][0]: number[landmark["id"]] for landmark in fused["landmarks"]}
    joined = {(of["a0"], of[f"a{k}"]) for k in (1, 2, 3, 4, 5, 6)}
    assert edges == joined | {(b, a) for a, b in joined}


def test_ways_along_arms_are_those_of_the_merged_links(command, tmp_path):
    paths = [recordings.path(f"ground-floor-{robot}") for robot in ("milka", "vespucci")]
    assert command("fuse", *map(str, paths), "-o", str(tmp_path / "it.fused.json")) == 0
    assert command("convert", str(tmp_path / "it.fused.json"), str(tmp_path / "it.geojson")) == 0
    fused = json.loads((tmp_path / "it.fused.json").read_text())
    links = {(a["id"], link["connected_to_id"]) for a in fused["landmarks"] for link in a["links"]}
    map_ = read_any(tmp_path / "it.geojson")[0]
    ways = {(a.id, link.connected_to_id) for a in map_.landmarks for link in a.links}
    assert ways == {way for a, b in links if b is not None for way in ((a, b), (b, a))}


def test_a_result_becomes_a_picture_for_gis(command, fused_file, tmp_path):
    assert command("convert", str(fused_file), str(tmp_path / "it.gis.geojson")) == 0
    features = json.loads((tmp_path / "it.gis.geojson").read_text())["features"]
    assert sum(feature["properties"]["kind"] == "ellipse" for feature in features) == 8


def test_a_result_without_joint_covariance_is_no_map_to_be_fused_again(command, fused_file, tmp_path, capsys):
    assert command("convert", str(fused_file), str(tmp_path / "it.map.json")) == 2
    assert "joint covariance" in capsys.readouterr().err
    assert command("convert", str(fused_file), str(tmp_path / "it.csv"), "--group", "7") == 2
    assert "there is no group 7" in capsys.readouterr().err
