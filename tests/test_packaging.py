"""What must hold of the repository itself, so that a fresh clone installs, imports and type-checks."""

from __future__ import annotations

import ast
import fnmatch
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("datasets", "factors", "fusion", "matching")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS = PYPROJECT["tool"]["setuptools"]


def repository_files() -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    return [ROOT / name for name in listed.split("\0") if name and (ROOT / name).is_file()]


def modules_loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd="/", check=True, capture_output=True, text=True)
    return {name.partition(".")[0] for name in run.stdout.split()}


def normalised(requirement: str) -> str:
    name = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert name is not None
    return re.sub(r"[-_.]+", "-", name[0]).lower()


def test_every_folder_with_code_is_a_listed_package_and_the_reverse() -> None:
    found = {
        "mapfuse." + ".".join(file.parent.relative_to(ROOT).parts)
        for folder in FOLDERS
        for file in (ROOT / folder).rglob("__init__.py")
    }
    assert found == set(SETUPTOOLS["packages"])
    for folder in FOLDERS:
        without = [file.parent for file in (ROOT / folder).rglob("*.py") if not (file.parent / "__init__.py").exists()]
        assert not without, "a folder of modules without __init__.py is left out of the wheel"


def test_every_data_file_of_a_package_is_shipped() -> None:
    for file in repository_files():
        parts = file.relative_to(ROOT).parts
        if parts[0] not in FOLDERS or file.suffix in (".py", ".md"):
            continue
        # a folder without modules belongs to the package around it, whose patterns then name it
        home = next(folder for folder in file.parents if (folder / "__init__.py").exists() or folder.parent == ROOT)
        package = "mapfuse." + ".".join(home.relative_to(ROOT).parts)
        inside = str(file.relative_to(home))
        patterns = [p for p in SETUPTOOLS["package-data"].get(package, []) if p.count("/") == inside.count("/")]
        assert any(fnmatch.fnmatch(inside, pattern) for pattern in patterns), f"{file} is not in the wheel"


@pytest.mark.parametrize("folder", FOLDERS)
def test_typed_marker_and_type_checker_link(folder: str) -> None:
    assert (ROOT / folder / "py.typed").is_file()
    link = ROOT / ".links" / "mapfuse" / folder
    assert link.is_symlink()
    assert not link.readlink().is_absolute()
    assert link.resolve() == ROOT / folder


def test_no_other_links() -> None:
    assert {link.name for link in (ROOT / ".links" / "mapfuse").iterdir()} == set(FOLDERS)


def test_no_registry_host_and_no_lock_file() -> None:
    # spelt in halves, or this file would name them
    hosts = re.compile(
        "|".join(["pypi" + r"\.org", "python" + "hosted", "npm" + "js", "deb" + r"\.debian", "index-" + "url"])
    )
    locks = {"uv.lock", "pylock.toml", "poetry.lock", "Pipfile.lock", "pdm.lock", "pip.conf"}
    for file in repository_files():
        assert file.name not in locks, file
        text = file.read_bytes().decode("utf-8", errors="ignore")
        assert not hosts.search(text), f"{file} names a registry's host"


def test_our_folders_are_imported_as_parts_of_mapfuse_only() -> None:
    for file in repository_files():
        if file.suffix != ".py":
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            for name in names:
                assert name.partition(".")[0] not in FOLDERS, f"{file}:{node.lineno} imports bare {name}"


def test_import_layers_name_every_folder() -> None:
    layers = PYPROJECT["tool"]["importlinter"]["contracts"][0]["layers"]
    assert sorted(layers) == sorted(f"mapfuse.{folder}" for folder in FOLDERS)
    assert sorted(PYPROJECT["tool"]["importlinter"]["root_packages"]) == sorted(layers)


def test_reading_maps_loads_no_solver_and_no_plots() -> None:
    loaded = modules_loaded_by("import mapfuse.datasets; mapfuse.datasets.read_map")
    assert loaded.isdisjoint({"gtsam", "matplotlib", "scipy", "filterpy"})


def test_matching_needs_no_solver() -> None:
    assert modules_loaded_by("import mapfuse.matching; mapfuse.matching.propose").isdisjoint({"gtsam", "matplotlib"})


def test_command_line_starts_without_numpy() -> None:
    heavy = {"numpy", "scipy", "gtsam", "matplotlib", "msgspec", "filterpy", "rich"}
    assert modules_loaded_by("import mapfuse.fusion.cli").isdisjoint(heavy)


def test_public_names() -> None:
    from mapfuse import datasets, fusion, matching

    assert {"read_map", "write_map", "LandmarkMap", "Landmark", "Link"} <= set(dir(datasets))
    assert "propose" in dir(matching)
    assert {"fuse", "FuseConfig", "FusedMap", "read_fused", "write_fused"} <= set(dir(fusion))
    for name in fusion.__all__:
        assert getattr(fusion, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'fuze'"):
        fusion.fuze  # noqa: B018


def test_no_lazily_loaded_name_is_a_module_s_name() -> None:
    # importing the module would put it in the place of what the name stands for
    from mapfuse import fusion

    modules = {file.stem for file in (ROOT / "fusion").glob("*.py")}
    assert modules.isdisjoint(fusion.__all__)


def test_constraints_pin_every_dependency() -> None:
    pins = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", pin) for pin in pins), "name==version and nothing else"
    pinned = {normalised(pin) for pin in pins}
    assert len(pinned) == len(pins)
    extras = PYPROJECT["project"]["optional-dependencies"].values()
    wanted = {normalised(r) for r in [*PYPROJECT["project"]["dependencies"], *(r for e in extras for r in e)]}
    assert wanted - {"mapfuse"} <= pinned
