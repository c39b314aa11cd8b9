"""``mapfuse show``: a picture of a map, a result or a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .console import check_outputs, check_picture, say, warn_on_stderr, writing
from .progress import watched

#: The first line of a log isn't longer [bytes].
_HEAD_BYTES = 2**20


def show(
    file: Annotated[Path, typer.Argument(help="A recorded map, a fused map or a log.", metavar="FILE")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="The picture (.png, .svg, .pdf); by default FILE's name with .png."),
    ] = None,
) -> None:
    """Draw a recorded map, a fused map, or a log with its truth where that stands beside it."""
    picture = output if output is not None else Path(_stem(file) + ".png")
    check_picture("-o", picture)
    check_outputs({"-o": picture}, [file])

    warn_on_stderr()
    if _is_log(file):
        _show_log(file, picture)
    elif _format_of(file).startswith("mapfuse.fused/"):
        from mapfuse.fusion import read_fused
        from mapfuse.fusion.show import draw_fused

        from .summary import summarise

        fused = read_fused(file)
        with writing(picture):
            draw_fused(fused, picture)
        say(summarise(fused))
    else:
        from mapfuse.datasets import read_map
        from mapfuse.fusion.show import draw_map

        map_ = read_map(file)
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
    """Whether a file holds a log: lines of JSON of which the first one says so, or anything compressed."""
    try:
        with file.open("rb") as stream:
            line = stream.readline(_HEAD_BYTES)
    except OSError:
        return False  # the readers say what is wrong
    return line[:2] == b"\x1f\x8b" or _format(line).startswith("mapfuse.log/")


def _format_of(file: Path) -> str:
    """The file's own word for its format, empty where it has none: the reader of maps then says what is wrong."""
    from mapfuse.datasets.files import read_whole

    return _format(read_whole(file))


def _format(document: bytes) -> str:
    import msgspec

    class Head(msgspec.Struct):
        format: str = ""

    try:
        return msgspec.json.decode(document, type=Head).format
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return ""
