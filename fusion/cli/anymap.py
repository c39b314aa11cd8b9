"""Maps in any format, as the commands take them: found out, read, and said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .console import UsageError, note

if TYPE_CHECKING:
    from mapfuse.datasets.formats import Format, Reading
    from mapfuse.datasets.maps import LandmarkMap
    from mapfuse.fusion import FusedMap

#: The help of ``--set``, the same for all commands.
SET_HELP = (
    "What a file of another format doesn't say, as for detection_rate=0.6; see `mapfuse formats`. May be repeated."
)


def options(given: Sequence[str]) -> dict[str, str]:
    """``KEY=VALUE`` as given on the command line."""
    found = {}
    for text in given:
        key, mark, value = text.partition("=")
        if not (mark and key and value):
            raise UsageError(f"--set {text}: must be KEY=VALUE")
        found[key] = value
    return found


def read(path: Path, given: dict[str, str] | None = None, format: str | None = None, *, quiet: bool = False) -> Reading:
    """All maps of a file, of which standard error is told what it was taken for and what was odd in it.

    Of our own maps only oddities are told; ``quiet``: of all maps.
    """
    from mapfuse.datasets.formats import read_all

    reading, found = read_all(path, format=format, **(given or {}))
    if found.name != "map" and not quiet:
        note(f"{path}: {taken_for(found, reading)}")
    for remark in reading.remarks:
        note(f"mapfuse: warning: {path}: {remark}")
    return reading


def taken_for(found: Format, reading: Reading) -> str:
    """What a file was taken for and what is in it, on one line."""
    several = f", {len(reading.maps)} maps ({', '.join(reading.parts)})" if len(reading.maps) != 1 else ""
    landmarks = sum(map(len, reading.maps))
    return f"taken for: {found.title} ({found.name}){several}, {landmarks} landmark{'' if landmarks == 1 else 's'}"


def files_taken_for(taken: Mapping[str, int]) -> str:
    """What the files of a folder were taken for, on one line; ``taken``: how many for each format, by its name.

    >>> files_taken_for({"g2o": 2, "map": 5})
    "files taken: 2 for g2o graph with landmarks (g2o), 5 for mapfuse's own recorded map (map)"
    """
    from mapfuse.datasets.formats.registry import named

    listed = [f"{count} for {named(name).title} ({name})" for name, count in taken.items()]
    return f"files taken: {', '.join(listed)}"


def read_maps(paths: Sequence[Path], given: dict[str, str] | None = None, *, quiet: bool = False) -> list[LandmarkMap]:
    """The maps of all files, of a result those that were fused.

    Raises `UsageError` with the errors of all files, or where two maps have one name.
    """
    from mapfuse.datasets.errors import MapfuseError

    maps: list[tuple[Path, LandmarkMap]] = []
    wrong: list[str] = []
    for path in paths:
        try:
            maps += [(path, map_) for map_ in _maps_in(path, given, quiet=quiet)]
        except MapfuseError as error:
            wrong.append(str(error))
    if wrong:
        raise UsageError("\n".join(wrong))
    path_from_name: dict[str, Path] = {}
    for path, map_ in maps:
        if map_.name in path_from_name:
            raise UsageError(
                f"{path_from_name[map_.name]} and {path}: both maps are named {map_.name!r}; "
                "names tell maps apart, so give them different ones"
            )
        path_from_name[map_.name] = path
    return [map_ for _, map_ in maps]


def _maps_in(path: Path, given: dict[str, str] | None, *, quiet: bool) -> tuple[LandmarkMap, ...]:
    from mapfuse.datasets.errors import InputError

    if (fused := fused_in(path)) is None:
        return read(path, given, quiet=quiet).maps
    if missing := [name for name in fused.maps if name not in fused.sources]:
        raise InputError(path, f"doesn't carry the map {missing[0]!r} (it was written with --no-embed)")
    return tuple(fused.sources[name] for name in fused.maps)


def read_one(
    path: Path, given: dict[str, str] | None = None, format: str | None = None, *, quiet: bool = False
) -> LandmarkMap:
    """The one map of a file (or ``FILE#PART``)."""
    reading = read(path, given, format, quiet=quiet)
    if len(reading.maps) != 1:
        example = f"{path}#{reading.parts[0]}" if reading.parts else f"{path}#PART"
        raise UsageError(f"{path}: holds {len(reading.maps)} maps ({', '.join(reading.parts)}); name one as {example}")
    return reading.maps[0]


def is_plan(path: Path) -> bool:
    """Whether a file holds the plan of a building."""
    from mapfuse.datasets.errors import MapfuseError
    from mapfuse.datasets.formats import format_of

    try:
        return format_of(path).name == "plan"
    except MapfuseError:
        return False  # the readers say what is wrong


def fused_in(path: Path) -> FusedMap | None:
    """The result in a file, or None where it holds something else, or nothing that can be read."""
    import msgspec

    from mapfuse.datasets.errors import MapfuseError
    from mapfuse.datasets.files import read_whole
    from mapfuse.datasets.formats.heads import head_of

    class Head(msgspec.Struct):
        format: str = ""

    try:
        if not head_of(path).lstrip().startswith(b"{"):
            return None
        said = msgspec.json.decode(read_whole(path), type=Head).format
    except (MapfuseError, msgspec.MsgspecError, UnicodeDecodeError):
        return None  # the readers say what is wrong
    if not said.startswith("mapfuse.fused/"):
        return None
    from mapfuse.fusion import read_fused

    return read_fused(path)
