"""``mapfuse show``: a picture of a map or a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .console import check_outputs, check_picture, say, warn_on_stderr, writing


def show(
    file: Annotated[Path, typer.Argument(help="A recorded map or a fused map.", metavar="FILE")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="The picture (.png, .svg, .pdf); by default FILE's name with .png."),
    ] = None,
) -> None:
    """Draw a recorded map or a fused map."""
    picture = output if output is not None else Path(_stem(file) + ".png")
    check_picture("-o", picture)
    check_outputs({"-o": picture}, [file])

    warn_on_stderr()
    if _format_of(file).startswith("mapfuse.fused/"):
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
    for ending in (".fused.json", ".map.json", ".json"):
        if file.name.endswith(ending):
            return file.name.removesuffix(ending)
    return file.name


def _format_of(file: Path) -> str:
    """The file's own word for its format, empty where it has none: the reader of maps then says what is wrong."""
    import msgspec

    from mapfuse.datasets.files import read_whole

    class Head(msgspec.Struct):
        format: str = ""

    try:
        return msgspec.json.decode(read_whole(file), type=Head).format
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return ""
