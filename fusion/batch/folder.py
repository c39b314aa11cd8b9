"""A folder's files as maps, one at a time: each is a map, or a reason why it is none."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from mapfuse.datasets.errors import InputError, MapfuseError
from mapfuse.datasets.maps import LandmarkMap

#: What the names of recorded maps end in.
ENDINGS = (".map.json",)


def read_folder(folder: Path, without: Path | None = None) -> Iterator[tuple[str, LandmarkMap | str]]:
    """Every map file in a folder and below, by path in it: the map, or why it can't be read.

    ``without``: a folder that isn't looked into, the run's own. Raises `InputError` where there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(folder, "is no folder" if folder.exists() else "there is no such folder")
    for path in _files(folder, None if without is None else without.resolve()):
        try:
            yield str(path.relative_to(folder)), _read(path)
        except MapfuseError as error:
            yield str(path.relative_to(folder)), str(error)


def _files(folder: Path, without: Path | None) -> Iterator[Path]:
    for here, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if (Path(here) / name).resolve() != without)
        yield from (Path(here) / name for name in sorted(names) if name.endswith(ENDINGS))


def _read(path: Path) -> LandmarkMap:
    from mapfuse.datasets import read_map

    return read_map(path)
