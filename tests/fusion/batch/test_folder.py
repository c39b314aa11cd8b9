"""What of a folder is a map: any readable format, and nothing else."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from mapfuse.datasets import Landmark, LandmarkMap, write_map
from mapfuse.datasets.errors import ConfigError, InputError
from mapfuse.fusion.batch.folder import read_folder
from mapfuse.fusion.batch.ledger import LEDGER

LIST = "label,x,y\ntree,0,0\ntree,7,2\n"
LEVEL = """
    vertices:
      - [0, 0, 0, start]
      - [100, 0, 0, end]
    lanes:
      - [0, 1, {bidirectional: [4, true]}]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Maps of three formats, and what else lies in folders."""
    (tmp_path / "deeper").mkdir()
    (tmp_path / "run").mkdir()
    write_map(LandmarkMap("own", (Landmark("a", "tree", 0.0, 0.0),)), tmp_path / "own.map.json")
    (tmp_path / "deeper" / "list.csv").write_text(LIST)
    (tmp_path / "notes.md").write_text("# Notes\n")
    (tmp_path / "result.fused.json").write_text('{"format": "mapfuse.fused/1"}')
    (tmp_path / "other.json").write_text("{}")
    (tmp_path / "run" / LEDGER).write_bytes(b"")
    (tmp_path / "run" / "pairs.csv").write_text(LIST)
    return tmp_path


def test_maps_of_any_format_are_read_and_all_else_is_passed_over(folder: Path) -> None:
    taken = Counter()
    found = dict(read_folder(folder, told={"position_sigma": "0.05", "corridors": "ways.geojson"}, taken=taken))
    # a file that holds several maps is one file, and one that can't be opened is of no format
    assert sum(taken.values()) == len({path.partition("#")[0] for path in found})
    assert set(taken) > {"map"}
    assert sorted(found) == ["deeper/list.csv", "own.map.json"]
    own, foreign = found["own.map.json"], found["deeper/list.csv"]
    assert isinstance(own, LandmarkMap)
    assert isinstance(foreign, LandmarkMap)
    assert (own.noise.position_sigma, foreign.noise.position_sigma) == (0.3, 0.05)


def test_what_breaks_a_rule_is_said_and_the_rest_is_read(folder: Path) -> None:
    (folder / "broken.map.json").write_text("{")
    (folder / "broken.csv").write_text("label,x,y\ntree,0,east\n")
    (folder / "gone.map.json").symlink_to(folder / "nowhere")
    found = dict(read_folder(folder))
    assert {name for name, read in found.items() if isinstance(read, str)} == {
        "broken.csv",
        "broken.map.json",
        "gone.map.json",
    }
    assert all(name in str(found[name]) for name in ("broken.csv", "broken.map.json", "gone.map.json"))
    assert isinstance(found["own.map.json"], LandmarkMap)


def test_several_maps_of_a_file_are_told_apart(folder: Path) -> None:
    (folder / "two.building.yaml").write_text(f"name: two\nlevels:\n  L1:{LEVEL}  L2:{LEVEL}")
    found = dict(read_folder(folder))
    assert {"two.building.yaml#L1", "two.building.yaml#L2"} < set(found)


def test_wrong_folders_and_options(folder: Path) -> None:
    with pytest.raises(InputError, match="there is no such folder"):
        list(read_folder(folder / "nowhere"))
    with pytest.raises(InputError, match="is no folder"):
        list(read_folder(folder / "own.map.json"))
    with pytest.raises(ConfigError, match="no format has an option 'colour'"):
        list(read_folder(folder, told={"colour": "red"}))
