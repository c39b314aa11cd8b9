"""``mapfuse show --3d``: maps as layers in a window, or as a file of triangles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from . import anymap
from .console import UsageError, check_outputs, say, warn_on_stderr

if TYPE_CHECKING:
    from mapfuse.fusion.show.solids import Layer


def show_solid(file: Path, output: Path | None, told: dict[str, str], *, quiet: bool, verbose: bool) -> None:
    """Open the window, or write the file where one is named."""
    if output is not None and output.suffix.lower() != ".ply":
        raise UsageError(f"-o {output}: with --3d a file's name ends in .ply")
    check_outputs({"-o": output}, [file])
    warn_on_stderr(verbose=verbose)
    title, layers = _layers(file, told, quiet=quiet)

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


def _layers(file: Path, told: dict[str, str], *, quiet: bool) -> tuple[str, tuple[Layer, ...]]:
    from mapfuse.fusion.show.solids import layers_of_fused, layers_of_map

    from .show import is_log

    if is_log(file):
        raise UsageError(f"{file}: is a log; --3d shows maps and fused maps")
    if (fused := anymap.fused_in(file)) is not None:
        merged = next((k for k, names in enumerate(fused.groups) if len(names) > 1), 0)
        return " + ".join(fused.maps), layers_of_fused(fused, merged)
    map_ = anymap.read_one(file, told, quiet=quiet)
    return map_.name, layers_of_map(map_)
