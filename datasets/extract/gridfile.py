"""ROS map_server's grids read and written: a YAML file and its picture.

===================  =================================================================================================
``image``            the picture (PGM, PNG, BMP), in the YAML file's folder or below it
``resolution``       width of a cell [m]
``origin``           ``[x, y, yaw]`` [m, rad] of the lower left corner of the lower left cell in the map's frame
``negate``           0: dark is occupied (the default), 1: light is
``occupied_thresh``  cells of at least this occupancy are occupied (default 0.65)
``free_thresh``      cells below this occupancy are free (default 0.196)
``mode``             ``trinary`` (the default), ``scale`` or ``raw``
===================  =================================================================================================

Rows of the picture run from the top, those of a `Grid` from the bottom. In mode trinary the commonest shade between the
two thresholds is what nobody saw; other shades there, which map_server drops, lean to occupied and are kept as
percentages of the way from one threshold to the other, as in mode scale.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError, OutputError, Problem
from ..files import read_whole, write_whole
from ..jsondata import said
from .grid import FREE, OCCUPIED, UNKNOWN, Cells, Grid

#: Larger files are refused [bytes], and larger pictures [cells].
MAX_YAML_BYTES, MAX_IMAGE_BYTES, MAX_CELLS = 2**16, 2**28, 2**26
#: A side longer than this is no building [m].
MAX_SIDE_M = 100_000.0

_PICTURES = (".pgm", ".png", ".bmp")
_OCCUPIED, _FREE = 0.65, 0.196
#: Shades that map_saver writes for occupied, free and unknown cells.
_BLACK, _WHITE, _GREY = 0, 254, 205
#: The comment that map_saver leaves in a picture.
_SAVED = re.compile(rb"CREATOR: map_saver\S* ([0-9.]+) m/pix")


@dataclass(frozen=True, slots=True)
class GridReading:
    """A grid as read, and what was odd about its files."""

    grid: Grid
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Header:
    image: str
    resolution: float
    origin: tuple[float, float, float]
    negate: bool
    occupied: float
    free: float
    mode: str


def read_grid(path: str | Path) -> GridReading:
    """The grid of a map_server YAML file, or of a picture that says its resolution as map_saver's do.

    A YAML file is looked for beside a picture. Where ``image`` leads out of the YAML file's folder or to nothing, the
    picture of the YAML file's own name is taken, and a remark says so.

    Raises `InputError` where a file can't be read or is too large, `FileFormatError` (file, place, reason) where it
    breaks the rules.
    """
    path = Path(path)
    no_remarks: tuple[str, ...] = ()
    if path.suffix.lower() in _PICTURES:
        beside = path.with_suffix(".yaml")
        if not beside.is_file():
            return _bare_picture(path)
        header, image, remarks = _header(beside), path, no_remarks
    else:
        header = _header(path)
        image, remarks = _image(path, header.image)
    shades = _shades(image)
    if max(shades.shape) * header.resolution > MAX_SIDE_M:
        raise FileFormatError(path, (Problem("resolution", f"makes a grid longer than {MAX_SIDE_M:,.0f} m"),))
    return GridReading(Grid(path.stem, _cells(shades, header), header.resolution, np.array(header.origin)), remarks)


def _header(path: Path) -> _Header:
    """The YAML file's members, checked."""
    from ..formats import safeyaml

    found = safeyaml.loads(_text(path), path)
    if not isinstance(found, Mapping):
        raise FileFormatError(path, (Problem("", "is no YAML of a map_server grid: it holds no members"),))
    problems: list[Problem] = []

    def number(key: str, default: float | None, low: float, high: float) -> float:
        value = found.get(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
            problems.append(Problem(key, f"must be a number from {low:g} to {high:g}, not {_brief(value)}"))
            return low
        return float(value)

    image, mode = found.get("image"), found.get("mode", "trinary")
    if not isinstance(image, str) or not image.strip("\x00 "):
        problems.append(Problem("image", f"must be the name of the picture, not {_brief(image)}"))
    if mode not in ("trinary", "scale", "raw"):
        problems.append(Problem("mode", f"must be trinary, scale or raw, not {_brief(mode)}"))
    origin = _pose(found.get("origin"))
    if origin is None:
        problems.append(Problem("origin", "must be a list of three numbers [x, y, yaw] of at most 1e9"))
    header = _Header(
        image=str(image),
        resolution=number("resolution", None, 1e-4, 1000.0),
        origin=origin or (0.0, 0.0, 0.0),
        negate=bool(number("negate", 0, 0, 1)),
        occupied=number("occupied_thresh", _OCCUPIED, 0, 1),
        free=number("free_thresh", _FREE, 0, 1),
        mode=str(mode),
    )
    if not problems and header.free >= header.occupied:
        problems.append(Problem("free_thresh", "must lie below occupied_thresh"))
    if problems:
        raise FileFormatError(path, tuple(problems))
    return header


def _text(path: Path) -> str:
    try:
        return read_whole(path, MAX_YAML_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(path, (Problem("", f"is no text in UTF-8: {error.reason}"),)) from None


def _brief(value: Any) -> str:
    """A plain value in words; the kind of anything else, which might hold itself."""
    return said(value) if value is None or isinstance(value, (bool, int, float, str)) else f"a {type(value).__name__}"


def _pose(value: Any) -> tuple[float, float, float] | None:
    """Three finite numbers of at most 1e9; None where it isn't that."""
    if not isinstance(value, list) or len(value) != 3:
        return None
    numbers = [float(x) for x in value if isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= 1e9]
    return (numbers[0], numbers[1], numbers[2]) if len(numbers) == 3 else None


def _image(path: Path, name: str) -> tuple[Path, tuple[str, ...]]:
    """The picture that a YAML file names, else the one of its own name, with a remark."""
    folder = path.resolve().parent
    try:
        named = (folder / name).resolve()
        inside = named.is_relative_to(folder)
        if inside and named.is_file():
            return named, ()
    except (OSError, ValueError):
        inside = True
    for suffix in _PICTURES:
        own = path.with_suffix(suffix)
        if own.is_file():
            reason = "doesn't exist" if inside else "lies outside of the file's folder"
            return own, (f"image: {said(name)} {reason}; {own.name}, the picture of the same name, is taken",)
    if not inside:
        raise FileFormatError(path, (Problem("image", f"{said(name)} leads out of the file's folder: not read"),))
    raise FileFormatError(path, (Problem("image", f"{said(name)}: there is no such picture"),))


def _bare_picture(path: Path) -> GridReading:
    """A picture without a YAML file, where map_saver's comment says how large its cells are."""
    data = read_whole(path, MAX_IMAGE_BYTES)
    saved = _SAVED.search(data[:512])
    resolution = float(saved[1]) if saved and saved[1].count(b".") < 2 else 0.0
    if not 1e-4 <= resolution <= 1000:
        reason = f"there is no {path.stem}.yaml beside it, and it doesn't say how large its cells are"
        raise FileFormatError(path, (Problem("", reason),))
    header = _Header(path.name, resolution, (0.0, 0.0, 0.0), False, _OCCUPIED, _FREE, "trinary")
    remark = (
        f"there is no {path.stem}.yaml; cells of {resolution:g} m, as its comment says, and the origin at its corner"
    )
    return GridReading(Grid(path.stem, _cells(_shades(path), header), resolution, np.zeros(3)), (remark,))


def _shades(path: Path) -> NDArray[np.int16]:
    """Brightness 0 to 255 of each cell, rows from the bottom; -1 where the picture is transparent."""
    from PIL import Image, UnidentifiedImageError

    data = read_whole(path, MAX_IMAGE_BYTES)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=("PPM", "PNG", "BMP")) as picture:
                columns, rows = picture.size
                if rows * columns > MAX_CELLS:
                    raise InputError(path, f"has {rows * columns:,} cells; at most {MAX_CELLS:,} are read")
                if picture.mode.startswith("I") or picture.mode == "F":
                    deep = np.asarray(picture, dtype=np.float64)
                    found = (deep * (255.0 / 65535.0)).round().astype(np.int16)
                else:
                    found = np.asarray(picture.convert("LA"), dtype=np.int16)
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise InputError(path, f"has far more than {MAX_CELLS:,} cells, the most that are read") from None
    except UnidentifiedImageError:
        raise FileFormatError(path, (Problem("", "is no picture in PGM, PNG or BMP"),)) from None
    except (OSError, ValueError, SyntaxError, EOFError, IndexError) as error:
        raise FileFormatError(path, (Problem("", f"is a broken picture: {error}"),)) from error
    if found.ndim == 3:
        found = np.where(found[..., 1] > 0, found[..., 0], -1).astype(np.int16)
    return found[::-1]


def _cells(shades: NDArray[np.int16], header: _Header) -> Cells:
    """Values of cells by the file's thresholds."""
    unseen = shades < 0
    if header.mode == "raw":
        return np.where(unseen | (shades > OCCUPIED), UNKNOWN, shades).astype(np.int8)
    occupancy = (shades if header.negate else 255 - shades) / 255.0
    free, occupied = occupancy < header.free, occupancy >= header.occupied
    share = (occupancy - header.free) / (header.occupied - header.free)
    leaning = np.clip(np.round(share * 100), 1, OCCUPIED - 1)
    between = ~free & ~occupied & ~unseen
    if header.mode == "trinary" and between.any():
        commonest = np.bincount(shades[between], minlength=256).argmax()
        unseen = unseen | (between & (shades == commonest))
    found = np.where(free, FREE, np.where(occupied, OCCUPIED, leaning))
    return np.where(unseen, UNKNOWN, found).astype(np.int8)


def write_grid(grid: Grid, path: str | Path) -> tuple[Path, Path]:
    """Write a grid as ``NAME.yaml`` and ``NAME.pgm`` beside it, in map_saver's shades; returns both.

    Reading them gives the same grid. Raises `OutputError` where they can't be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise OutputError(path, "a grid's name ends in .yaml; its picture is written beside it")
    image = path.with_suffix(".pgm")
    shades = np.where(grid.cells == OCCUPIED, _BLACK, np.where(grid.cells == FREE, _WHITE, _GREY))
    leaning = (grid.cells > FREE) & (grid.cells < OCCUPIED)
    occupancy = _FREE + grid.cells / OCCUPIED * (_OCCUPIED - _FREE)
    shades = np.where(leaning, np.clip(np.round(255 * (1 - occupancy)), 90, _GREY - 1), shades).astype(np.uint8)
    rows, columns = shades.shape
    head = f"P5\n# CREATOR: mapfuse {grid.resolution:.3f} m/pix\n{columns} {rows}\n255\n".encode()
    x, y, yaw = (repr(float(v)) for v in grid.origin)
    text = (
        f"image: {_quoted(image.name)}\nmode: trinary\nresolution: {grid.resolution!r}\norigin: [{x}, {y}, {yaw}]\n"
        f"negate: 0\noccupied_thresh: {_OCCUPIED}\nfree_thresh: {_FREE}\n"
    )
    write_whole(image, head + shades[::-1].tobytes())
    write_whole(path, text)
    return path, image


def _quoted(name: str) -> str:
    """A file's name as YAML's single-quoted text."""
    return "'" + name.replace("'", "''") + "'"
