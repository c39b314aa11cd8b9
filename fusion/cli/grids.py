"""Grids among the maps that were fused, written as one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .console import UsageError, check_outputs, note, say

if TYPE_CHECKING:
    from mapfuse.datasets.extract import Grid
    from mapfuse.fusion import FusedMap


def check_output(target: Path | None, maps: Sequence[Path]) -> None:
    """Raise `UsageError` where the merged grid can't be written, or none of the maps is a grid."""
    if target is None:
        return
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise UsageError(f"--grid {target}: a grid's name ends in .yaml; its picture is written beside it")
    check_outputs({"--grid": target.with_suffix(".pgm")}, maps)
    if not _paths(maps):
        raise UsageError(f"--grid {target}: none of the maps is an occupancy grid")


def _paths(maps: Sequence[Path]) -> list[Path]:
    from mapfuse.datasets.errors import MapfuseError
    from mapfuse.datasets.formats import format_of

    found = []
    for path in maps:
        try:
            if format_of(path).name == "ros_map":
                found.append(path)
        except MapfuseError:
            continue  # said in full where the map is read
    return found


def write_merged(fused: FusedMap, maps: Sequence[Path], target: Path, *, quiet: bool) -> None:
    """Write the grids among ``maps`` as one, each where the result puts it; only where all maps were merged."""
    from mapfuse.datasets.extract import merged_grid, read_grid, write_grid

    if fused.decision != "merged":
        note(f"{target} was not written: the maps were not merged")
        return
    read = [read_grid(path).grid for path in _paths(maps)]
    grids: list[Grid] = [grid for grid in read if grid.name in fused.frames]  # `--without` may have left one out
    poses = [fused.frames[grid.name].T.array for grid in grids]
    written = write_grid(merged_grid(grids, poses, target.stem), target)
    if not quiet:
        say(f"wrote {written[0]} and {written[1]}: {len(grids)} grids in one")
    if len(grids) < len(fused.frames):
        note(f"{target}: holds the grids only, {len(grids)} of {len(fused.frames)} maps")
