"""Small folders of maps whose pairs are compared quickly: trees at known places, two sites, no names in common."""

from __future__ import annotations

import csv
import textwrap
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets import Landmark, LandmarkMap, Noise, se2, write_map
from mapfuse.fusion.batch.engine import LocalEngine
from mapfuse.fusion.batch.run import Summary, run_batch
from mapfuse.fusion.config import FuseConfig

NOISE = Noise(position_sigma=0.05, detection_rate=0.95, false_alarm_rate=0.02)


def _tree_map(name: str, places: np.ndarray, rng: np.random.Generator) -> LandmarkMap:
    """Trees as a robot that started anywhere recorded them."""
    frame = np.array([*rng.uniform(-20, 20, 2), rng.uniform(-3, 3)])
    at = se2.transform(se2.inverse(frame), places) + rng.normal(0, 0.05, places.shape)
    return LandmarkMap(name, tuple(Landmark(f"t{k}", "tree", *xy) for k, xy in enumerate(at.tolist())), noise=NOISE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three maps of one site, two of another, and a file that is no map."""
    rng = np.random.default_rng(8)
    home = tmp_path / "maps"
    home.mkdir()
    for site, names in (("oak", ("oak-1", "oak-2", "oak-3")), ("elm", ("elm-1", "elm-2"))):
        places = rng.uniform(0, 30, (9, 2))
        for name in names:
            write_map(_tree_map(name, places[rng.permutation(9)[:8]], rng), home / f"{name}.map.json")
        assert site
    (home / "broken.map.json").write_text('{"format": "mapfuse.map/1"')
    return home


@pytest.fixture
def helper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Writes a module that workers can import too."""

    def write(name: str, text: str) -> None:
        modules = tmp_path / "modules"
        modules.mkdir(exist_ok=True)
        (modules / f"{name}.py").write_text(textwrap.dedent(text))
        monkeypatch.syspath_prepend(str(modules))

    return write


def _fuse_folder(folder: Path, run: Path, **options: object) -> Summary:
    """`run_batch` with one worker."""
    with closing(LocalEngine(1)) as engine:
        return run_batch(folder, run, FuseConfig(), engine, **options)  # type: ignore[arg-type]


def _files_of(run: Path) -> dict[str, bytes]:
    """All final files of a run, but for the seconds that each pair took, which no two runs share."""
    found = {str(f.relative_to(run)): f.read_bytes() for f in sorted(run.rglob("*")) if f.is_file()}
    final = {name: data for name, data in found.items() if not name.startswith((".", "ledger"))}
    final.pop("pairs.parquet", None)
    rows = list(csv.DictReader(final["pairs.csv"].decode().splitlines()))
    final["pairs.csv"] = repr([{k: v for k, v in row.items() if k != "seconds"} for row in rows]).encode()
    return final


@pytest.fixture
def tree_map():
    """See `_tree_map`."""
    return _tree_map


@pytest.fixture
def fuse_folder():
    """See `_fuse_folder`."""
    return _fuse_folder


@pytest.fixture
def files_of():
    """See `_files_of`."""
    return _files_of
