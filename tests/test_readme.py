"""What the README shows is run as it stands there, in an empty folder with an environment named .venv."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

from mapfuse.datasets import read_map
from mapfuse.fusion import read_fused
from mapfuse.fusion.cli.demo import CASES

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)


COMMANDS = [line for block in blocks("sh") for line in block.splitlines()]
MAPFUSE_COMMANDS = [line for line in COMMANDS if line.startswith(".venv/bin/mapfuse ")]


def test_set_up_and_tests_are_one_line_each() -> None:
    assert len([line for line in COMMANDS if line.startswith("python3 -m venv .venv && ")]) == 1
    assert len([line for line in COMMANDS if line.startswith(".venv/bin/pytest")]) == 1
    # .ci/run takes these two from here as well
    assert len([line for line in COMMANDS if line.startswith("apt-get install -y ")]) == 1
    assert len([line for line in COMMANDS if line.startswith(".venv/bin/pip install") and "[open3d]" in line]) == 1
    assert len(COMMANDS) == len(MAPFUSE_COMMANDS) + 4, "a shell line that nothing runs"


def test_commands_and_python_run_as_they_stand(tmp_path: Path) -> None:
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv" / "bin").symlink_to(Path(sys.executable).parent)
    said = []
    for line in MAPFUSE_COMMANDS:
        done = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{line}\n{done.stderr}"
        said.append(done.stdout)

    assert MAPFUSE_COMMANDS[0] == ".venv/bin/mapfuse demo"
    demo = tmp_path / "mapfuse-demo"
    decisions = {case.name: read_fused(demo / f"{case.name}.fused.json").decision for case in CASES}
    assert decisions.pop("two-buildings") != "merged"
    assert decisions == {"ground-floor": "merged", "victoria-park": "merged"}
    for case in CASES:
        assert case.about in said[0], "the demo says what each pair is"
        assert (demo / f"{case.name}.png").read_bytes().startswith(b"\x89PNG")
    assert read_fused(tmp_path / "floor.fused.json") == read_fused(demo / "ground-floor.fused.json")
    assert (tmp_path / "floor.png").read_bytes().startswith(b"\x89PNG")
    assert "These two maps overlap" in (tmp_path / "floor.html").read_text()
    assert (tmp_path / "milka.png").read_bytes().startswith(b"\x89PNG")

    (example,) = blocks("python")
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=False)
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


def options_of(command: str) -> set[str]:
    mapfuse = Path(sys.executable).with_name("mapfuse")
    text = subprocess.run([mapfuse, command, "--help"], capture_output=True, text=True, check=True).stdout
    return set(re.findall(r"--[a-z-]+", text))


def test_every_option_named_exists() -> None:
    usage = TEXT[TEXT.index("| command | does |") : TEXT.index("## How to read the answer")]
    rows = re.findall(r"^\| `mapfuse ([a-z]+).*$", usage, flags=re.MULTILINE)
    assert len(rows) > 4
    for command, line in zip(rows, re.findall(r"^\| `mapfuse .*$", usage, flags=re.MULTILINE), strict=True):
        named = set(re.findall(r"`(--[a-z-]+)", line))
        assert named <= options_of(command), command
    beside = usage[usage.index("Of `fuse`, ") :]
    assert set(re.findall(r"`(--[a-z-]+)", beside)) <= options_of("fuse")
