"""The formats that maps come in: found out, read and written through one interface.

A format is a row in `FORMATS` and a module of this folder, which is imported when the format is first asked something:

- ``detect(path, head) -> bool``: whether a file (or folder, whose ``head`` is empty) is of this format, from its
  name and its first bytes, unpacked where it is compressed. Libraries aren't imported for it.
- ``read(path, **options) -> Reading``: raises `InputError` where it can't be read, `FileFormatError` where it is
  broken; what is odd but leaves a valid rest is a remark. Of a format with ``several`` maps in a file, ``part`` is one
  of the options: the only map that is wanted, or None.
- ``write(map, path) -> None``: whole or not at all. ``KEPT``: keys of ``extra`` that it writes, if there are any.

The first format that detects a file has it, so that those with a mark of their own stand first.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from ..errors import ConfigError, FileFormatError, InputError, OutputError, Problem
from ..mapfile import validate
from ..maps import LandmarkMap, Noise
from .contents import SORTS, contents, extra_keys
from .heads import head_of
from .reading import Reading

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Format:
    """One format: what it is called, what it can do, and what it can't hold.

    ``suffixes``: endings of file names, the first one being what a writer is known by. ``lost``: what is lost in
    writing, of `contents.SORTS`. ``options``: what the reader may be told, with its meaning. ``extra``: the optional
    dependency of mapfuse that it needs. ``several``: a file may hold several maps.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    module: str
    reads: bool = True
    writes: bool = False
    lost: tuple[str, ...] = ()
    options: Mapping[str, str] = field(default_factory=dict, hash=False)
    extra: str | None = None
    several: bool = False

    def detect(self, path: Path, head: bytes) -> bool:
        """Whether a file or folder is of this format; ``head`` is its beginning, unpacked."""
        return self.reads and bool(self._module().detect(path, head))

    def read(self, path: str | Path, **options: Any) -> Reading:
        """All maps in a file of this format."""
        reading: Reading = self._module().read(Path(path), **options)
        return reading

    def write(self, map_: LandmarkMap, path: str | Path) -> None:
        """Write a map, whole or not at all."""
        self._module().write(map_, Path(path))

    def lost_from(self, map_: LandmarkMap) -> tuple[str, ...]:
        """What of this map the format can't hold; unknown keys are no loss where all are the format's own."""
        kept: frozenset[str] = getattr(self._module(), "KEPT", frozenset())
        held = "extra" in self.lost and extra_keys(map_) <= kept
        return tuple(sort for sort in contents(map_) if sort in self.lost and not (sort == "extra" and held))

    def _module(self) -> ModuleType:
        return import_module(f".{self.module}", __package__)


#: What belongs to links, for formats that have none.
_LINKS = ("arms", "ways", "distances", "compass")
#: What formats have no field for that know nothing of mapfuse but points.
_PLAIN_LOSES = (
    "robot",
    "recorded_at",
    "heading",
    *_LINKS,
    "counters",
    "existence",
    "noise",
    "walls",
    "same_as",
    "extra",
)
#: Graphs of places and ways.
_GRAPH_LOSES = (*(sort for sort in _PLAIN_LOSES if sort != "ways"), "covariance", "joint covariance", "path")
#: Tables with a row per landmark.
_TABLE_LOSES = ("robot", "recorded_at", *_LINKS, "joint covariance", "noise", "walls", "path", "same_as", "extra")

_TYPE = "what landmarks are that the file has no label for"
_MATRIX = "what follows a measurement: covariance, information or root (of information)"

#: In the order in which they are asked.
FORMATS: tuple[Format, ...] = (
    Format("map", "mapfuse's own recorded map", (".map.json",), "own", writes=True),
    Format(
        "gis",
        "GeoJSON with ellipses",
        (".gis.geojson",),
        "gis",
        writes=True,
        lost=("robot", "recorded_at", *_LINKS, "joint covariance", "noise", "same_as", "extra"),
    ),
    Format("nav2", "Nav2 Route Server graph", (".geojson", ".nav2.geojson"), "nav2", writes=True, lost=_GRAPH_LOSES),
    Format(
        "plan",
        "vector plan of a floor (GeoJSON)",
        (".geojson",),
        "geojson_plan",
        options={"corridors": "a second file of the same floor, that has its corridors"},
    ),
    Format(
        "mrclam",
        "MRCLAM folder",
        ("a folder",),
        "mrclam_folder",
        options={"barcodes": "no: tubes are nameless to the mapper (default: yes)"},
        several=True,
    ),
    Format(
        "rosbag",
        "rosbag2 folder or MCAP file",
        (".mcap", ".db3", "a folder"),
        "rosbag",
        options={
            "odometry": "topic of nav_msgs/Odometry (default: the only one)",
            "landmarks": "topic of MarkerArray, PoseArray or Detection3DArray (default: the only one)",
            "type": _TYPE,
            "detection_range": "how far landmarks are seen [m]",
            "range_sigma": "standard deviation of their distance [m]",
            "bearing_sigma": "standard deviation of their bearing [rad]",
        },
        extra="rosbag",
    ),
    Format("graphnav", "GraphNav map of Spot", ("graph", "a folder"), "graphnav", extra="graphnav"),
    Format(
        "ros_map",
        "occupancy grid of ROS' map_server",
        (".yaml", ".pgm"),
        "ros_map",
        options={
            "cell_m": "finer grids are looked at with cells of this size [m]",
            "furniture_m": "what stands alone and is no larger divides no space [m]",
            "passage_m": "narrower gaps are no way [m]",
            "widest_m": "wider spaces are no corridors [m]",
            "looks": "how often landmarks are looked for, each time with the grid turned",
            "agreement": "share of looks that must find a landmark",
        },
    ),
    Format(
        "rmf",
        "Open-RMF building",
        (".building.yaml",),
        "rmf",
        options={
            "landmarks": "named: doors and named vertices (default); lanes: corners, junctions, doors along the lanes"
        },
        several=True,
    ),
    Format(
        "tmap2",
        "LCAS and STRANDS topological map",
        (".tmap2.yaml", ".tmap2", ".tplg", ".tmap", ".yaml"),
        "tmap2",
        writes=True,
        lost=_GRAPH_LOSES,
    ),
    Format(
        "g2o",
        "g2o graph with landmarks",
        (".g2o",),
        "g2o",
        writes=True,
        lost=(*_PLAIN_LOSES, "joint covariance"),
        options={"type": _TYPE},
    ),
    Format("isam", "GTSAM and iSAM text", (".txt", ".graph"), "isam", options={"type": _TYPE, "matrix": _MATRIX}),
    Format("mat", "local submap with covariance (MATLAB)", (".mat",), "mat", options={"type": _TYPE}),
    Format(
        "parquet",
        "object list (Parquet)",
        (".parquet", ".pq"),
        "parquet",
        writes=True,
        lost=_TABLE_LOSES,
        options={"type": _TYPE},
        extra="parquet",
    ),
    Format(
        "objects",
        "object list (CSV or text)",
        (".csv", ".tsv", ".txt"),
        "objects",
        writes=True,
        lost=("name", *_TABLE_LOSES),
        options={"type": _TYPE},
    ),
    Format(
        "ply",
        "PLY point cloud",
        (".ply",),
        "ply",
        reads=False,
        writes=True,
        lost=(*_PLAIN_LOSES, "ids", "covariance", "joint covariance"),
    ),
    Format(
        "tum",
        "TUM trajectory",
        (".tum",),
        "tum",
        reads=False,
        writes=True,
        lost=tuple(sort for sort in SORTS if sort != "path"),
    ),
)

_NOISE = tuple(f.name for f in fields(Noise) if f.name != "extra")


def formats() -> tuple[Format, ...]:
    """All formats, in the order in which they are asked.

    >>> [f.name for f in formats() if f.name == "map"]
    ['map']
    """
    return FORMATS


def named(name: str) -> Format:
    """The format of that name; `ConfigError` where there is none."""
    for one in FORMATS:
        if one.name == name:
            return one
    raise ConfigError(f"there is no format {name!r}; there are {', '.join(f.name for f in FORMATS)}")


def format_of(path: str | Path) -> Format:
    """The format of a file or folder, found out from its name and its beginning.

    Raises `InputError` where there is no such file, `FileFormatError` where no format knows it.
    """
    path = Path(path)
    head = head_of(path)
    for one in FORMATS:
        if one.detect(path, head):
            return one
    if _is_json(path, head):
        return FORMATS[0]
    reason = f"is {'a folder ' * path.is_dir()}in no format that mapfuse reads (`mapfuse formats` lists them)"
    raise FileFormatError(path, (Problem("", reason),))


def _is_json(path: Path, head: bytes) -> bool:
    """Whether mapfuse's own reader is the one that says what is wrong with a file."""
    text = head.lstrip()
    if path.is_dir() or path.suffix.lower() == ".geojson" or b'"FeatureCollection"' in head:
        return False
    return path.suffix.lower() == ".json" or text[:1] in (b"{", b"[")


def split_part(path: str | Path) -> tuple[Path, str | None]:
    """``FILE#PART`` in two where there is no file of the whole name.

    >>> split_part("clinic.building.yaml#L1")
    (PosixPath('clinic.building.yaml'), 'L1')
    """
    whole = Path(path)
    stem, mark, part = str(path).rpartition("#")
    return (Path(stem), part) if mark and part and stem and not whole.exists() else (whole, None)


def fitting(found: Format, options: Mapping[str, Any]) -> dict[str, Any]:
    """Those options that a format has: of mapfuse's own none, whose files say all themselves.

    >>> fitting(named("objects"), {"type": "tree", "position_sigma": 0.2, "corridors": "ways.geojson"})
    {'type': 'tree', 'position_sigma': 0.2}
    """
    known = () if found is FORMATS[0] else (*found.options, *_NOISE)
    return {name: value for name, value in options.items() if name in known}


def check_options(options: Mapping[str, Any]) -> None:
    """Raise `ConfigError` for an option that no format has."""
    known = {name for one in FORMATS for name in one.options}.union(_NOISE)
    if unknown := [name for name in options if name not in known]:
        raise ConfigError(f"no format has an option {unknown[0]!r} (`mapfuse formats` lists them)")


def read_all(path: str | Path, *, format: str | None = None, **options: Any) -> tuple[Reading, Format]:
    """Everything that a file (or ``FILE#PART``: one part of it) holds, and the format it was taken for.

    ``format``: a format's name, instead of finding it out. ``options``: those of the format, and of any foreign format
    the fields of `Noise`, which say what no foreign file does: how good the map is.

    Raises `InputError` and `FileFormatError` as readers do, `ConfigError` for an option that the format hasn't.
    """
    path, part = split_part(path)
    found = named(format) if format is not None else format_of(path)
    if found is FORMATS[0] and (own := [name for name in _NOISE if name in options]):
        raise ConfigError(f"{path}: states its own {own[0]}, which no option replaces")
    noise: dict[str, Any] = {name: _number(name, options.pop(name)) for name in _NOISE if name in options}
    for name in options:
        if name not in found.options:
            known = ", ".join([*found.options, *_NOISE])
            raise ConfigError(f"{path}: the format {found.name} has no option {name!r}; it has {known}")
    if found.several:
        options["part"] = part
    reading = found.read(path, **options)
    maps = tuple(map_.replace(noise=replace(map_.noise, **noise)) for map_ in reading.maps) if noise else reading.maps
    if part is not None and len(maps) != 1:
        raise InputError(path, f"has no part {part!r}{_parts(reading)}")
    if part is not None and not found.several:
        raise InputError(path, f"is one map and has no part {part!r}")
    if found is not FORMATS[0]:
        _check(maps, path)
    return replace(reading, maps=maps), found


def _check(maps: tuple[LandmarkMap, ...], path: Path) -> None:
    """Hold what a reader made of a file against the rules of our own maps."""
    for map_ in maps:
        problems = validate(map_)
        if told := [problem for problem in problems if problem.place.startswith("noise.")]:
            raise ConfigError(f"{path}: option {told[0].place.removeprefix('noise.')}: {told[0].reason}")
        if problems:
            raise FileFormatError(path, problems)


def read_any(path: str | Path, *, format: str | None = None, **options: Any) -> tuple[LandmarkMap, Format]:
    """The one map of a file in any format, and the format; what is odd in it is logged as a warning.

    Raises what `read_all` does, and `InputError` where the file holds several maps and none is named (``FILE#PART``).

    >>> from mapfuse.datasets import recordings
    >>> map_, found = read_any(recordings.path("ground-floor-milka"))
    >>> found.name
    'map'
    """
    reading, found = read_all(path, format=format, **options)
    if len(reading.maps) != 1:
        example = f"{path}#{reading.parts[0]}" if reading.parts else "FILE#PART"
        raise InputError(path, f"holds {len(reading.maps)} maps{_parts(reading)}; name one as {example}")
    for remark in reading.remarks:
        _LOG.warning("%s: %s", path, remark)
    return reading.maps[0], found


def write_any(map_: LandmarkMap, path: str | Path, *, format: str | None = None) -> tuple[Format, tuple[str, ...]]:
    """Write a map in the format that the file's ending or ``format`` names; returns it and what it couldn't hold.

    Raises `ConfigError` where no format writes such files, `OutputError` where the file can't be written, and
    `MapfuseError` where the map is nothing that the format can hold.
    """
    found = named(format) if format is not None else writer_of(path)
    if not found.writes:
        raise ConfigError(f"the format {found.name} is only read, not written")
    found.write(map_, path)
    return found, found.lost_from(map_)


def writer_of(path: str | Path) -> Format:
    """The format whose ending is the longest one that a file's name has; `OutputError` where there is none."""
    name = Path(path).name.lower()
    found = [(len(s), one) for one in FORMATS if one.writes for s in one.suffixes if name.endswith(s)]
    if not found:
        endings = ", ".join(f"{one.suffixes[0]} ({one.name})" for one in FORMATS if one.writes)
        raise OutputError(path, f"no format is written to such a name; there are {endings}")
    return max(found, key=lambda item: item[0])[1]


def _parts(reading: Reading) -> str:
    return f" ({', '.join(reading.parts)})" if reading.parts else ""


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ConfigError(f"option {name} must be a number, not {value!r}") from None
