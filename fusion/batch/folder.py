"""A folder's files as maps, one file at a time: each holds maps, or there is a reason why it can't be read."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from mapfuse.datasets.errors import FileFormatError, InputError, MapfuseError
from mapfuse.datasets.formats import Format, format_of, formats, read_all
from mapfuse.datasets.formats.registry import check_options, fitting
from mapfuse.datasets.maps import LandmarkMap

from .ledger import LEDGER

_LOG = logging.getLogger(__name__)

#: What the names of mapfuse's own maps end in; other files of its own are no maps.
ENDING = ".map.json"


def read_folder(
    folder: Path,
    without: Path | None = None,
    told: Mapping[str, str] | None = None,
    taken: Counter[str] | None = None,
) -> Iterator[tuple[str, LandmarkMap | str]]:
    """Every map in a folder and below, by path in it (``FILE#PART`` for one of several), or why it can't be read.

    Maps are what `mapfuse.datasets.formats` reads; a file that is none of these is passed over. ``without``: a folder
    that isn't looked into, the run's own; runs of others aren't either. ``told``: options of formats, each for the
    files of those formats that have it. ``taken``: counts the files of each format as they are read.

    Raises `InputError` where there is no such folder, `ConfigError` for an option that no format has.
    """
    if not folder.is_dir():
        raise InputError(folder, "is no folder" if folder.exists() else "there is no such folder")
    check_options(told or {})
    for path, found in _files(folder, None if without is None else without.resolve()):
        if taken is not None and isinstance(found, Format):
            taken[found.name] += 1
        for part, read in _read(path, found, told or {}):
            yield str(path.relative_to(folder)) + part, read


def _files(folder: Path, without: Path | None) -> Iterator[tuple[Path, Format | str]]:
    """Files and folders that are maps, each with its format or why it can't be opened."""
    for where, folders, names in os.walk(folder):
        here = Path(where)
        if (found := _format(here)) is not None:
            yield here, found
        if found is not None or (here / LEDGER).exists():
            folders.clear()
            continue
        folders[:] = sorted(name for name in folders if (here / name).resolve() != without)
        for path in (here / name for name in sorted(names)):
            if (found := _format(path)) is not None:
                yield path, found


def _format(path: Path) -> Format | str | None:
    name = path.name.lower()
    try:
        found = format_of(path)
    except FileFormatError:
        return None
    except InputError as error:
        endings = tuple(ending for one in formats() if one.reads for ending in one.suffixes)
        return str(error) if name.endswith(endings) else None
    if found.name == "map":
        return found if name.endswith(ENDING) else None
    # a picture whose YAML lies beside it is read with that
    return None if name.endswith(".pgm") and path.with_suffix(".yaml").is_file() else found


def _read(path: Path, found: Format | str, told: Mapping[str, str]) -> Iterator[tuple[str, LandmarkMap | str]]:
    if isinstance(found, str):
        yield "", found
        return
    try:
        reading, _ = read_all(path, format=found.name, **fitting(found, told))
    except MapfuseError as error:
        yield "", str(error)
        return
    for remark in reading.remarks:
        _LOG.warning("%s: %s", path, remark)
    several = len(reading.maps) > 1
    for k, map_ in enumerate(reading.maps):
        yield f"#{reading.parts[k]}" if several else "", map_
