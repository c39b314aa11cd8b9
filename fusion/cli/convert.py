"""``mapfuse convert``: a map of any format, or a result, to a file of another format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import anymap
from .console import Quiet, UsageError, Verbose, check_outputs, teller, warn_on_stderr
from .progress import stages

if TYPE_CHECKING:
    from mapfuse.datasets.maps import LandmarkMap


def convert(
    source: Annotated[
        Path,
        typer.Argument(help="A map in any readable format, FILE#PART for one of several, or a result.", metavar="IN"),
    ],
    target: Annotated[Path, typer.Argument(help="The new file; its ending says the format.", metavar="OUT")],
    *,
    source_format: Annotated[
        str | None, typer.Option("--from", metavar="FORMAT", help="Take IN for this format.")
    ] = None,
    target_format: Annotated[
        str | None, typer.Option("--to", metavar="FORMAT", help="Write this format, whatever OUT's ending.")
    ] = None,
    given: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=anymap.SET_HELP)] = None,
    group: Annotated[
        int, typer.Option("--group", min=0, help="Which group of a result whose maps weren't all merged.")
    ] = 0,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Convert a map to another format, and say what that can't hold; `mapfuse formats` lists all formats."""
    from mapfuse.datasets.formats import registry

    check_outputs({"OUT": target}, [source])
    warn_on_stderr(verbose=verbose)
    tell = teller(quiet=quiet)
    writer = registry.named(target_format) if target_format is not None else registry.writer_of(target)
    with stages(f"converting {source.name}", quiet=quiet):
        map_ = _map(source, source_format, anymap.options(given or []), group, to_own=writer.name == "map")
        _, lost = registry.write_any(map_, target, format=writer.name)
    tell(f"{map_.name}: {len(map_)} landmark{'' if len(map_) == 1 else 's'}")
    tell(f"wrote {target} as {writer.title} ({writer.name})")
    if lost:
        tell(f"lost: {', '.join(lost)}")


def _map(source: Path, source_format: str | None, given: dict[str, str], group: int, *, to_own: bool) -> LandmarkMap:
    fused = anymap.fused_in(source) if source_format is None else None
    if fused is None:
        return anymap.read_one(source, given, source_format)
    if given:
        raise UsageError(f"--set: is for maps of other formats, and {source} is a result")
    if to_own:
        raise UsageError(
            f"{source}: the file of a result has no joint covariance, without which a map that can be fused again "
            "would claim too much; `mapfuse fuse MAPS --map OUT.map.json` writes it"
        )
    from mapfuse.fusion.tomap import without_joint_covariance

    return without_joint_covariance(fused, group)
