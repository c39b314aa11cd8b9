"""``mapfuse fuse``: recorded maps into one."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import anymap, grids
from .console import UsageError, check_outputs, check_picture, note, say, say_bytes, warn_on_stderr, writing

if TYPE_CHECKING:
    from mapfuse.fusion import FuseConfig, FusedMap


class Mode(StrEnum):
    """How hypotheses are proposed."""

    default = "default"
    paper = "paper"


def fuse_files(
    maps: Annotated[
        list[Path], typer.Argument(help="Recorded maps, in any format that `mapfuse formats` lists.", metavar="MAP")
    ],
    *,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The result, OUT.fused.json.", show_default=False)
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="A picture of the result: .png, .svg, .pdf.")] = None,
    merged_map: Annotated[
        Path | None, typer.Option("--map", help="The merged map as a map again, OUT.map.json.")
    ] = None,
    grid: Annotated[
        Path | None,
        typer.Option("--grid", metavar="OUT.yaml", help="The grids among the maps in one; its picture beside it."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The result file on standard output.")] = False,
    no_embed: Annotated[bool, typer.Option("--no-embed", help="Leave the input maps out of the result file.")] = False,
    require_merge: Annotated[
        bool, typer.Option("--require-merge", help="Exit with 3 where not all maps were merged.")
    ] = False,
    accept: Annotated[
        float | None,
        typer.Option("--accept", metavar="P", help="Merge from this probability on (default 0.99)."),
    ] = None,
    overlap_prior: Annotated[
        float | None,
        typer.Option("--overlap-prior", metavar="P", help="Probability, before looking, of overlap (0.5)."),
    ] = None,
    given: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=anymap.SET_HELP)] = None,
    mode: Annotated[Mode | None, typer.Option("--mode", help="How hypotheses are proposed.")] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Parameters; see `mapfuse config`.")
    ] = None,
) -> None:
    """Fuse recorded maps, whose relative start is unknown, and say how sure the answer is.

    Exit code 0 whatever was decided: "no overlap" is an answer.
    """
    check_picture("--plot", plot)
    grids.check_output(grid, maps)
    check_outputs(
        {"-o": output, "--plot": plot, "--map": merged_map, "--grid": grid}, [*maps, *([config] if config else [])]
    )
    warn_on_stderr()
    settings = _settings(config, accept, overlap_prior, mode)
    recorded = anymap.read_maps(maps, anymap.options(given or []))
    if len(recorded) < 2:
        raise UsageError("give at least two maps to fuse")

    from mapfuse.fusion import fuse

    fused = fuse(recorded, settings)
    _write(fused, output, plot, merged_map, as_json=as_json, embed=not no_embed)
    if grid is not None:
        grids.write_merged(fused, maps, grid)
    if require_merge and fused.decision != "merged":
        raise typer.Exit(3)


def _settings(config: Path | None, accept: float | None, overlap_prior: float | None, mode: Mode | None) -> FuseConfig:
    from mapfuse.fusion.config import FuseConfig

    settings = FuseConfig()
    if config is not None:
        from .parameters import config_from_toml

        settings = config_from_toml(config)
    if accept is not None:
        settings = replace(settings, decision=replace(settings.decision, accept=accept))
    if overlap_prior is not None:
        settings = replace(settings, decision=replace(settings.decision, overlap_prior=overlap_prior))
    if mode is not None:
        settings = replace(settings, matching=replace(settings.matching, mode=mode.value))
    return settings


def _write(
    fused: FusedMap, output: Path | None, plot: Path | None, merged_map: Path | None, *, as_json: bool, embed: bool
) -> None:
    from mapfuse.datasets import write_map
    from mapfuse.fusion import write_fused

    one_frame = fused.decision == "merged"
    if output is not None:
        write_fused(fused, output, embed)
    if plot is not None:
        from mapfuse.fusion.show import draw_fused

        with writing(plot):
            draw_fused(fused, plot)
    if merged_map is not None and one_frame:
        write_map(fused.to_map(), merged_map)
    if as_json:
        from mapfuse.datasets.jsondata import encode
        from mapfuse.fusion.fusedfile import fused_to_dict

        say_bytes(encode(fused_to_dict(fused, embed)))
    else:
        from .summary import summarise

        say(summarise(fused))
        for path in (output, plot, merged_map if one_frame else None):
            if path is not None:
                say(f"wrote {path}")
    if merged_map is not None and not one_frame:
        note(f"{merged_map} was not written: the maps were not merged")
