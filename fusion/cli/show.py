"""``mapfuse show``: a picture of a map, a result or a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from . import anymap
from .console import check_outputs, check_picture, say, warn_on_stderr, writing
from .progress import watched


def show(
    file: Annotated[
        Path,
        typer.Argument(
            help="A map in any format that `mapfuse formats` lists (FILE#PART for one of several), a result or a log.",
            metavar="FILE",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="The picture (.png, .svg, .pdf); by default FILE's name with .png."),
    ] = None,
    given: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=anymap.SET_HELP)] = None,
) -> None:
    """Draw a recorded map, a fused map, or a log with its truth where that stands beside it."""
    picture = output if output is not None else Path(_stem(file) + ".png")
    check_picture("-o", picture)
    check_outputs({"-o": picture}, [file])

    warn_on_stderr()
    if _is_log(file):
        _show_log(file, picture)
    elif (fused := anymap.fused_in(file)) is not None:
        from mapfuse.fusion.show import draw_fused

        from .summary import summarise

        with writing(picture):
            draw_fused(fused, picture)
        say(summarise(fused))
    else:
        from mapfuse.fusion.show import draw_map

        map_ = anymap.read_one(file, anymap.options(given or []))
        with writing(picture):
            draw_map(map_, picture)
        say(f"{map_.name}: {len(map_)} landmarks")
    say(f"wrote {picture}")


def _stem(file: Path) -> str:
    for ending in (".fused.json", ".map.json", ".json", ".log.jsonl.gz", ".log.jsonl", ".jsonl"):
        if file.name.endswith(ending):
            return file.name.removesuffix(ending)
    return file.name


def _show_log(file: Path, picture: Path) -> None:
    from mapfuse.datasets.logfile import read_log
    from mapfuse.datasets.logtruth import read_log_truth
    from mapfuse.fusion.show import draw_log
    from mapfuse.fusion.show.journey import journey
    from mapfuse.fusion.show.log_page import Drive

    log = read_log(file)
    beside = file.with_name(_stem(file) + ".logtruth.json")
    truth = read_log_truth(beside) if beside.is_file() else None
    drive = Drive(log.header.name, journey(watched(log.events, "reading")), truth)
    with writing(picture):
        draw_log(log.header, drive, picture, simulated=bool(log.header.extra.get("simulated")))
    said = f"{log.header.name}: {drive.journey.events} events, {len(drive.journey.detections)} detections"
    say(said if truth is None else f"{said}; with the truth from {beside}")


def _is_log(file: Path) -> bool:
    """Whether a file holds a log: lines of JSON of which the first one says so, or compressed and named as one."""
    if file.name.lower().endswith((".jsonl", ".jsonl.gz")):
        return True
    from mapfuse.datasets.errors import InputError
    from mapfuse.datasets.formats.heads import head_of

    try:
        return b'"mapfuse.log/' in head_of(file).partition(b"\n")[0]
    except InputError:
        return False  # the readers say what is wrong
