"""``mapfuse show --3d``: maps as layers in a window, or as a file of triangles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .console import UsageError, check_outputs, say, warn_on_stderr

if TYPE_CHECKING:
    from mapfuse.fusion.show.solids import Layer


def show_solid(file: Path, output: Path | None, *, quiet: bool, verbose: bool) -> None:
    """Open the window, or write the file where one is named."""
    if output is not None and output.suffix.lower() != ".ply":
        raise UsageError(f"-o {output}: with --3d a file's name ends in .ply")
    check_outputs({"-o": output}, [file])
    warn_on_stderr(verbose=verbose)
    title, layers = _layers(file)

    from mapfuse.fusion.show.viewer import check_display, view, write_ply

    if output is not None:
        write_ply(layers, output)
        if not quiet:
            say(f"wrote {output}")
        return
    check_display()
    if not quiet:
        say("space: lay the maps on each other again; mouse: turn, shift and mouse: move; Q: close")
    view(layers, title)


def _layers(file: Path) -> tuple[str, tuple[Layer, ...]]:
    from mapfuse.fusion.show.solids import layers_of_fused, layers_of_map

    from .show import format_of, is_log

    if is_log(file):
        raise UsageError(f"{file}: is a log; --3d shows maps and fused maps")
    if format_of(file).startswith("mapfuse.fused/"):
        from mapfuse.fusion import read_fused

        fused = read_fused(file)
        merged = next((k for k, names in enumerate(fused.groups) if len(names) > 1), 0)
        return " + ".join(fused.maps), layers_of_fused(fused, merged)
    from mapfuse.datasets import read_map

    map_ = read_map(file)
    return map_.name, layers_of_map(map_)
