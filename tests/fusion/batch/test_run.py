"""Runs over a folder: what they write, what they do again, and that no kill, full disk or torn file changes a byte."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets import read_map, write_map
from mapfuse.datasets.errors import InputError, MapfuseError, OutputError
from mapfuse.fusion import FusedMap, fuse, read_fused
from mapfuse.fusion.batch.engine import KILLED
from mapfuse.fusion.batch.ledger import LEDGER, Ledger
from mapfuse.fusion.batch.run import status
from mapfuse.fusion.batch.steps import Batch
from mapfuse.fusion.batch.table import PAIR_COLUMNS
from mapfuse.matching.index import MapIndex

pytestmark = pytest.mark.xdist_group("batch")

#: A pair's comparison that also writes down that it was made, and what happens in some of them.
COMPARE = """
    import os, signal
    from pathlib import Path
    from mapfuse.fusion.batch.packing import PairJob
    from mapfuse.fusion.batch.tasks import compare_maps

    HERE = Path(__file__).parent

    def counted(job):
        with (HERE / "compared").open("ab") as file:
            file.write(b"x")
        return compare_maps(job)

    def dies_once(job):
        if (HERE / "compared").exists() and not (HERE / "died").exists():
            (HERE / "died").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return counted(job)

    def dies_of_one_pair(job):
        pair = PairJob.from_bytes(job)
        if b'"elm-1"' in pair.map1 and b'"oak-1"' in pair.map2:
            os.kill(os.getpid(), signal.SIGKILL)
        return counted(job)

    def kills_the_client(job):
        if (HERE / "compared").exists() and (HERE / "compared").stat().st_size == 3:
            os.kill(os.getppid(), signal.SIGKILL)
        return counted(job)
"""
CLIENT = """
import resource, sys
from contextlib import closing
from pathlib import Path
sys.path.insert(0, {modules!r})
import batch_compare
from mapfuse.datasets.errors import OutputError
from mapfuse.fusion.batch.engine import LocalEngine
from mapfuse.fusion.batch.run import run_batch
from mapfuse.fusion.config import FuseConfig

if __name__ == "__main__":
    if {limit}:
        resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
    with closing(LocalEngine(1)) as engine:
        try:
            run_batch(Path({folder!r}), Path({run!r}), FuseConfig(), engine, compare=batch_compare.{task})
        except OutputError as error:
            print(error)
            sys.exit(2)
"""


@pytest.fixture
def compare(helper):
    helper("batch_compare", COMPARE)
    sys.modules.pop("batch_compare", None)
    import batch_compare  # type: ignore[import-not-found]

    return batch_compare


@pytest.fixture
def client(tmp_path, folder, compare):
    """Runs a client of its own; gives how it ended."""

    def start(run: Path, task: str, limit: int = 0) -> subprocess.CompletedProcess[str]:
        script = tmp_path / "client.py"
        text = CLIENT.format(
            modules=str(Path(compare.__file__).parent), folder=str(folder), run=str(run), task=task, limit=limit
        )
        script.write_text(text)
        return subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False)

    return start


def compared(compare) -> int:
    """How many pairs were compared since the last call."""
    path = Path(compare.__file__).with_name("compared")
    count = path.stat().st_size if path.exists() else 0
    path.unlink(missing_ok=True)
    return count


NOT_COMPARED = ("oak-1", "oak-3")


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_folder_becomes_groups_and_is_only_done_once(folder, tmp_path, compare, fuse_folder, files_of, tree_map):
    run = tmp_path / "run"
    summary = fuse_folder(folder, run, compare=compare.counted)
    assert (summary.maps, summary.unreadable, summary.pairs, summary.failed_pairs) == (5, 1, 10, 0)
    assert (summary.groups, summary.grouped) == (2, 5)
    assert compared(compare) == 10
    assert "broken.map.json" in summary.problems[0]
    assert "is not complete JSON" in summary.problems[0]

    pairs = rows_of(run / "pairs.csv")
    assert tuple(pairs[0]) == PAIR_COLUMNS
    merged = {(row["map1"], row["map2"]) for row in pairs if row["decision"] == "merged"}
    assert merged == {("elm-1", "elm-2"), ("oak-1", "oak-2"), ("oak-1", "oak-3"), ("oak-2", "oak-3")}
    fused = [read_fused(run / "groups" / f"{k:04d}.fused.json") for k in (1, 2)]
    assert [f.groups for f in fused] == [(("elm-1", "elm-2"),), (("oak-1", "oak-2", "oak-3"),)]
    assert all((run / "groups" / f"{k:04d}.png").read_bytes().startswith(b"\x89PNG") for k in (1, 2))
    first = next(row for row in pairs if row["map1"] == "oak-1")
    T12 = next(pair for pair in fused[1].pairs if pair.maps == ("oak-1", first["map2"])).T12
    assert [float(first[k]) for k in ("x", "y", "theta", "cov_xt")] == [T12.x, T12.y, T12.theta, T12.covariance[0, 2]]

    # the group is what fusing its maps gives
    direct = fuse([read_map(folder / f"oak-{k}.map.json") for k in (1, 2, 3)])
    assert direct.groups == fused[1].groups
    assert fused[1].probability == pytest.approx(direct.probability)
    for name in direct.frames:
        np.testing.assert_allclose(fused[1].frames[name].T.array, direct.frames[name].T.array, atol=1e-9)
    assert len(direct.landmarks) == len(fused[1].landmarks)

    maps = {row["map"]: row for row in rows_of(run / "maps.csv")}
    assert maps["oak-3"]["group"] == "2"
    assert float(maps["oak-3"]["x"]) == fused[1].frames["oak-3"].T.x
    assert "is not complete JSON" in maps[""]["error"]
    state = status(run)
    assert (state.maps, state.unreadable, state.pairs, state.done, state.finished) == (5, 1, 10, 10, True)

    # again: nothing; a map changed: its pairs; a map added: its pairs; a map gone or left out: nothing
    before = files_of(run)
    fuse_folder(folder, run, compare=compare.counted)
    assert compared(compare) == 0
    assert files_of(run) == before
    changed = read_map(folder / "oak-3.map.json")
    write_map(changed.replace(landmarks=changed.landmarks[:-1]), folder / "oak-3.map.json")
    fuse_folder(folder, run, compare=compare.counted)
    assert compared(compare) == 4
    write_map(changed, folder / "oak-3.map.json")
    write_map(
        tree_map("ash", np.random.default_rng(1).uniform(0, 30, (8, 2)), np.random.default_rng(2)),
        folder / "ash.map.json",
    )
    assert fuse_folder(folder, run, compare=compare.counted).pairs == 15
    assert compared(compare) == 5
    left = fuse_folder(folder, run, compare=compare.counted, without=["ash", "elm-1"])
    assert (left.maps, left.groups, compared(compare)) == (4, 1, 0)
    assert sorted(f.name for f in (run / "groups").iterdir()) == ["0001.fused.json", "0001.png"]
    with pytest.raises(MapfuseError, match="no map named 'yew' to leave out"):
        fuse_folder(folder, run, without=["yew"])


def _recorded(fused: FusedMap) -> set[tuple[str, str]]:
    return {(name, i) for landmark in fused.landmarks for name, ids in landmark.sources.items() for i in ids}


def test_a_group_may_hold_pairs_that_were_not_compared(folder, tmp_path, fuse_folder, monkeypatch):
    """The index proposes few of a large folder's pairs: maps are then held together by others."""
    every = MapIndex.pairs
    monkeypatch.setattr(MapIndex, "pairs", lambda index: [p for p in every(index) if (p.map1, p.map2) != NOT_COMPARED])
    monkeypatch.setattr(Batch, "look_again", lambda _: False)
    summary = fuse_folder(folder, tmp_path / "run")
    assert (summary.pairs, summary.groups, summary.grouped, summary.failed_groups) == (9, 2, 5, 0)
    fused = read_fused(tmp_path / "run" / "groups" / "0002.fused.json")
    assert fused.groups == (("oak-1", "oak-2", "oak-3"),)
    assert NOT_COMPARED not in {pair.maps for pair in fused.pairs}
    direct = fuse([read_map(folder / f"oak-{k}.map.json") for k in (1, 2, 3)])
    for name in direct.frames:
        np.testing.assert_allclose(fused.frames[name].T.array, direct.frames[name].T.array, atol=0.02)
    # what only the two have in common nothing identifies
    assert _recorded(fused) == _recorded(direct)
    without2 = [{frozenset(l.sources) for l in f.landmarks if "oak-2" not in l.sources} for f in (fused, direct)]
    assert without2 == [{frozenset({"oak-1"}), frozenset({"oak-3"})}, {frozenset({"oak-1", "oak-3"})}]


def test_pairs_that_the_index_left_out_are_compared_where_their_group_asks_for_it(
    folder, tmp_path, fuse_folder, files_of, monkeypatch
):
    fuse_folder(folder, tmp_path / "all")
    every = MapIndex.pairs
    monkeypatch.setattr(MapIndex, "pairs", lambda index: [p for p in every(index) if (p.map1, p.map2) != NOT_COMPARED])
    assert fuse_folder(folder, tmp_path / "run").pairs == 10
    fused, direct = (read_fused(tmp_path / run / "groups" / "0002.fused.json") for run in ("run", "all"))
    assert len(fused.landmarks) == len(direct.landmarks)
    # what the first look left out the second one adds behind, and a run that goes on finds the same
    before = files_of(tmp_path / "run")
    again = fuse_folder(folder, tmp_path / "run")
    assert (again.pairs, files_of(tmp_path / "run")) == (10, before)


def test_deaths_change_no_byte(folder, tmp_path, compare, client, fuse_folder, files_of):
    undisturbed = tmp_path / "undisturbed"
    fuse_folder(folder, undisturbed)
    expected = files_of(undisturbed)

    # a worker
    killed = tmp_path / "worker"
    assert fuse_folder(folder, killed, compare=compare.dies_once).failed_pairs == 0
    assert Path(compare.__file__).with_name("died").exists()
    assert files_of(killed) == expected
    compared(compare)

    # the client, twice, and then the ledger's last page
    run = tmp_path / "client"
    assert client(run, "kills_the_client").returncode == -9
    with Ledger.to_read(run / LEDGER) as ledger:
        assert 0 < ledger.counts()[1] < 10
    compared(compare)
    assert client(run, "kills_the_client").returncode == -9
    before = compared(compare)
    assert not (run / "pairs.csv").exists()
    fuse_folder(folder, run, compare=compare.counted)
    assert before + compared(compare) < 10, "what was done before the kills is not done again"
    assert files_of(run) == expected
    torn = bytearray((run / LEDGER).read_bytes())
    torn[-4096:] = b"\xa5" * 4096
    (run / LEDGER).write_bytes(bytes(torn))
    fuse_folder(folder, run)
    assert files_of(run) == expected

    # the disk
    full = tmp_path / "full"
    ended = client(full, "counted", limit=200_000)
    assert ended.returncode == 2, ended.stderr
    assert "can't be written" in ended.stdout
    fuse_folder(folder, full)
    assert files_of(full) == expected


def test_a_pair_that_kills_its_workers_is_recorded_and_the_rest_goes_on(folder, tmp_path, compare, fuse_folder):
    run = tmp_path / "run"
    summary = fuse_folder(folder, run, compare=compare.dies_of_one_pair)
    assert (summary.failed_pairs, summary.groups, summary.grouped, summary.flawless) == (1, 2, 5, False)
    assert f"elm-1 and oak-1: {KILLED}" in summary.problems
    (failed,) = [row for row in rows_of(run / "pairs.csv") if row["error"]]
    assert (failed["map1"], failed["map2"], failed["decision"], failed["error"]) == ("elm-1", "oak-1", "", KILLED)
    assert json.loads((run / "summary.json").read_text())["failed_pairs"] == 1


def test_mistakes_of_the_user_are_said(tmp_path, folder, fuse_folder):
    with pytest.raises(InputError, match="there is no such folder"):
        fuse_folder(tmp_path / "nowhere", tmp_path / "run")
    with pytest.raises(InputError, match="no batch has run here"):
        status(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="can't be made"):
        fuse_folder(folder, tmp_path / "file")


def test_commands(folder, tmp_path, command, capsys, compare):
    """A folder from the command line; its state; and a map taken out of a fused file again."""
    run = tmp_path / "run"
    assert command("batch", folder, "-o", run, "--jobs", 1) == 0
    said = capsys.readouterr()
    assert "5 maps: 5 in 2 groups, 0 alone; 10 of 10 pairs compared; failed: 1 files, 0 pairs, 0 groups" in said.out
    assert "broken.map.json: is not complete JSON" in said.err
    assert command("batch", folder, "-o", run, "--strict") == 2
    assert command("batch", "--status", run) == 0
    assert "10 of 10 pairs done, 100.0 %, 0 of them failed" in capsys.readouterr().out
    assert command("batch", folder) == 2
    assert "with -o, the folder of the run" in capsys.readouterr().err

    group = run / "groups" / "0002.fused.json"
    out = tmp_path / "two.fused.json"
    assert command("fuse", group, "--without", "oak-2", "-o", out) == 0
    two = fuse([read_map(folder / f"oak-{k}.map.json") for k in (1, 3)])
    assert read_fused(out) == two
    assert command("fuse", group, "--without", "yew", "-o", out) == 2
    assert "--without yew: there is no such map; there are oak-1, oak-2, oak-3" in capsys.readouterr().err
    bare = tmp_path / "bare.fused.json"
    assert command("fuse", group, "--without", "oak-2", "-o", bare, "--no-embed") == 0
    assert command("fuse", bare, "--without", "oak-1", "-o", out) == 2
    assert "written with --no-embed" in capsys.readouterr().err
