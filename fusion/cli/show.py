"""``mapfuse show``: a picture or a page of a map, a result, a pair of it, a log or a building."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import anymap
from .console import (
    Quiet,
    UsageError,
    Verbose,
    check_outputs,
    check_page,
    check_picture,
    note,
    say,
    warn_on_stderr,
    writing,
)
from .progress import watched

if TYPE_CHECKING:
    from mapfuse.datasets.logs import LogHeader
    from mapfuse.datasets.maps import LandmarkMap
    from mapfuse.fusion.result import FusedMap
    from mapfuse.fusion.show.log_page import Drive

_ENDINGS = (".fused.json", ".map.json", ".geojson", ".json", ".log.jsonl.gz", ".log.jsonl", ".jsonl")


def show(
    file: Annotated[
        Path,
        typer.Argument(
            help=(
                "A map in any format that `mapfuse formats` lists (FILE#PART for one of several), a result, a log, "
                "or a building's plan (GeoJSON)."
            ),
            metavar="FILE",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="The picture (.png, .svg, .pdf) or page; by default FILE's name with .png or .html."
        ),
    ] = None,
    *,
    html: Annotated[bool, typer.Option("--html", help="A page for a browser instead of a picture.")] = False,
    solid: Annotated[
        bool,
        typer.Option("--3d", help="A window in which maps lie one above the other; with -o OUT.ply a file of it."),
    ] = False,
    pair: Annotated[
        tuple[str, str] | None,
        typer.Option("--pair", metavar="MAP MAP", help="Of a fused map: how these two of its maps can lie."),
    ] = None,
    corridors: Annotated[
        Path | None,
        typer.Option("--corridors", metavar="FILE", help="Of a plan: a second file, that has its corridors."),
    ] = None,
    given: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=anymap.SET_HELP)] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Draw a recorded map, a fused map, a building, or a log with its truth where that stands beside it."""
    told = anymap.options(given or []) | ({"corridors": str(corridors)} if corridors else {})
    if html and solid:
        raise UsageError("--html and --3d: give one of them")
    if solid:
        from .solid import show_solid

        show_solid(file, output, told, quiet=quiet, verbose=verbose)
        return
    if output is not None and output.suffix.lower() in (".html", ".htm"):
        html = True
    target = output if output is not None else Path(_stem(file) + (".html" if html else ".png"))
    (check_page if html else check_picture)("-o", target)
    check_outputs({"-o": target}, [file])
    warn_on_stderr(verbose=verbose)
    if is_log(file):
        if pair:
            raise UsageError("--pair: a log has no pairs of maps")
        if told:
            raise UsageError(f"{file}: is a log, and --set and --corridors are for maps of other formats")
        said = _show_log(file, target, html=html)
    else:
        said = _show_document(file, target, pair, told, html=html, quiet=quiet)
    if not quiet:
        say(said)
        say(f"wrote {target}")


def _show_document(
    file: Path,
    target: Path,
    pair: tuple[str, str] | None,
    told: dict[str, str],
    *,
    html: bool,
    quiet: bool,
) -> str:
    if (fused := anymap.fused_in(file)) is not None:
        if told:
            raise UsageError(f"{file}: is a result, and --set and --corridors are for maps of other formats")
        return _show_fused(fused, target, pair, html=html)
    if pair:
        raise UsageError(f"--pair: {file} is no fused map")
    if not html and anymap.is_plan(file):
        return _show_plan(file, target, told)
    return _show_map(anymap.read_one(file, told, quiet=quiet), target, html=html)


def _show_fused(fused: FusedMap, target: Path, pair: tuple[str, str] | None, *, html: bool) -> str:
    from .summary import summarise

    if html:
        from mapfuse.fusion.report import fused_report

        if pair:
            note("--pair: the page shows all pairs")
        fused_report(fused, target)
        return summarise(fused)
    from mapfuse.fusion.show import draw_fused, draw_pair

    with writing(target):
        if pair:
            draw_pair(fused, pair, target)
        else:
            draw_fused(fused, target)
    return summarise(fused)


def _show_map(map_: LandmarkMap, target: Path, *, html: bool) -> str:
    if html:
        from mapfuse.fusion.report import map_report

        map_report(map_, target)
    else:
        from mapfuse.fusion.show import draw_map

        with writing(target):
            draw_map(map_, target)
    return f"{map_.name}: {len(map_)} landmarks"


def _show_plan(file: Path, target: Path, told: dict[str, str]) -> str:
    from mapfuse.datasets.simulation import building_from_plan
    from mapfuse.fusion.show import draw_building

    if others := [key for key in told if key != "corridors"]:
        raise UsageError(f"--set {others[0]}: is not drawn; of a plan only the corridors are asked for")
    building = building_from_plan(file, told.get("corridors"))
    with writing(target):
        draw_building(building, (), target, title=f"{building.name}: the plan of a building")
    return f"{building.name}: {len(building.floor.places)} landmarks, {len(building.walls)} walls"


def _stem(file: Path) -> str:
    for ending in _ENDINGS:
        if file.name.endswith(ending):
            return file.name.removesuffix(ending)
    return file.name


def _show_log(file: Path, target: Path, *, html: bool) -> str:
    header, drive, beside = _drive(file)
    simulated = bool(header.extra.get("simulated"))
    if html:
        from mapfuse.fusion.report import log_report

        log_report(header, drive, target, simulated=simulated)
    else:
        from mapfuse.fusion.show import draw_log

        with writing(target):
            draw_log(header, drive, target, simulated=simulated)
    said = f"{header.name}: {drive.journey.events} events, {len(drive.journey.detections)} detections"
    return said if drive.truth is None else f"{said}; with the truth from {beside}"


def _drive(file: Path) -> tuple[LogHeader, Drive, Path]:
    """A log as a drive, with its truth where that stands beside it."""
    from mapfuse.datasets.logfile import read_log
    from mapfuse.datasets.logtruth import read_log_truth
    from mapfuse.fusion.show.journey import journey
    from mapfuse.fusion.show.log_page import Drive

    log = read_log(file)
    beside = file.with_name(_stem(file) + ".logtruth.json")
    truth = read_log_truth(beside) if beside.is_file() else None
    return log.header, Drive(log.header.name, journey(watched(log.events, "reading")), truth), beside


def is_log(file: Path) -> bool:
    """Whether a file holds a log: lines of JSON of which the first one says so, or compressed and named as one."""
    if file.name.lower().endswith((".jsonl", ".jsonl.gz")):
        return True
    from mapfuse.datasets.errors import InputError
    from mapfuse.datasets.formats.heads import head_of

    try:
        return b'"mapfuse.log/' in head_of(file).partition(b"\n")[0]
    except InputError:
        return False  # the readers say what is wrong
