"""``mapfuse fuse``: recorded maps into one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import anymap, grids
from .console import (
    Quiet,
    UsageError,
    Verbose,
    check_outputs,
    check_page,
    check_picture,
    note,
    say,
    say_bytes,
    warn_on_stderr,
    writing,
)
from .progress import stages

if TYPE_CHECKING:
    from mapfuse.datasets.maps import LandmarkMap
    from mapfuse.fusion import FuseConfig, FusedMap, KnownTransform


class Mode(StrEnum):
    """How hypotheses are proposed."""

    default = "default"
    paper = "paper"


def fuse_files(
    maps: Annotated[
        list[Path],
        typer.Argument(
            help=(
                "Recorded maps, in any format that `mapfuse formats` lists, or results (NAME.fused.json), "
                "for the maps in them."
            ),
            metavar="MAP",
        ),
    ],
    *,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The result, OUT.fused.json.", show_default=False)
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="A picture of the result: .png, .svg, .pdf.")] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="A page of the result for a browser, OUT.html.")
    ] = None,
    merged_map: Annotated[
        Path | None, typer.Option("--map", help="The merged map as a map again, OUT.map.json.")
    ] = None,
    grid: Annotated[
        Path | None,
        typer.Option("--grid", metavar="OUT.yaml", help="The grids among the maps in one; its picture beside it."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The result file on standard output.")] = False,
    no_embed: Annotated[bool, typer.Option("--no-embed", help="Leave the input maps out of the result file.")] = False,
    without: Annotated[
        list[str] | None, typer.Option("--without", metavar="NAME", help="Leave out the map of this name; repeatable.")
    ] = None,
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
    near: Annotated[
        tuple[str, str, float, float, float, float, float] | None,
        typer.Option(
            "--near",
            metavar="A B X Y DEG SIGMA_M SIGMA_DEG",
            help="Map B lies about at X, Y [m], turned by DEG, in map A; and how well that is known.",
        ),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option("--reference", metavar="MAP", help="The map of this name is exact, a floor plan for one."),
    ] = None,
    estimate_noise: Annotated[
        bool,
        typer.Option("--estimate-noise", help="Use the noise that each map's own residuals speak for."),
    ] = False,
    walls: Annotated[
        bool, typer.Option("--walls", help="Let walls speak too, where maps have them (walls.use); docs/walls.md.")
    ] = False,
    mode: Annotated[Mode | None, typer.Option("--mode", help="How hypotheses are proposed.")] = None,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Parameters; see `mapfuse config`.")
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fuse recorded maps, whose relative start is unknown, and say how sure the answer is.

    Exit code 0 whatever was decided: "no overlap" is an answer.
    """
    check_picture("--plot", plot)
    check_page("--report", report)
    grids.check_output(grid, maps)
    outputs = {"-o": output, "--plot": plot, "--report": report, "--map": merged_map, "--grid": grid}
    check_outputs(outputs, [*maps, *([config] if config else [])])
    warn_on_stderr(verbose=verbose)
    settings = _settings(config, accept, overlap_prior, mode, estimate_noise=estimate_noise, walls=walls)
    recorded = _left(anymap.read_maps(maps, anymap.options(given or []), quiet=quiet), without or ())

    from mapfuse.fusion import as_reference, fuse

    if reference is not None:
        if reference not in {m.name for m in recorded}:
            raise UsageError(f"--reference: none of the maps is named {reference!r}")
        recorded = [as_reference(m) if m.name == reference else m for m in recorded]
    with stages("fusing", quiet=quiet):
        fused = fuse(recorded, settings, _known(near))
    _write(fused, outputs, as_json=as_json, embed=not no_embed, quiet=quiet)
    if grid is not None:
        grids.write_merged(fused, maps, grid, quiet=quiet or as_json)
    if require_merge and fused.decision != "merged":
        raise typer.Exit(3)


def _known(near: tuple[str, str, float, float, float, float, float] | None) -> list[KnownTransform]:
    """What ``--near`` says of two maps; raises `UsageError` for a standard deviation that is none."""
    if near is None:
        return []
    import numpy as np

    from mapfuse.datasets import Transform
    from mapfuse.fusion import KnownTransform

    first, second, x, y, turn, sigma_m, sigma_deg = near
    if not (sigma_m > 0 and sigma_deg > 0):
        raise UsageError("--near: how well it is known (SIGMA_M, SIGMA_DEG) must be greater than 0")
    variances = np.array([sigma_m, sigma_m, np.deg2rad(sigma_deg)]) ** 2
    return [KnownTransform((first, second), Transform(x, y, float(np.deg2rad(turn)), np.diag(variances)))]


def _settings(
    config: Path | None,
    accept: float | None,
    overlap_prior: float | None,
    mode: Mode | None,
    *,
    estimate_noise: bool,
    walls: bool,
) -> FuseConfig:
    from mapfuse.fusion.config import FuseConfig

    settings = FuseConfig()
    if config is not None:
        from .parameters import config_from_toml

        settings = config_from_toml(config)
    if accept is not None:
        settings = replace(settings, decision=replace(settings.decision, accept=accept))
    if overlap_prior is not None:
        settings = replace(settings, decision=replace(settings.decision, overlap_prior=overlap_prior))
    if estimate_noise:
        settings = replace(settings, solving=replace(settings.solving, estimate_noise=True))
    if walls:
        settings = replace(settings, walls=replace(settings.walls, use=True))
    if mode is not None:
        settings = replace(settings, matching=replace(settings.matching, mode=mode.value))
    return settings


def _left(maps: Sequence[LandmarkMap], without: Sequence[str]) -> list[LandmarkMap]:
    """The maps that are not left out; raises `UsageError` for a name that none has, and where none is left."""
    names = [m.name for m in maps]
    if unknown := [name for name in without if name not in names]:
        raise UsageError(f"--without {unknown[0]}: there is no such map; there are {', '.join(names)}")
    if len(maps) < 2:
        raise UsageError("give at least two maps to fuse")
    left = [m for m in maps if m.name not in without]
    if not left:
        raise UsageError("--without leaves no map")
    return left


def _write(fused: FusedMap, outputs: Mapping[str, Path | None], *, as_json: bool, embed: bool, quiet: bool) -> None:
    """All that was asked for; ``outputs``: option -> file."""
    from mapfuse.datasets import write_map
    from mapfuse.fusion import write_fused

    one_frame = fused.decision == "merged"
    if (output := outputs["-o"]) is not None:
        write_fused(fused, output, embed)
    if (plot := outputs["--plot"]) is not None:
        from mapfuse.fusion.show import draw_fused

        with writing(plot):
            draw_fused(fused, plot)
    if (report := outputs["--report"]) is not None:
        from mapfuse.fusion.report import fused_report

        fused_report(fused, report)
    merged_map = outputs["--map"]
    if merged_map is not None and one_frame:
        write_map(fused.to_map(), merged_map)
    if as_json:
        from mapfuse.datasets.jsondata import encode
        from mapfuse.fusion.fusedfile import fused_to_dict

        say_bytes(encode(fused_to_dict(fused, embed)))
    elif not quiet:
        from .summary import summarise

        say(summarise(fused))
        for path in (output, plot, report, merged_map if one_frame else None):
            if path is not None:
                say(f"wrote {path}")
    if merged_map is not None and not one_frame:
        note(f"{merged_map} was not written: the maps were not merged")
