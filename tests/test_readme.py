"""What the README shows is run as it stands there, in an empty folder with an environment named .venv."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mapfuse.datasets import read_map
from mapfuse.fusion import read_fused

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)


COMMANDS = [line for block in blocks("sh") for line in block.splitlines()]
MAPFUSE_COMMANDS = [line for line in COMMANDS if line.startswith(".venv/bin/mapfuse ")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty folder in which all mapfuse commands of the README have been run, in their order."""
    place = tmp_path_factory.mktemp("readme")
    (place / ".venv").mkdir()
    (place / ".venv" / "bin").symlink_to(Path(sys.executable).parent)
    for line in MAPFUSE_COMMANDS:
        done = subprocess.run(["bash", "-c", line], cwd=place, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{line}\n{done.stderr}"
    return place


def test_set_up_and_tests_are_one_line_each() -> None:
    assert len([line for line in COMMANDS if line.startswith("python3 -m venv .venv && ")]) == 1
    assert len([line for line in COMMANDS if line.startswith(".venv/bin/pytest")]) == 1
    assert len(COMMANDS) == len(MAPFUSE_COMMANDS) + 2, "a shell line that nothing runs"


def test_commands_leave_what_they_say(folder: Path) -> None:
    assert MAPFUSE_COMMANDS[0] == ".venv/bin/mapfuse demo"
    assert (folder / "floor.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "milka.png").read_bytes().startswith(b"\x89PNG")
    assert read_fused(folder / "floor.fused.json").decision == "merged"


def test_python_examples_run(folder: Path) -> None:
    assert len(blocks("python")) == 1
    done = subprocess.run(
        [sys.executable, "-c", blocks("python")[0]], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("merged ")


def test_example_map_is_a_map(tmp_path: Path) -> None:
    (example,) = blocks("json")
    path = tmp_path / "example.map.json"
    path.write_text(example)
    map_ = read_map(path)
    assert (map_.name, map_.ids) == (json.loads(example)["name"], ("c1", "d4"))
    assert map_["c1"].links[0].connected_to_id == "d4"


def test_every_link_leads_somewhere() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert (ROOT / target).exists(), f"README.md points to {target}"


def test_every_option_named_exists() -> None:
    help_ = subprocess.run(
        [Path(sys.executable).with_name("mapfuse"), "fuse", "--help"], capture_output=True, text=True, check=True
    ).stdout
    table = TEXT[TEXT.index("| command | does |") : TEXT.index("## How to read the answer")]
    for option in set(re.findall(r"`(--[a-z-]+)", table)):
        assert option in help_, option
